"""Targets as files: boards, marker fields and their true sizes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import cv2
import numpy as np
import yaml
from pydantic import (
    AfterValidator,
    Field,
    FiniteFloat,
    ValidationError,
    field_validator,
    model_validator,
)

from measure.arrays import Floats
from measure.calibration.boards import (
    AprilGrid,
    Board,
    Charuco,
    Chessboard,
    Stretched,
    aruco_dictionary,
)
from measure.errors import CalibrationError
from measure.reading import read_text
from measure.session import FileModel, Length, Name, Position, load_toml
from measure.tables import read_number_table

Count = Annotated[int, Field(ge=2, le=100)]


def _exact_or_known(tolerance: float) -> float:
    if 0 < tolerance < _MIN_TOLERANCE:
        raise ValueError(f"{tolerance:g} is finer than can be measured: 0 says exact")
    return tolerance


_MIN_TOLERANCE = 1e-6
Tolerance = Annotated[FiniteFloat, Field(ge=0, le=1e6), AfterValidator(_exact_or_known)]
"""A standard deviation in mm or degrees; 0 is exact."""


Squares = Length | tuple[Length, Length]
"""Side of a square in mm, or its two sides along x and along y."""


class BoardFile(FileModel):
    """A board, and what it is called."""

    made: ClassVar[Callable[..., Board]]
    kind: str
    name: str

    def board(self) -> Board:
        """The board described."""
        given = self.model_dump(exclude={"kind", "name"})
        along_x, along_y = np.broadcast_to(given.get("square_mm", 1.0), 2).tolist()
        if along_x == along_y:
            return type(self).made(**given)
        return Stretched(type(self).made(**given | {"square_mm": along_x}), (1, along_y / along_x))


class ChessboardFile(BoardFile):
    """`kind = "chessboard"`."""

    made = Chessboard
    kind: Literal["chessboard"]
    name: str = "chessboard"
    inner_corners: tuple[Count, Count]
    square_mm: Squares


class CharucoFile(BoardFile):
    """`kind = "charuco"`."""

    made = Charuco
    kind: Literal["charuco"]
    name: str = "charuco"
    inner_corners: tuple[Count, Count]
    square_mm: Squares
    marker_mm: Length
    dictionary: str = "DICT_4X4_100"
    inverted: bool = False
    legacy: bool = False
    first_marker: Annotated[int, Field(ge=0)] = 0

    @field_validator("dictionary")
    @classmethod
    def _known(cls, value: str) -> str:
        if not (value.startswith("DICT_") and hasattr(cv2.aruco, value)):
            raise ValueError(
                f"OpenCV has no dictionary {value}; there is DICT_4X4_100 and the like"
            )
        return value

    @model_validator(mode="after")
    def _fits(self) -> CharucoFile:
        side_mm = np.min(np.asarray(self.square_mm, np.float32))  # as OpenCV takes them
        if np.float32(self.marker_mm) >= side_mm:
            raise ValueError("marker_mm must be smaller than square_mm")
        columns, rows = self.inner_corners
        needed = self.first_marker + (columns + 1) * (rows + 1) // 2
        held = len(aruco_dictionary(self.dictionary).bytesList)
        if needed > held:
            raise ValueError(
                f"the board needs {needed} markers, {self.dictionary} holds {held}: take a larger "
                "dictionary"
            )
        return self


class AprilGridFile(BoardFile):
    """`kind = "aprilgrid"`."""

    made = AprilGrid
    kind: Literal["aprilgrid"]
    name: str = "AprilGrid"
    tags: tuple[Count, Count]
    tag_mm: Length
    tag_spacing: Annotated[FiniteFloat, Field(gt=0, le=2)]

    @field_validator("tags")
    @classmethod
    def _in_family(cls, value: tuple[int, int]) -> tuple[int, int]:
        if value[0] * value[1] > _TAGS_36H11:
            raise ValueError(f"{value[0]}x{value[1]} tags: the family 36h11 has {_TAGS_36H11}")
        return value


_TAGS_36H11 = 587
_BOARD_FILES: dict[str, type[BoardFile]] = {
    "chessboard": ChessboardFile,
    "charuco": CharucoFile,
    "aprilgrid": AprilGridFile,
}


class MarkerRow(FileModel):
    """One marker of a field."""

    name: Name
    position_mm: Position


class MarkerFieldFile(FileModel):
    """`kind = "markers"`: dots at known places; `dot_mm` is their diameter."""

    kind: Literal["markers"]
    name: str = "markers"
    dot_mm: Length = 4.0
    tolerance_mm: Tolerance = 0.1
    markers: Annotated[list[MarkerRow], Field(min_length=1)]


@dataclass(frozen=True, eq=False)
class MarkerField:
    """Markers of known place."""

    names: tuple[str, ...] = ()
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (k, 3) in the world, mm
    tolerance_mm: float = 0.1  # standard deviation of each coordinate

    def index(self, name: str) -> int:
        """Position of the marker called `name`."""
        return self.names.index(name)


def read_board(path: Path) -> Board:
    """The board in a TOML file, or in a YAML file of Kalibr's; CalibrationError with the line."""
    return read_board_file(path).board()


