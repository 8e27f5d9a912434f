"""Reading files that people write: every mistake becomes one line with the file and the place."""

from __future__ import annotations

import difflib
import glob
import tomllib
import unicodedata
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from measure.errors import MeasureError, SessionError
from measure.session.toml_errors import syntax_message, validation_message

M = TypeVar("M", bound=BaseModel)


def _without_control_characters(text: str) -> str:
    if any(unicodedata.category(character) == "Cc" for character in text):
        raise ValueError(f"{text!r} holds a control character")
    return text


Name = Annotated[str, Field(min_length=1), AfterValidator(_without_control_characters)]
"""What a thing or a file is called."""
Length = Annotated[FiniteFloat, Field(ge=1e-3, le=1e6)]
"""A size in mm of what can be made and seen: a micrometre to a kilometre."""
_Coordinate = Annotated[FiniteFloat, Field(ge=-1e6, le=1e6)]
Position = tuple[_Coordinate, _Coordinate, _Coordinate]
"""Where a thing stands, mm: no further than a kilometre from the origin."""


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
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        raise error(syntax_message(Path(path), text, str(problem))) from None
    try:
        return model.model_validate(values)
    except ValidationError as problem:
        raise error(validation_message(Path(path), text, problem, model, values)) from None


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


def matching_files(folder: Path, pattern: str) -> list[Path]:
    """Files that fit a shell's pattern, from `folder` on if it is relative; none that is hidden."""
    names = glob.glob(pattern, root_dir=folder, recursive=True)  # noqa: PTH207 Path takes no absolute
    return [path for path in (folder / name for name in names) if path.is_file()]


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
