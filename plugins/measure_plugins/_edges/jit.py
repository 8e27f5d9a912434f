"""One way to compile the hot loops: ahead of need, cached on disk, deterministic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """`function` compiled by numba on its first call; the machine code is kept on disk.

    No fast-math: the same picture gives the same bits on every run.
    """
    return cast("F", numba.njit(cache=True, error_model="numpy")(function))
