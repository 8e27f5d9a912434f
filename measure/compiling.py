"""Compiling hot loops: cached on disk, deterministic, without the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import llvmlite.binding as llvm
import numba
from numba.core.sigutils import normalize_signature

from measure.kernel_sources import digest

F = TypeVar("F", bound=Callable[..., Any])

# Loops here run over a few dozen rays or points. Unrolled they compile 20 % and run 5 % slower.
# Numba has no option for it.
for _option in ("-unroll-runtime=false", "-force-vector-interleave=1"):
    llvm.set_option("measure", _option)
# Level 3 makes them no faster than level 2, and compiles 20 % slower.
if "NUMBA_OPT" not in os.environ:
    numba.config.OPT = type(numba.config.OPT)(2)


def compiled(function: F) -> F:
    """Compile a function of arrays and numbers by numba; plugins may use it too.

    What is promised: it is compiled on its first call with each combination of argument types, and
    the machine code is kept on disk until a source changes that it may be made of. It runs without
    the interpreter's lock, so that cameras are measured side by side. Division by zero gives inf or
    NaN, as in numpy. Sums are evaluated in the order in which they are written, so that results
    repeat to the bit, whatever else the process has compiled.

    Args:
        function: of a module on disk; it calls other compiled functions and numpy only.
    """
    return _kept_on_disk(function)


def folded(function: F) -> F:
    """`compiled`, and part of the source of the compiled functions that call it.

    For a function with one caller: it is optimised once, with its caller, instead of twice.
    """
    return _kept_on_disk(function, inline="always")


def inlined(function: F) -> F:
    """Compile a function into its compiled callers only; no machine code of its own is kept."""
    return cast("F", numba.njit(nogil=True, error_model="numpy", forceinline=True)(function))


def _kept_on_disk(function: F, **options: str) -> F:
    kernel = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    _tie(kernel, digest(function.__module__))
    return cast("F", kernel)


def _tie(kernel: object, stamp: str) -> None:
    """Invalidate a kernel's cached machine code when the stamp or its argument types change.

    By numba's private members: it has no public way, and its own version is compared before a file
    is read that may name types which no longer exist. With compilation switched off there is no
    cache.
    """
    cache: Any = getattr(kernel, "_cache", None)
    kept: Any = getattr(cache, "_cache_file", None)
    if kept is not None:
        kept._version = f"{kept._version} {stamp}"  # noqa: SLF001
        cache.load_overload = _same_types_only(cache.load_overload)


def _same_types_only(load: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel's `load_overload`, but None where the cached code is for other types.

    Two processes that compile at once may give code for different types the same file.
    """

    def checked(signature: Any, context: Any) -> Any:
        found = load(signature, context)
        wanted = normalize_signature(signature)[0]
        return found if found is None or tuple(found.signature.args) == tuple(wanted) else None

    return checked
