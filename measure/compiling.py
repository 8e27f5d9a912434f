"""Compiling hot loops: cached on disk, deterministic, without the interpreter's lock."""

from __future__ import annotations

import atexit
import copy
import hashlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.util import resolve_name
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite.binding as llvm
import numba
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.core.types.misc import unliteral

_IMPORT = re.compile(r"^(?:from +([\w.]+) +import +(?:\(([^)]*)\)|(.*))|import +([\w.]+))", re.M)
"""Imports at the top level; kernels use nothing of indented ones."""


def digest(module: str) -> str:
    """SHA-256 of the sources of a module and of what it imports of its package and this one.

    Numba compiles functions and constants of other modules into a kernel, but invalidates its
    cached code by the kernel's own file alone.
    """
    packages = {module.partition(".")[0], __name__.partition(".")[0]}
    reached, pending = set[str](), [module]
    while pending:
        name = pending.pop()
        if name not in reached and name.partition(".")[0] in packages and _file(name):
            reached.add(name)
            pending += _imported(name, _file(name))
    whole = hashlib.sha256()
    for name in sorted(reached):
        whole.update(f"{name} {_content(_file(name))[0]}\n".encode())
    return whole.hexdigest()


@cache
def _file(module: str) -> str:
    """Source file of a module, whether it is loaded yet or not; empty if there is none."""
    root, _, rest = module.partition(".")
    top = sys.modules.get(root)
    places = getattr(top, "__path__", ())
    alone = getattr(top, "__file__", None)
    if not places and not rest and alone and alone.endswith(".py"):
        return str(alone)
    for place in places:
        base = Path(place, *rest.split("."))
        for source in (base / "__init__.py", base.with_suffix(".py")):
            if source.is_file():
                return str(source)
    return ""


@cache
def _content(file: str) -> tuple[str, str]:
    """A source file's digest and text when first read: what this process has imported."""
    source = Path(file).read_bytes()
    return hashlib.sha256(source).hexdigest(), source.decode("utf-8", "replace")


@cache
def _imported(module: str, file: str) -> list[str]:
    """Names of what may be modules that a module imports at its top level."""
    found = []
    package = module if Path(file).name == "__init__.py" else module.rpartition(".")[0]
    for origin, in_brackets, in_line, plain in _IMPORT.findall(_content(file)[1]):
        name = resolve_name(origin or plain, package)
        parts = re.findall(r"\w+", in_brackets or in_line)
        found += [name, *(f"{name}.{part}" for part in parts)]
    return found


_FOR_NOW = "triball-code-"  # How temporary folders for machine code are called
_OPTIONS = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
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
    kernel = numba.njit(forceinline=True, **_OPTIONS)(function)
    return cast("F", _of_plain_types(kernel))


def is_kept_for_now() -> bool:
    """Whether what is compiled goes when the process ends: no lasting place can be written."""
    return Path(numba.config.CACHE_DIR).name.startswith(_FOR_NOW)


def share_compiled(since_s: float) -> float:
    """Of all kernels of loaded modules, those in use, or compiled elsewhere since then (1970)."""
    modules = [m for name, m in list(sys.modules.items()) if name.startswith("measure")]
    loaded = [one for module in modules for one in list(vars(module).values())]
    kernels = {one for one in loaded if isinstance(one, CPUDispatcher) and one.stats.cache_path}
    files = {one: Path(one._cache._cache_file._index_path) for one in kernels}  # noqa: SLF001
    done = [
        one.overloads or (file.exists() and file.stat().st_mtime > since_s)
        for one, file in files.items()
    ]
    return sum(map(bool, done)) / max(len(done), 1)


def _kept_on_disk(function: F, **options: str) -> F:
    compile_it = numba.njit(cache=True, **_OPTIONS, **options)
    try:
        kernel = compile_it(function)
    except RuntimeError:  # Neither the installation nor the user's folder can be written
        folder = tempfile.mkdtemp(prefix=_FOR_NOW)
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = folder
        kernel = compile_it(function)
    _tie(kernel, digest(function.__module__))
    return cast("F", _of_plain_types(kernel))


def _of_plain_types(kernel: Any) -> Any:
    """The kernel, compiled once for all integers: Numba takes each constant for a type."""
    template = getattr(kernel, "get_call_template", None)
    if template is not None:
        kernel.get_call_template = lambda args, kws: template(
            tuple(map(unliteral, args)), {name: unliteral(kws[name]) for name in kws}
        )
    return kernel


def _tie(kernel: Any, stamp: str) -> None:
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
        cache.save_overload = _if_it_can_be(cache.save_overload)
        if not numba.config.CACHE_DIR or is_kept_for_now():
            _read_beside_source(kept, Path(_file(kernel.__module__)).parent / "__pycache__")


def _read_beside_source(kept: Any, folder: Path) -> None:
    """Use also what was compiled where the installation could be written, by whoever made it."""
    beside, own = copy.copy(kept), kept.load
    beside._cache_path = str(folder)  # noqa: SLF001
    beside._index_path = str(folder / kept._index_name)  # noqa: SLF001
    kept.load = lambda key: own(key) or beside.load(key)


def _if_it_can_be(save: Callable[..., None]) -> Callable[..., None]:
    """A kernel's `save_overload`, that costs time alone where nothing can be written."""

    def saved(*given: Any) -> None:
        with suppress(OSError):
            save(*given)

    return saved


def _same_types_only(load: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel's `load_overload`, but None where the cached code is for other types.

    Two processes that compile at once may give code for different types the same file.
    """

    def checked(signature: Any, context: Any) -> Any:
        found = load(signature, context)
        wanted = normalize_signature(signature)[0]
        return found if found is None or tuple(found.signature.args) == tuple(wanted) else None

    return checked
