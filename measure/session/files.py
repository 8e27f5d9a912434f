"""Files that people write: every mistake is one line with the place; TOML is written readably."""

from __future__ import annotations

import difflib
import glob
import json
import re
import tomllib
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, FiniteFloat, ValidationError

from measure.errors import MeasureError, SessionError
from measure.reading import check_ordinary, parse_toml, read_toml_text

M = TypeVar("M", bound=BaseModel)


def _without_control_characters(text: str) -> str:
    if any(unicodedata.category(character) == "Cc" for character in text):
        raise ValueError(f"{text!r} holds a control character")
    return text


_LONGEST_NAME_BYTES = 200
"""A file system's 255, less what files called after a thing have round its name."""
_DEVICE = re.compile(
    r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³]) *(\..*)?", re.IGNORECASE
)
"""Names of devices in every folder of Windows, whatever the ending."""


def check_name(name: str) -> str:
    """Refuse (ValueError) a name after which no file may be called, on any system.

    The one rule for names of cameras, bodies and balls: files and folders are called after them, so
    none may lead elsewhere. Spaces within and all alphabets are harmless.
    """
    _without_control_characters(name)
    shown = _short(name)
    if not name:
        raise ValueError("a name must not be empty")
    if any(sign in name for sign in "/\\") or re.match(r"[A-Za-z]:", name):
        raise ValueError(f"{shown} is a path, not a name: write it without slashes")
    if name.endswith((".", " ")):
        raise ValueError(
            f"{shown} ends with a dot or space: files are called after it, so it must not"
        )
    if _DEVICE.fullmatch(name):
        raise ValueError(f"{shown} is a device's name on Windows: choose another")
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        raise ValueError(f"{shown} is no text (a lone surrogate)") from None
    if size > _LONGEST_NAME_BYTES:
        raise ValueError(f"{shown} is too long: {size} bytes, {_LONGEST_NAME_BYTES} at most")
    return name


Name = Annotated[str, Field(min_length=1), AfterValidator(_without_control_characters)]
"""What a file or a column is called."""
SafeName = Annotated[str, AfterValidator(check_name)]
"""What a camera, a body or a ball is called."""
Length = Annotated[FiniteFloat, Field(ge=1e-3, le=1e6)]
"""A size in mm of what can be made and seen: a micrometre to a kilometre."""
_Coordinate = Annotated[FiniteFloat, Field(ge=-1e6, le=1e6)]
Position = tuple[_Coordinate, _Coordinate, _Coordinate]
"""Where a thing stands, mm: no further than a kilometre from the origin."""


def load_toml(path: Path | str, model: type[M], error: type[MeasureError] = SessionError) -> M:
    """Read and validate a TOML file.

    `error`: the file is missing (the message says which similar ones there are) or unreadable, is
    not TOML (file and line), or does not fit the model (file, line and key).
    """
    text = read_toml_text(path, error)
    try:
        values = parse_toml(text)
    except tomllib.TOMLDecodeError as problem:
        raise error(syntax_message(Path(path), text, str(problem))) from None
    try:
        return model.model_validate(values)
    except ValidationError as problem:
        raise error(validation_message(Path(path), text, problem, model, values)) from None


def matching_files(folder: Path, pattern: str, error: type[MeasureError]) -> list[Path]:
    """Ordinary files that fit a shell's pattern, from `folder` on if it is relative; 2 before 10.

    None that is hidden; `**` stands for folders at any depth, links to folders not followed.
    `error`: it searches all folders beyond `folder`, which may not end, or a pipe, device or socket
    fits it.
    """
    place = Path(pattern)
    beyond = place.is_absolute() or ".." in place.parts
    deep = "**" in place.parts
    if beyond and (deep or sum(map(glob.has_magic, place.parts[:-1])) > 1):
        raise error(
            f"{pattern}: would search folders without end: give a pattern within {folder}, or name "
            "the folder"
        )
    if deep:
        found = [
            path
            for path in folder.glob(pattern)
            if not any(part.startswith(".") for part in path.relative_to(folder).parts)
        ]
    else:
        names = glob.glob(pattern, root_dir=folder)  # noqa: PTH207 Path takes no absolute
        found = [folder / name for name in names]
    files = [path for path in found if path.is_file()]
    if len(files) < len(found):
        for path in set(found) - set(files):
            if path.exists() and not path.is_dir():
                check_ordinary(path, error)
    return sorted(files, key=_in_order)


