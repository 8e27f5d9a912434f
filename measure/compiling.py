"""One way to compile the hot loops: ahead of need, cached on disk, deterministic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_REORDERED = {"reassoc", "contract", "nsz", "arcp"}
"""What the compiler may do to sums and products, so that loops use the processor's vectors. It
decides once, when compiling: the same picture gives the same bits on every run. Not a number stays
not a number."""


def compiled(function: F) -> F:
    """`function` compiled by numba on its first call; the machine code is kept on disk.

    It runs without the interpreter's lock, so that cameras are measured side by side.
    """
    return cast(
        "F",
        numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_REORDERED)(function),
    )
