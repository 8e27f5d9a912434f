"""Reading files that people write: every mistake becomes one line with the file and the place."""

from __future__ import annotations

import difflib
import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from measure.errors import MeasureError, SessionError
from measure.session.toml_text import find_line

M = TypeVar("M", bound=BaseModel)


class FileModel(BaseModel):
    """Base of what is read from a file: frozen, and a misspelt key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def load_toml(path: Path | str, model: type[M], error: type[MeasureError] = SessionError) -> M:
    """Read and validate a TOML file.

    Args:
        path: the file.
        model: the pydantic model it must fit.
        error: what to raise.

    Raises:
        error: the file is missing (the message says which similar ones there are) or unreadable,
            is not TOML (file and line), or does not fit the model (file, line and key).
    """
    text = read_text(path, error)
    try:
        return model.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as problem:
        raise error(_syntax_message(Path(path), text, str(problem))) from None
    except ValidationError as problem:
        raise error(validation_message(Path(path), text, problem, model)) from None


def read_text(path: Path | str, error: type[MeasureError] = SessionError) -> str:
    """The text of a file, UTF-8.

    Raises:
        error: the file is missing, a folder, unreadable or not text.
    """
    path = Path(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise error(missing_message(path)) from None
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a text file (byte {problem.start} is not UTF-8)") from None
    except OSError as problem:
        raise error(f"{path}: cannot be read: {problem.strerror}") from None


def missing_message(path: Path) -> str:
    """Why `path` cannot be found: the first folder that is not there, or the names that are."""
    folder = path.parent
    if not folder.is_dir():
        return f"{path}: no such file; the folder {folder} does not exist either"
    names = sorted(entry.name for entry in folder.iterdir())
    near = difflib.get_close_matches(path.name, names, n=3, cutoff=0.7)
    if near:
        return f"{path}: no such file; did you mean {' or '.join(near)}?"
    shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    return f"{path}: no such file; {folder} holds {shown or 'nothing'}"


def _syntax_message(path: Path, text: str, problem: str) -> str:
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
    within: tuple[int | str, ...] = (),
) -> str:
    """The first problem of a pydantic error in one line, with file, line and key.

    Args:
        path: the file.
        text: its content, to find the line.
        problem: what pydantic says.
        model: the model that was not met.
        within: keys of the table that was validated, if it was not the whole file.
    """
    first = problem.errors(include_url=False)[0]
    keys = (*within, *first["loc"])
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
    return f"{where}: '{name}': {what[:1].lower()}{what[1:]}{given}{more}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _near(key: str, keys: tuple[int | str, ...], model: type[BaseModel]) -> str:
    known = _fields_at(model, keys[:-1])
    near = difflib.get_close_matches(key, known, n=2)
    if near:
        return f"; did you mean {' or '.join(near)}?"
    return f"; known here: {', '.join(known)}" if known else ""


def _fields_at(model: Any, keys: tuple[int | str, ...]) -> list[str]:
    for key in keys:
        if isinstance(key, str):
            info = getattr(model, "model_fields", {}).get(key)
            model = _inner_model(info.annotation) if info else None
    return list(getattr(model, "model_fields", {}))


def _inner_model(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = (_inner_model(part) for part in getattr(annotation, "__args__", ()))
    return next((found for found in inner if found is not None), None)
