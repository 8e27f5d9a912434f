"""A fresh virtual environment with the program and other authors' distributions installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
WHOLE = ("blob", "nearest", "rigid", "linear", "tail", "steady", "count", "rows")
OTHERS = (*WHOLE, "broken", "clashing", "wrong_hook")
"""Distributions of other authors: one of each kind, and three that are faulty."""
collect_ignore = list(OTHERS)


@dataclass(frozen=True)
class Environment:
    """A virtual environment and what runs in it."""

    folder: Path

    def program(self, name: str) -> str:
        return str(self.folder / "bin" / name)

    def run(self, *command: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        """Run a command; not in the repository, whose sources python would find first."""
        return subprocess.run(
            command, capture_output=True, text=True, check=False, cwd=cwd or self.folder
        )

    def measure(self, *tokens: str) -> subprocess.CompletedProcess[str]:
        """The installed console script."""
        return self.run(self.program("measure"), *tokens)

    def measure_json(self, *tokens: str) -> Any:
        done = self.measure(*tokens, "--json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """Built offline: the dependencies are seen in this interpreter's own environment."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    venv.create(folder, with_pip=False)
    environment = Environment(folder)
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    library = environment.run(environment.program("python"), "-c", code).stdout.strip()
    # Folders only, no .pth of theirs: a development installation of the program stays out of sight.
    seen = [path for path in sys.path if Path(path).name == "site-packages"]
    Path(library, "dependencies.pth").write_text("".join(f"{path}\n" for path in seen))
    done = environment.run(
        *(sys.executable, "-m", "pip", "--python", environment.program("python")),
        *("install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"),
        *("--disable-pip-version-check", "--ignore-installed"),
        str(HERE.parents[1]),
        *(str(HERE / name) for name in OTHERS),
    )
    assert done.returncode == 0, done.stderr
    _take_compiled(Path(library))
    return environment


def _take_compiled(library: Path) -> None:
    """Take along what was compiled of the same sources, which takes longer than to test it."""
    for root in (HERE.parents[1], HERE.parents[1] / "plugins"):
        for kept in root.glob("measure*/**/__pycache__/*.nb[ic]"):
            folder = library / kept.parent.relative_to(root)
            folder.mkdir(exist_ok=True)
            shutil.copy(kept, folder)
        for source in root.glob("measure*/**/*.py"):  # numba knows a source by size and time
            at = source.stat()
            os.utime(library / source.relative_to(root), ns=(at.st_atime_ns, at.st_mtime_ns))
