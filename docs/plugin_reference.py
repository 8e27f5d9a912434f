"""The page `reference/plugins.md` of the site: what a plugin may use, by code and docstrings."""

from __future__ import annotations

import ast
import dataclasses
import enum
import importlib
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import pairwise
from types import ModuleType
from typing import Any

PACKAGES = (
    "measure.host",
    "measure.model",
    "measure.geometry",
    "measure.estimation",
    "measure.testing",
    "measure_learning.onnx",
)
HEAD = """# Reference for plugin authors

Every public name of the packages that a plugin works with;
[writing a plugin](../writing_a_plugin.md) shows complete examples.

Lengths are in mm, angles in rad, times in s, image coordinates in px (pixel centres at integers).
Shapes are written as `(n, 2)`; a leading `...` stands for batch axes.
[Conventions](../conventions.md) define frames, rotations and covariances. `Floats`, `Ints`, `Bools`
and `Bytes` (of `measure.arrays`) are numpy arrays of float64, int64, bool and uint8;
errors are those of `measure.errors`; `StateSchema` is that of `measure.robots`.
"""
SECTIONS = ("Attributes", "Args", "Returns", "Yields", "Raises", "Example", "Examples")
MOST_ON_A_LINE = 5
"""A record of no more fields has no section of its own."""
_CONSTRUCTOR = "Constructor."


def plugin_page() -> str:
    """The text of `reference/plugins.md`."""
    return HEAD + "".join(_package(importlib.import_module(name)) for name in PACKAGES)


def undocumented() -> list[str]:
    """Public names, members and fields that have no description."""
    missing = []
    for package in map(importlib.import_module, PACKAGES):
        for name in getattr(package, "__all__", ()):
            full, value = f"{package.__name__}.{name}", getattr(package, name)
            if not description(package, name):
                missing.append(full)
            if _defines_class(name, value):
                missing += [f"{full}.{m}" for m, _, text in members(value) if not text]
    return missing


def members(described: type) -> Iterator[tuple[str, str, str]]:
    """Name, declaration and description of a class's fields, properties and methods, in order."""
    texts = attributes(described)
    for name, declared in _fields(described):
        yield name, declared, texts.get(name, "")
    for name, value in vars(described).items():
        if name.startswith("_") and name != "__init__":
            continue
        function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        if isinstance(value, property | cached_property):
            getter = value.fget if isinstance(value, property) else value.func
            yield name, f"{name}: {_result(getter)}", inspect.getdoc(getter) or ""
        elif name == "__init__":
            if not dataclasses.is_dataclass(described):
                yield name, _call(described.__name__, function), _CONSTRUCTOR
        elif inspect.isfunction(function):
            yield name, _call(name, function), inspect.getdoc(function) or ""


def attributes(described: type) -> dict[str, str]:
    """Descriptions of fields, by name: below "Attributes:" of the docstring, or in comments."""
    listed = _entries(_sections(inspect.getdoc(described) or "").get("Attributes", ""))
    return dict(listed) | _commented(described)


def _commented(described: type) -> dict[str, str]:
    """The comment behind each field of a class, else that above it."""
    try:
        lines = textwrap.dedent(inspect.getsource(described)).splitlines()
    except (OSError, TypeError):
        return {}
    (node,) = ast.parse("\n".join(lines)).body
    out = {}
    for field in getattr(node, "body", ()):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            behind = lines[field.end_lineno - 1][field.end_col_offset :].partition("# ")[2]
            above: list[str] = []
            for line in reversed(lines[: field.lineno - 1]):
                if not line.lstrip().startswith("# "):
                    break
                above.insert(0, line.lstrip("# "))
            if behind or above:
                out[field.target.id] = f"{(behind or ' '.join(above)).rstrip('.')}."
    return out


def description(package: ModuleType, name: str) -> str:
    """The docstring of a class or function; of a constant the string below its assignment."""
    value = getattr(package, name)
    if _defines_class(name, value) or inspect.isroutine(value):
        return inspect.cleandoc(value.__doc__ or "")
    return _constants(package).get(name, "")


def _defines_class(name: str, value: object) -> bool:
    """Whether the name is that of a class, and not another name for one."""
    return inspect.isclass(value) and value.__name__ == name


def _package(package: ModuleType) -> str:
    """Its functions, constants and small records in one list, then each other class."""
    names = sorted(getattr(package, "__all__", ()), key=str.casefold)
    classes = [name for name in names if _has_a_section(package, name)]
    others = [_other(package, name) for name in names if name not in classes]
    parts = [f"\n## {package.__name__}\n\n{inspect.getdoc(package)}\n"]
    parts += ["\n", *others] if others else []
    return "".join([*parts, *(_class(package, name) for name in classes)])


def _has_a_section(package: ModuleType, name: str) -> bool:
    """Whether it is a class with methods, or with more fields than fit on a line."""
    value = getattr(package, name)
    if not _defines_class(name, value):
        return False
    found = len(list(members(value)))
    return issubclass(value, enum.Enum) or found > min(len(_fields(value)), MOST_ON_A_LINE)


def _other(package: ModuleType, name: str) -> str:
    value, text = getattr(package, name), description(package, name)
    if not _defines_class(name, value):
        return _item(_call(name, value) if inspect.isroutine(value) else name, text)
    sections = _sections(text)
    sections.pop("Attributes", None)
    fields = [f"`{declared}`, {said.rstrip('.')}" for _, declared, said in members(value)]
    return f"- `{name}`: {_joined(sections)}{' ' + '; '.join(fields) + '.' if fields else ''}\n"


