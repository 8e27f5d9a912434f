"""A package whose names load when they are asked for.

Its `__init__.pyi` imports them, for readers and type checkers; at run time the same lines say where
each of them is (as scientific-python's SPEC 1 has it).
"""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any


class _LazyPackage(ModuleType):
    """A package by its stub, which stands in its `_where`: the module of each name."""

    def __getattr__(self, name: str) -> Any:
        if name not in self._where:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        value = getattr(import_module(self._where[name]), name)
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: object) -> None:
        # A module of the package, such as `run`, does not hide the function of that name.
        if not (isinstance(value, ModuleType) and name in self._where):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self._where})


def load_lazily(package: str) -> list[str]:
    """Let a package's names load one by one; returns them, its `__all__`.

    Args:
        package: its `__name__`; it is being imported, and its stub lies beside it.
    """
    module = sys.modules[package]
    stub = ast.parse(Path(str(module.__file__)).with_suffix(".pyi").read_bytes())
    imports = [line for line in stub.body if isinstance(line, ast.ImportFrom)]
    module.__dict__["_where"] = {one.name: line.module for line in imports for one in line.names}
    module.__class__ = _LazyPackage
    return sorted(module.__dict__["_where"])