def read_board_file(path: Path) -> BoardFile:
    """The same as the file has it, with its name."""
    if path.suffix.lower() in (".yaml", ".yml"):
        return _kalibr_target(path)
    kind = kind_of(path)
    if kind not in _BOARD_FILES:
        raise CalibrationError(
            f'{path}: kind = "{kind}" is no board; there is {", ".join(_BOARD_FILES)}'
        )
    return load_toml(path, _BOARD_FILES[kind], CalibrationError)


def _kalibr_target(path: Path) -> BoardFile:
    """Kalibr's aprilgrid or checkerboard, whose lengths are in metres."""
    try:
        values = yaml.safe_load(read_text(path, CalibrationError))
        kind = values["target_type"]
        given: dict[str, Any] = {"name": path.stem}
        if kind == "aprilgrid":
            given |= {"kind": kind, "tags": (values["tagCols"], values["tagRows"])}
            given |= {
                "tag_mm": 1000 * float(values["tagSize"]),
                "tag_spacing": values["tagSpacing"],
            }
            return AprilGridFile.model_validate(given)
        if kind == "checkerboard" and values["rowSpacingMeters"] == values["colSpacingMeters"]:
            given |= {"kind": "chessboard", "square_mm": 1000 * float(values["rowSpacingMeters"])}
            given["inner_corners"] = values["targetCols"], values["targetRows"]
            return ChessboardFile.model_validate(given)
    except (yaml.YAMLError, RecursionError, KeyError, TypeError, ValueError) as problem:
        said = problem.errors()[0]["msg"] if isinstance(problem, ValidationError) else str(problem)
        raise CalibrationError(
            f"{path}: not a target as Kalibr writes it: {said.splitlines()[0][:80]}"
        ) from None
    raise CalibrationError(
        f"{path}: a target of type '{kind}' is not read; of Kalibr's aprilgrid and checkerboard "
        "(of squares) are"
    )


class _KindOnly(FileModel):
    model_config = FileModel.model_config | {"extra": "ignore"}

    kind: str = "body"


def kind_of(path: Path) -> str:
    """What a target file describes; "body" where it names no kind."""
    return load_toml(path, _KindOnly, CalibrationError).kind


def read_markers(path: Path, tolerance_mm: float | None = None) -> MarkerField:
    """Markers from a CSV (name,x_mm,y_mm,z_mm) or a target TOML; CalibrationError with the line."""
    if path.suffix == ".toml":
        given = load_toml(path, MarkerFieldFile, CalibrationError)
        names = tuple(row.name for row in given.markers)
        points = np.array([row.position_mm for row in given.markers])
        stated = given.tolerance_mm if tolerance_mm is None else tolerance_mm
    else:
        rows = _read_rows(path, ("name",), ("x_mm", "y_mm", "z_mm"))
        names = tuple(name for _, (name,), _ in rows)
        points = np.stack([place for *_, place in rows])
        stated = 0.1 if tolerance_mm is None else tolerance_mm
    for name in names:
        if names.count(name) > 1:
            raise CalibrationError(f"{path}: marker '{name}' is there {names.count(name)} times")
    return MarkerField(names, points, stated)


def read_marks(path: Path, markers: MarkerField) -> dict[str, dict[str, Floats]]:
    """Hand marks (camera,name,u_px,v_px) by both names, (2,) px; CalibrationError with line."""
    marks: dict[str, dict[str, Floats]] = {}
    for line, (camera, name), pixel in _read_rows(path, ("camera", "name"), ("u_px", "v_px")):
        if name not in markers.names:
            raise CalibrationError(
                f"{path}:{line}: no marker is called '{name}'; there is {', '.join(markers.names)}"
            )
        if name in marks.setdefault(camera, {}):
            raise CalibrationError(f"{path}:{line}: {camera} marks '{name}' twice")
        marks[camera][name] = pixel
    return marks


def _read_rows(
    path: Path, words: tuple[str, ...], numbers: tuple[str, ...]
) -> list[tuple[int, tuple[str, ...], Floats]]:
    """Line, words and finite numbers of each row of a table; CalibrationError otherwise."""
    table = read_number_table(path, numbers, error=CalibrationError, words=words)
    values = np.column_stack([table.columns[name] for name in numbers])
    for i in np.flatnonzero(~np.isfinite(values).all(axis=1)):
        raise CalibrationError(f"{path}:{table.lines[i]}: {','.join(numbers)} must be finite")
    texts = zip(*(table.words[name] for name in words), strict=True)
    return list(zip(table.lines, texts, values, strict=True))
