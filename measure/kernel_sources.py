"""Digest of the sources of a compiled function: its module and all modules that it imports."""

from __future__ import annotations

import hashlib
import re
import sys
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

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
