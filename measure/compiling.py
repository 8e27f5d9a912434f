"""One way to compile the hot loops: ahead of need, cached on disk, deterministic."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import llvmlite.binding as llvm
import numba
from numba.core.sigutils import normalize_signature

from measure.kernel_sources import digest

F = TypeVar("F", bound=Callable[..., Any])

# Hot loops go over a few dozen rays or points. Unrolled, as for thousands, they take a fifth more
# time to compile, fill the cache with code, and are a twentieth slower. Numba has no option for it.
for _option in ("-unroll-runtime=false", "-force-vector-interleave=1"):
    llvm.set_option("measure", _option)
# The third level finds nothing in them that the second has not, and takes a fifth more time.
if "NUMBA_OPT" not in os.environ:
    numba.config.OPT = type(numba.config.OPT)(2)


def compiled(function: F) -> F:
    """`function` compiled by numba on its first call; the machine code is kept on disk.

    Sums stay in the order in which they are written. Where the compiler may reorder them, a kernel
    rounds differently inside each of its callers, and whose copy of it is called depends on what
    else the process has loaded: the first run after an installation would not repeat to the bit.

    It runs without the interpreter's lock, so that cameras are measured side by side. The code on
    disk is used until a source changes that it may be made of.
    """
    return _kept_on_disk(function)


def _kept_on_disk(function: F, **options: str) -> F:
    kernel = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    _tie(kernel, digest(function.__module__))
    return cast("F", kernel)


def _tie(kernel: object, stamp: str) -> None:
    """Let a kernel's machine code on disk hold only for its types, and as long as the stamp stays.

    Numba has no public way to say so. Its version is what it compares first: files of another one
    it does not read on, and they may name types that are gone. Where compilation is switched off,
    nothing is on disk.
    """
    cache: Any = getattr(kernel, "_cache", None)
    kept: Any = getattr(cache, "_cache_file", None)
    if kept is not None:
        kept._version = f"{kept._version} {stamp}"  # noqa: SLF001
        cache.load_overload = _same_types_only(cache.load_overload)


def _same_types_only(load: Callable[..., Any]) -> Callable[..., Any]:
    """`load`, that of a kernel's cache, but nothing where the code on disk is for other types.

    Two processes that compile at once may give code for different types the same file.
    """

    def checked(signature: Any, context: Any) -> Any:
        found = load(signature, context)
        wanted = normalize_signature(signature)[0]
        return found if found is None or tuple(found.signature.args) == tuple(wanted) else None

    return checked


def folded(function: F) -> F:
    """`function` as a part of the source of the compiled loops that call it.

    Compilers go once more through all that a kernel calls: one that is only called by one other
    costs as much time again as the other. Folded, it is compiled with its caller alone.
    """
    return _kept_on_disk(function, inline="always")


def inlined(function: F) -> F:
    """`function` as a part of the compiled loops that call it: none of its own is kept."""
    return cast("F", numba.njit(nogil=True, error_model="numpy", forceinline=True)(function))
