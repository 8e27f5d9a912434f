"""Machine code on disk follows the sources it is made of; it does not grow by unrolling loops."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

_PART = """from measure.compiling import compiled
SIZE = {size}

@compiled
def part(x: float) -> float:
    return {factor} * x
"""
_WHOLE = """from measure.compiling import compiled
from parts.part import (
    SIZE,
    part,
)

@compiled
def whole(x: float) -> float:
    return part(x) + SIZE
"""
_CALL = """from parts.whole import whole
print(whole(1.0), sum(whole.stats.cache_hits.values()))
"""

_GIVEN = """from typing import NamedTuple
from measure.compiling import compiled

class {name}(NamedTuple):
    size: float

@compiled
def doubled(given: {name}) -> float:
    return 2.0 * given.size
"""
_CALL_GIVEN = """from parts.given import {name}, doubled
print(doubled({name}(1.5)), sum(doubled.stats.cache_hits.values()))
"""

_TWICE = """from measure.compiling import compiled

@compiled
def halved(x):
    return x[0] / 2
"""
_CALL_TWICE = """import numba
import numpy as np
from parts.twice import halved

@numba.njit
def both(x, y):
    return halved(x), halved(y)

x, y = np.full(2, 3), np.full(2, 5.0)
print(*{halved})
"""
_BY_OTHERS = """from numba.core import caching
caching.CacheImpl._locator_classes = caching.CacheImpl._locator_classes[{places}]
from measure.compiling import is_kept_for_now
from parts.whole import whole
print(whole(1.0), sum(whole.stats.cache_hits.values()), is_kept_for_now())
"""
_WAYS = "(halved(x), halved(y))", "both(x, y)"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of two kernels, one made of the other."""
    folder = tmp_path / "parts"
    folder.mkdir()
    (folder / "__init__.py").write_text("", "utf-8")
    (folder / "unused.py").write_text("", "utf-8")
    (folder / "part.py").write_text(_PART.format(factor=2.0, size=0.5), "utf-8")
    (folder / "whole.py").write_text(_WHOLE, "utf-8")
    return folder


def _call(package: Path) -> list[float]:
    """The outer kernel's answer in a new process, and whether it was loaded from disk."""
    return _printed(_CALL, package.parent)


def _printed(program: str, folder: Path, **environment: str) -> list[float]:
    """The numbers that a program prints; it finds modules in the folder, and keeps code there."""
    paths = [str(folder), *(path for path in sys.path if path)]
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "NUMBA_CACHE_DIR": str(folder / "cache"),
            **environment,
        },
        capture_output=True,
        text=True,
        check=True,
    )
    return [float(word) for word in done.stdout.replace("True", "1").replace("False", "0").split()]


@pytest.mark.parametrize(("changed", "answer"), [((2.0, 7.5), 9.5)])
def test_a_kernel_follows_the_functions_and_constants_of_other_files(
    package: Path, changed: tuple[float, float], answer: float
) -> None:
    assert _call(package) == [2.5, 0]
    (package / "unused.py").write_text("x = 1\n", "utf-8")
    assert _call(package) == [2.5, 1]
    text = _PART.format(factor=changed[0], size=changed[1])
    (package / "part.py").write_text(text, "utf-8")
    assert _call(package) == [answer, 0]


def test_code_kept_for_a_type_that_is_gone_is_compiled_anew(package: Path) -> None:
    for name in ("Before", "After"):
        (package / "given.py").write_text(_GIVEN.format(name=name), "utf-8")
        call = _CALL_GIVEN.format(name=name)
        assert _printed(call, package.parent) == [3.0, 0], name
        assert _printed(call, package.parent) == [3.0, 1], name


def test_code_for_other_types_is_not_taken(package: Path) -> None:
    """Two processes that compile at once may each give their code the first file's name."""
    (package / "twice.py").write_text(_TWICE, "utf-8")
    directly, within = (_CALL_TWICE.replace("{halved}", way) for way in _WAYS)
    assert _printed(directly, package.parent) == [1.5, 2.5]
    one, other = sorted((package.parent / "cache").rglob("*.nbc"))
    code = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(code)
    for call in (within, directly):
        assert _printed(call, package.parent) == [1.5, 2.5]


def test_code_made_by_whoever_may_write_the_installation_serves_all(package: Path) -> None:
    """Beside the source it is read by those who cannot write there, or nowhere."""
    folder, beside = package.parent, package / "__pycache__"
    theirs = {"NUMBA_CACHE_DIR": "", "XDG_CACHE_HOME": str(folder / "home")}
    theirs["TMPDIR"] = str(folder)
    home_only, nowhere = _BY_OTHERS.format(places="2:3"), _BY_OTHERS.format(places=":1")
    assert _printed(_CALL, folder, **theirs) == [2.5, 0]
    assert list(beside.glob("*.nbc"))
    assert _printed(home_only, folder, **theirs) == [2.5, 1, 0]
    assert _printed(nowhere, folder, **theirs) == [2.5, 1, 1]
    for file in beside.glob("*.nb?"):
        file.unlink()
    assert _printed(nowhere, folder, **theirs) == [2.5, 0, 1]
    assert not list(folder.glob("triball-code-*"))
