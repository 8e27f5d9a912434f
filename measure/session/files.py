"""Reading files that people write: every mistake becomes one line with the file and the place."""

from __future__ import annotations

import glob
import re
import tomllib
import unicodedata
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from measure.errors import MeasureError, SessionError
from measure.reading import check_ordinary, parse_toml, read_toml_text
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

    Raises:
        error: the file is missing (the message says which similar ones there are) or unreadable,
            is not TOML (file and line), or does not fit the model (file, line and key).
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

    Raises:
        error: the pattern searches all folders beyond `folder`, which may not end, or a pipe,
            device or socket fits it.
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
