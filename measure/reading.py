"""The one door to files that others wrote: ordinary ones that memory holds; headings of times."""

from __future__ import annotations

import codecs
import difflib
import stat
import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

from measure.errors import MeasureError
from measure.limits import MOST_LISTED

MAX_TEXT_BYTES = 64 << 20  # Largest file of text: millions of rows
_MAX_TOML_BYTES = 8 << 20
_MAX_TOML_DEPTH = 32
_TOO_DEEP = "Tables or lists are nested too deep"
_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}


def check_ordinary(
    path: Path, error: type[MeasureError], where: str = "", most: int | None = None
) -> int:
    """The size in bytes of a file that can be read from its begin to its end.

    Args:
        where: begin of the message.
        most: bytes that it may have.

    Raises:
        error: it is missing or larger, or a folder, pipe, device or socket: reading those may
            never end.
    """
    try:
        there = path.stat()
    except FileNotFoundError:
        raise error(where + missing_message(path)) from None
    except (OSError, ValueError) as problem:
        raise error(f"{where}{path}: cannot be read: {_reason(problem)}") from None
    if not stat.S_ISREG(there.st_mode):
        what = kind_of_file(there.st_mode)
        raise error(f"{where}{path}: is {what}, not an ordinary file: give the file itself")
    if most is not None and there.st_size > most:
        raise error(
            f"{where}{path}: has {there.st_size} bytes, and {most} are the most that are read"
        )
    return there.st_size


MCAP_START = b"\x89MCAP0\r\n"
_STARTS = {
    MCAP_START: ".mcap",
    b"#ROSBAG V": ".bag",
    b"SQLite format 3\x00": ".db3",
    b"PAR1": ".parquet",
}
"""What files of tables and bags begin with, and what their names then end with."""


def kind_by_content(path: Path) -> str | None:
    """How the name of a file of its content ends: a bag's or Parquet's; None of any other."""
    try:
        with path.open("rb") as file:
            head = file.read(max(map(len, _STARTS)))
    except OSError:
        return None
    return next((ending for start, ending in _STARTS.items() if head.startswith(start)), None)


def kind_of_file(mode: int) -> str:
    """What a thing in a folder is, in words, by its mode; for what is no ordinary file."""
    return _KINDS.get(stat.S_IFMT(mode), "no file")


def read_bytes(path: Path, error: type[MeasureError], most: int, where: str = "") -> bytes:
    """The bytes of an ordinary file.

    Args:
        most: bytes that it may have.

    Raises:
        error: missing, not an ordinary file, unreadable or larger.
    """
    size = check_ordinary(path, error, where, most)
    try:
        # What a device of the kernel's pretends to be a file of no bytes may never end.
        with path.open("rb") as file:
            return file.read(size)
    except OSError as problem:
        raise error(f"{where}{path}: cannot be read: {_reason(problem)}") from None


def read_text(path: Path | str, error: type[MeasureError], most: int = MAX_TEXT_BYTES) -> str:
    """The text of an ordinary file, UTF-8 or marked UTF-16; all line ends become newlines.

    Raises:
        error: missing, not an ordinary file, unreadable, larger than `most` bytes or not text.
    """
    path = Path(path)
    data = read_bytes(path, error, most)
    try:
        marked = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = data.decode("utf-16" if marked else "utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a text file (byte {problem.start} is not UTF-8)") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_toml_text(path: Path | str, error: type[MeasureError]) -> str:
    """The text of a file of settings (TOML, YAML, JSON), which is small; see `read_text`."""
    return read_text(path, error, _MAX_TOML_BYTES)


def parse_toml(text: str) -> dict[str, Any]:
    """The values of a TOML text; TOMLDecodeError if it is none, or is nested beyond reason."""
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise tomllib.TOMLDecodeError(_TOO_DEEP) from None
    except ValueError:
        raise tomllib.TOMLDecodeError("A number has too many digits") from None
    if _is_deeper(values, _MAX_TOML_DEPTH):
        raise tomllib.TOMLDecodeError(_TOO_DEEP)
    return values


def _is_deeper(values: Any, most: int) -> bool:
    """Whether tables and lists stand in each other more than so many times."""
    level = [values]
    for _ in range(most):
        level = [
            inner
            for outer in level
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, dict | list)
        ]
        if not level:
            return False
    return True


LARGEST = 1e9
"""Of a length or coefficient in a file: a millionth of a million km, and no product of a few of
them overflows."""


def check_numbers(values: Any, most: float = LARGEST) -> None:
    """Refuse (ValueError) what a file holds in place of finite numbers within +- `most`.

    Lists and tables of numbers are gone through; a truth value or a text is no number.
    """
    if isinstance(values, Mapping):
        values = list(values.values())
    if isinstance(values, list | tuple):
        for value in values:
            check_numbers(value, most)
    elif isinstance(values, bool | str):
        raise ValueError(f"expected a number, got {values!r:.40}")
    elif isinstance(values, int | float) and not abs(values) <= most:
        raise ValueError(f"expected a finite number within {most:g}, got {values!r:.20}")


class FileModel(BaseModel):
    """Base of what is read from a file: frozen, a misspelt key is an error, numbers are numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _holds_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        name = str(info.field_name)
        _check_field(name, cls.model_fields[name].annotation, value)
        return value


def _check_field(name: str, annotation: Any, value: Any) -> None:
    """Hold a field of a file to `check_numbers`, if its type says that it holds numbers alone.

    Seconds (`_s`) have bounds of their own, as those since 1970 are beyond 1e9; covariances are
    squares.
    """
    if _kinds(annotation) <= {int, float, NoneType}:
        squared = LARGEST**2 if name.endswith("covariance") else LARGEST
        check_numbers(value, float("inf") if name.endswith("_s") else squared)


@cache
def _kinds(annotation: Any) -> frozenset[Any]:
    """The types of the single values that a field of this type holds."""
    inner = get_args(annotation)
    if get_origin(annotation) is Annotated:
        inner = inner[:1]
    elif get_origin(annotation) is dict:
        inner = inner[1:]
    parts = [_kinds(part) for part in inner if part is not Ellipsis]
    return frozenset().union(*parts) if parts else frozenset([annotation])


def missing_message(path: Path) -> str:
    """Why `path` cannot be found: the first folder that is not there, or the names that are."""
    folder, what = path.parent, "no such file" if path.suffix else "no such file or folder"
    if not folder.is_dir():
        return f"{path}: {what}; the folder {folder} does not exist either"
    if path.is_symlink():
        return f"{path}: {what}: it is a link to what does not exist"
    try:
        every = sorted(entry.name for entry in folder.iterdir())
    except OSError:
        return f"{path}: {what}"
    names = [name for name in every if not name.startswith(".")]  # an output that is begun is
    near = difflib.get_close_matches(path.name, names, n=3, cutoff=0.7)
    if near:
        return f"{path}: {what}; did you mean {' or '.join(near)}?"
    return f"{path}: {what}; {folder} holds {listed(names)}"


def listed(names: Sequence[str]) -> str:
    """The first of some names, as a message shows them."""
    shown = ", ".join(names[:MOST_LISTED]) + (", ..." if len(names) > MOST_LISTED else "")
    return shown or "nothing"


def _reason(problem: Exception) -> str:
    return getattr(problem, "strerror", None) or str(problem)
