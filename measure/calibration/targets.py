"""Targets as files: boards, marker fields and their true sizes."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, field_validator, model_validator

from measure.arrays import Floats
from measure.calibration.boards import Board, Charuco, Chessboard
from measure.errors import CalibrationError
from measure.reading import read_text
from measure.session import FileModel, Length, Name, Position, load_toml

Count = Annotated[int, Field(ge=2, le=100)]


def _exact_or_known(tolerance: float) -> float:
    if 0 < tolerance < _MIN_TOLERANCE:
        raise ValueError(f"{tolerance:g} is finer than can be measured: 0 says exact")
    return tolerance


_MIN_TOLERANCE = 1e-6
Tolerance = Annotated[FiniteFloat, Field(ge=0, le=1e6), AfterValidator(_exact_or_known)]
"""A standard deviation in mm or degrees; 0 is exact."""


class ChessboardFile(FileModel):
    """`kind = "chessboard"`."""

    kind: Literal["chessboard"]
    name: str = "chessboard"
    inner_corners: tuple[Count, Count]
    square_mm: Length

    def board(self) -> Board:
        """The board described."""
        return Chessboard(self.inner_corners, self.square_mm)


class CharucoFile(FileModel):
    """`kind = "charuco"`."""

    kind: Literal["charuco"]
    name: str = "charuco"
    inner_corners: tuple[Count, Count]
    square_mm: Length
    marker_mm: Length
    dictionary: str = "DICT_4X4_100"
    inverted: bool = False
    legacy: bool = False

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
        if np.float32(self.marker_mm) >= np.float32(self.square_mm):  # as OpenCV takes them
            raise ValueError("marker_mm must be smaller than square_mm")
        columns, rows = self.inner_corners
        needed = (columns + 1) * (rows + 1) // 2
        held = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        if needed > held:
            raise ValueError(
                f"the board needs {needed} markers, {self.dictionary} holds {held}: take a larger "
                "dictionary"
            )
        return self

    def board(self) -> Board:
        """The board described."""
        return Charuco(
            self.inner_corners,
            self.square_mm,
            self.marker_mm,
            self.dictionary,
            self.inverted,
            self.legacy,
        )


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
    """Markers of known place.

    Attributes:
        names: of the markers.
        points: (k, 3) in the world, mm.
        tolerance_mm: standard deviation of each coordinate.
    """

    names: tuple[str, ...] = ()
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    tolerance_mm: float = 0.1

    def index(self, name: str) -> int:
        """Position of the marker called `name`."""
        return self.names.index(name)


def read_board(path: Path) -> Board:
    """The board in a TOML file.

    Raises:
        CalibrationError: with file, line and key.
    """
    kind = kind_of(path)
    if kind == "chessboard":
        return load_toml(path, ChessboardFile, CalibrationError).board()
    if kind == "charuco":
        return load_toml(path, CharucoFile, CalibrationError).board()
    raise CalibrationError(f'{path}: kind = "{kind}" is no board; there is chessboard and charuco')


class _KindOnly(FileModel):
    model_config = FileModel.model_config | {"extra": "ignore"}

    kind: str = "body"


def kind_of(path: Path) -> str:
    """What a target file describes: "chessboard", "charuco", "markers" or "body" (no kind)."""
    return load_toml(path, _KindOnly, CalibrationError).kind


def read_markers(path: Path, tolerance_mm: float | None = None) -> MarkerField:
    """Markers from a CSV (name,x_mm,y_mm,z_mm) or a target TOML of kind "markers".

    Raises:
        CalibrationError: with file and line.
    """
    if path.suffix == ".toml":
        given = load_toml(path, MarkerFieldFile, CalibrationError)
        names = tuple(row.name for row in given.markers)
        points = np.array([row.position_mm for row in given.markers])
        stated = given.tolerance_mm if tolerance_mm is None else tolerance_mm
    else:
        rows = read_rows(path, ("name", "x_mm", "y_mm", "z_mm"))
        names = tuple(row[0] for _, row in rows)
        points = np.array([_numbers(path, line, row[1:]) for line, row in rows]).reshape(-1, 3)
        stated = 0.1 if tolerance_mm is None else tolerance_mm
    for name in names:
        if names.count(name) > 1:
            raise CalibrationError(f"{path}: marker '{name}' is there {names.count(name)} times")
    return MarkerField(names, points, stated)


def read_marks(path: Path, markers: MarkerField) -> dict[str, dict[str, Floats]]:
    """Hand marks (camera,name,u_px,v_px): by camera and marker name, (2,) px.

    Raises:
        CalibrationError: with file and line; also for a marker that is not in the field.
    """
    marks: dict[str, dict[str, Floats]] = {}
    for line, (camera, name, *rest) in read_rows(path, ("camera", "name", "u_px", "v_px")):
        if name not in markers.names:
            raise CalibrationError(
                f"{path}:{line}: no marker is called '{name}'; there is {', '.join(markers.names)}"
            )
        if name in marks.setdefault(camera, {}):
            raise CalibrationError(f"{path}:{line}: {camera} marks '{name}' twice")
        marks[camera][name] = np.array(_numbers(path, line, rest))
    return marks


def read_rows(path: Path, columns: tuple[str, ...]) -> list[tuple[int, list[str]]]:
    """Lines of a CSV with exactly these columns: line number and cells.

    Raises:
        CalibrationError: missing file, wrong header, or a line of another length.
    """
    text = read_text(path, CalibrationError)
    lines = [(i, row) for i, row in enumerate(csv.reader(io.StringIO(text)), start=1) if row]
    if not lines or tuple(cell.strip() for cell in lines[0][1]) != columns:
        raise CalibrationError(f"{path}:1: expected the header {','.join(columns)}")
    for number, row in lines[1:]:
        if len(row) != len(columns):
            raise CalibrationError(
                f"{path}:{number}: expected {len(columns)} cells, got {len(row)}"
            )
    return [(number, [cell.strip() for cell in row]) for number, row in lines[1:]]


def _numbers(path: Path, line: int, cells: list[str]) -> list[float]:
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = [np.nan]
    if not np.all(np.isfinite(values)):
        raise CalibrationError(f"{path}:{line}: expected numbers, got {','.join(cells)}")
    return values
