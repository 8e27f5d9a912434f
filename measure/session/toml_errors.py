"""What is wrong with a TOML file, in one line with file, line and key."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from measure.session.toml_text import find_line


def syntax_message(path: Path, text: str, problem: str) -> str:
    """The message of `tomllib`, with file and line."""
    found = re.search(r" \(at (?:line (\d+), column (\d+)|end of document)\)$", problem)
    what = problem[: found.start()] if found else problem
    last = len(text.splitlines())
    line = int(found.group(1)) if found and found.group(1) else last
    return f"{path}:{line}: not valid TOML: {what[:1].lower()}{what[1:]}"


def validation_message(
    path: Path,
    text: str,
    problem: ValidationError,
    model: type[BaseModel],
    values: Any,
    within: tuple[int | str, ...] = (),
) -> str:
    """The most telling problem of a pydantic error in one line, with file, line and key.

    Args:
        text: its content, to find the line.
        within: keys of the table that was validated, if it was not the whole file.
    """
    first = max(problem.errors(include_url=False), key=_telling)
    inner = _real_keys(first["loc"], values, first["type"] == "missing")
    keys = (*within, *inner)
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
    """The keys of a location without the names pydantic adds for the branches of a union.

    Every key stands in the values, but a missing one, which comes last.
    """
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
    at = _model_at(model, keys[:-1])
    now = getattr(at, "renamed", {}).get(key)
    if now is not None:
        return f": it is called '{now}' now"
    known = list(getattr(at, "model_fields", {}))
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
