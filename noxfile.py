"""Checks on other Pythons and of what is installed: `pipx run nox`, or `nox -s NAME`."""

from __future__ import annotations

from pathlib import Path

import nox

nox.options.default_venv_backend = "uv|virtualenv"
nox.options.sessions = ["tests", "lowest", "built", "minimal"]
PYTHONS = ["3.11", "3.12", "3.13"]


@nox.session(python=PYTHONS)
def tests(session: nox.Session) -> None:
    """The suite; arguments after -- go to pytest."""
    session.install("-e", ".[test]")
    session.run("pytest", "-q", "-n", "auto", *session.posargs)


@nox.session(python=PYTHONS[0], venv_backend="uv")
def lowest(session: nox.Session) -> None:
    """The suite with the lowest version of each dependency that pyproject.toml allows."""
    session.install("--resolution", "lowest-direct", "-e", ".[test]")
    session.run("pytest", "-q", "-n", "auto", *session.posargs)


@nox.session(python=PYTHONS[0])
@nox.parametrize("kind", ["wheel", "sdist"])
def built(session: nox.Session, kind: str) -> None:
    """What is built, installed and used in a folder outside the checkout."""
    out = Path(session.create_tmp()).resolve()
    session.install("build", "twine")
    session.run("python", "-m", "build", f"--{kind}", "--outdir", str(out))
    (made,) = out.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    session.run("twine", "check", "--strict", str(made))
    session.install(str(made))
    session.chdir(out)
    session.run("measure", "demo", "-o", str(out / "demo"), "--frames", "2")


@nox.session(python=PYTHONS)
def minimal(session: nox.Session) -> None:
    """Without extras: all commands are listed, and what lacks a library says which extra it is."""
    session.install(".")
    session.chdir(session.create_tmp())
    session.run("measure", "--help")
    session.run("measure", "plugins")
    session.run("measure", "studio", "desk", "--no-browser", "--seconds", "1", success_codes=[2])


@nox.session(python=PYTHONS[0], default=False)
def coverage(session: nox.Session) -> None:
    """How much of the code the suite runs, by lines and branches; arguments go to pytest."""
    session.install("-e", ".[test]", "coverage")
    session.run("coverage", "run", "-m", "pytest", "-q", "-n", "0", *session.posargs)
    session.run("coverage", "combine")
    session.run("coverage", "report")