def _in_order(file: Path) -> list[str | int]:
    """What to sort by, so that 2 comes before 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", str(file))]


def syntax_message(path: Path, text: str, problem: str) -> str:
    """The message of `tomllib`, with file and line."""
    found = re.search(r" \(at (?:line (\d+), column (\d+)|end of document)\)$", problem)
    what = problem[: found.start()] if found else problem
    last = len(text.splitlines())
    line = int(found.group(1)) if found and found.group(1) else last
    return f"{path}:{line}: not valid TOML: {what[:1].lower()}{what[1:]}"


def validation_message(
    path: Path, text: str, problem: ValidationError, model: type[BaseModel], values: Any
) -> str:
    """The most telling problem of a pydantic error in one line, with file, line and key."""
    first = max(problem.errors(include_url=False), key=_telling)
    keys = _real_keys(first["loc"], values, first["type"] == "missing")
    line = find_line(text, keys)
    where = f"{path}:{line}" if line else str(path)
    name = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).lstrip(".")
    more = f" (and {problem.error_count() - 1} more)" if problem.error_count() > 1 else ""
    if first["type"] == "extra_forbidden":
        return f"{where}: unknown key '{name}'{_near(str(keys[-1]), first['loc'], model)}{more}"
    if first["type"] == "missing":
        return f"{where}: '{name}' is missing{more}"
    what = first["msg"].removeprefix("Value error, ")
    given = "" if first["type"] == "value_error" else f", got {_short(first['input'])}"
    subject = f"'{name}': " if name else ""
    return f"{where}: {subject}{what[:1].lower()}{what[1:]}{given}{more}"


def _telling(error: Any) -> tuple[int, int]:
    """A misspelt key explains most; that a table is no text, where both may stand, least."""
    rank = {"extra_forbidden": 3, "value_error": 2}.get(error["type"], 1)
    return (0 if error["type"].endswith("_type") else rank, len(error["loc"]))


def _real_keys(loc: tuple[int | str, ...], values: Any, missing: bool) -> tuple[int | str, ...]:
    """The keys of a location without the names pydantic adds for the branches of a union."""
    keys: list[int | str] = []
    for depth, key in enumerate(loc):
        known = isinstance(values, dict) and key in values
        known = known or (isinstance(values, list) and isinstance(key, int) and key < len(values))
        if known:
            values = values[key]
        elif depth + 1 < len(loc) or not missing:
            continue
        keys.append(key)
    return tuple(keys)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _near(key: str, keys: tuple[int | str, ...], model: type[BaseModel]) -> str:
    known = list(getattr(_model_at(model, keys[:-1]), "model_fields", {}))
    near = difflib.get_close_matches(key, known, n=2)
    if near:
        return f"; did you mean {' or '.join(near)}?"
    return f"; known here: {', '.join(known)}" if known else ""


def _model_at(model: Any, keys: tuple[int | str, ...]) -> Any:
    for key in keys:
        if isinstance(key, str):
            info = getattr(model, "model_fields", {}).get(key)
            model = _inner_model(info.annotation) if info else None
    return model


def _inner_model(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = (_inner_model(part) for part in getattr(annotation, "__args__", ()))
    return next((found for found in inner if found is not None), None)


def dump_toml(values: Mapping[str, Any]) -> str:
    """TOML text of nested mappings; lists of mappings become `[[...]]`, None is left out.

    Written here because matrices must stay readable: one row a line, numbers to the last digit.
    """
    return "\n".join(_table_lines(values, "")).strip("\n") + "\n"


def _table_lines(values: Mapping[str, Any], prefix: str) -> list[str]:
    lines = [
        f"{_key(key)} = {_value(value)}"
        for key, value in values.items()
        if value is not None and not _is_table(value)
    ]
    for key, value in values.items():
        if not _is_table(value):
            continue
        name = f"{prefix}{_key(key)}"
        tables = [value] if isinstance(value, Mapping) else value
        header = f"[{name}]" if isinstance(value, Mapping) else f"[[{name}]]"
        for table in tables:
            lines += ["", header, *_table_lines(table, f"{name}.")]
    return lines


def _is_table(value: Any) -> bool:
    if isinstance(value, Mapping):
        return True
    return isinstance(value, list | tuple) and bool(value) and isinstance(value[0], Mapping)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list | tuple):
        rows = [_value(item) for item in value]
        nested = any(isinstance(item, list | tuple) for item in value)
        return "[\n    " + ",\n    ".join(rows) + ",\n]" if nested else "[" + ", ".join(rows) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    return repr(value)


def find_line(text: str, keys: tuple[int | str, ...]) -> int | None:
    """The line of the deepest part of a key path that stands in TOML text, counted from 1.

    Good enough for messages: it knows tables, arrays of tables and `key = ...` lines.
    """
    best, depth = None, 0
    table: tuple[int | str, ...] = ()
    counts: dict[tuple[str, ...], int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := re.match(r"\s*\[(\[?)([^\]\[]+)\]", line):
            table = _table_path(_split(header.group(2)), bool(header.group(1)), counts)
            here = table
        elif assignment := re.match(r"\s*([\w.\"'-]+(?:\s*\.\s*[\w\"'-]+)*)\s*=", line):
            here = (*table, *_split(assignment.group(1)))
        else:
            continue
        if len(here) > depth and tuple(keys[: len(here)]) == here:
            best, depth = number, len(here)
    return best


def _split(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))


def _table_path(
    names: tuple[str, ...], repeated: bool, counts: dict[tuple[str, ...], int]
) -> tuple[int | str, ...]:
    if repeated:
        counts[names] = counts.get(names, -1) + 1
        for longer in [k for k in counts if len(k) > len(names) and k[: len(names)] == names]:
            del counts[longer]
    path: list[int | str] = []
    for i, name in enumerate(names, start=1):
        path.append(name)
        if names[:i] in counts:
            path.append(counts[names[:i]])
    return tuple(path)