def _class(package: ModuleType, name: str) -> str:
    """A heading, the prose without its attributes, and a list of members."""
    described = getattr(package, name)
    sections = _sections(description(package, name))
    sections.pop("Attributes", None)
    bases = [f"`{b.__name__}`" for b in described.__bases__ if b is not object]
    found = list(members(described))
    made = [f"`{shown}`. " for _, shown, said in found if said == _CONSTRUCTOR]
    prose = "".join([f"A {', '.join(bases)}. " if bases else "", *made, _joined(sections)])
    listed = [row for row in found if row[0][:5] != "test_" and row[2] != _CONSTRUCTOR]
    items = [_item(shown, said) for _, shown, said in listed]
    if tests := [f"`{member}`" for member, *_ in found if member.startswith("test_")]:
        items.append(f"- Tests: {', '.join(tests)}.\n")
    if issubclass(described, enum.Enum):
        items = [f"- `{m.name}`: {m.value!r}\n" for m in described]
    return f"\n### {name}\n\n{prose}\n" + ("\n" + "".join(items) if items else "")


def _item(declared: str, text: str) -> str:
    """A list item of one line: the declaration, and the description behind it."""
    return f"- `{declared}`: {_joined(_sections(text))}\n"


def _fields(described: type) -> list[tuple[str, str]]:
    """The fields of a dataclass or named tuple, else what the class annotates, with defaults."""
    if hasattr(described, "_fields"):
        names, defaults = described._fields, described._field_defaults
    elif dataclasses.is_dataclass(described):
        own = [f for f in dataclasses.fields(described) if f.init]
        names = tuple(f.name for f in own)
        defaults = {f.name: f.default for f in own if f.default is not dataclasses.MISSING}
    else:
        names = tuple(vars(described).get("__annotations__", {}))
        defaults = {name: vars(described)[name] for name in names if name in vars(described)}
    types = inspect.get_annotations(described)
    return [
        (name, f"{name}: {_type(types.get(name, ''))}{_default(defaults, name)}")
        for name in names
        if not name.startswith("_")
    ]


def _default(defaults: dict[str, Any], name: str) -> str:
    if name not in defaults:
        return ""
    value = defaults[name]
    if isinstance(value, enum.Enum):
        return f" = {type(value).__name__}.{value.name}"
    return f" = {value.__name__ if inspect.isclass(value) else repr(value)}"


def _type(annotation: object) -> str:
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", "")
    return str(text).replace("'", "")


def _call(name: str, function: Callable[..., object]) -> str:
    """Name and signature as written in the source, `self` and `cls` left out."""
    signature = inspect.signature(function)
    kept = [_plain(p) for p in signature.parameters.values() if p.name not in ("self", "cls")]
    result = signature.return_annotation
    if name[:1].isupper() or result is inspect.Signature.empty:  # a constructor
        return f"{name}{inspect.Signature(kept)}"
    return f"{name}{inspect.Signature(kept)} -> {_type(result)}"


class _Source(str):
    """Text that a signature shows without quotation marks."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def _plain(parameter: inspect.Parameter) -> inspect.Parameter:
    """Its annotation, and a default that is a class, as they are written."""
    if inspect.isclass(parameter.default) and parameter.default is not inspect.Parameter.empty:
        parameter = parameter.replace(default=_Source(parameter.default.__name__))
    if parameter.annotation is inspect.Parameter.empty:
        return parameter
    return parameter.replace(annotation=_Source(_type(parameter.annotation)))


def _result(getter: Callable[..., object]) -> str:
    return _type(inspect.get_annotations(getter).get("return", ""))


def _sections(text: str) -> dict[str, str]:
    """A Google docstring by section; what stands before the first has the key ""."""
    parts = re.split(rf"^({'|'.join(SECTIONS)}):\n", text, flags=re.MULTILINE)
    return {"": parts[0].strip(), **dict(zip(parts[1::2], parts[2::2], strict=True))}


def _entries(section: str) -> list[tuple[str, str]]:
    """The `name: text` entries of a section, each on one line."""
    lines = inspect.cleandoc("\n" + section)
    entry = r"^(\*{0,2}[\w.]+): (.*?)(?=^\*{0,2}[\w.]+: |\Z)"
    found = re.findall(entry, lines, re.DOTALL | re.MULTILINE)
    return [(name, " ".join(words.split())) for name, words in found]


def _joined(sections: dict[str, str]) -> str:
    """A docstring on one line: arguments, results and errors as sentences."""
    parts = [sections.get("", "")]
    for title, body in sections.items():
        if title in ("Args", "Raises"):
            entries = [f"`{name}`: {words.rstrip('.')}" for name, words in _entries(body)]
            parts.append(f"{'' if title == 'Args' else 'Raises '}{'; '.join(entries)}.")
        elif title in ("Returns", "Yields"):
            parts.append(f"{title}: {body}")
    return " ".join(" ".join(parts).split())


def _constants(package: ModuleType) -> dict[str, str]:
    """The strings below assignments in the modules that a package takes its names from."""
    found: dict[str, str] = {}
    for imported in ast.parse(inspect.getsource(package)).body:
        if isinstance(imported, ast.ImportFrom) and imported.module:
            body = ast.parse(inspect.getsource(importlib.import_module(imported.module))).body
            for statement, below in pairwise(body):
                match statement, below:
                    case (
                        ast.Assign(targets=[ast.Name(id=name)])
                        | ast.AnnAssign(target=ast.Name(id=name)),
                        ast.Expr(value=ast.Constant(value=str(text))),
                    ):
                        found[name] = inspect.cleandoc(text)
    return found
