"""Helpers of the benchmarks' commands."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from measure.errors import MeasureError


def run_command(main: Callable[[], None]) -> None:
    """Run a command; what its user can mend is one line and exit code 2, not a traceback."""
    try:
        main()
    except MeasureError as error:
        print(f"benchmarks: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None


def run_measure(checkout: Path, cwd: Path, *arguments: str, **environment: str) -> None:
    """Run `measure` in a process of its own, with a checkout's packages, not the installed ones.

    Raises:
        CalledProcessError: it fails.
    """
    run_python(checkout, "-m", "measure", *arguments, cwd=cwd, **environment)


def run_python(
    checkout: Path, *arguments: str, cwd: Path | None = None, **environment: str
) -> None:
    """The same of Python with any arguments."""
    roots = [str(checkout.resolve()), str((checkout / "plugins").resolve())]
    subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(roots), **environment},
        cwd=cwd,
        stdout=subprocess.DEVNULL,
        check=True,
    )
