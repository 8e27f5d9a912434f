"""Targets as printable sheets: what stands in a target's TOML, at its true size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Bytes
from measure.calibration.boards import (
    BORDER_BITS,
    DICTIONARY,
    AprilGrid,
    Charuco,
    Chessboard,
    aruco_dictionary,
    same_after,
)
from measure.calibration.drawing import Disc, Label, Rectangle, Segment, Shape, Sheet, lay_out
from measure.calibration.targets import (
    MarkerField,
    MarkerFieldFile,
    kind_of,
    read_board_file,
    read_markers,
)
from measure.errors import CalibrationError, ConfigError
from measure.model import Body
from measure.session import load_toml, read_body

_CROSS_MM = 6.0


def target_sheet(path: Path) -> Sheet:
    """The sheet of a target file: a board, marker field or body; raises if it cannot be used."""
    kind = "aprilgrid" if path.suffix.lower() in (".yaml", ".yml") else kind_of(path)
    if kind in _SHEETS:
        given = read_board_file(path)
        return _SHEETS[given.kind](given.board(), given.name)
    if kind == "markers":
        field = load_toml(path, MarkerFieldFile, CalibrationError)
        return marker_sheet(read_markers(path), field.name, field.dot_mm)
    if kind == "body":
        return body_sheet(read_body(path))
    raise ConfigError(
        f'{path}: kind = "{kind}" cannot be drawn; there is chessboard, charuco, markers, and '
        "bodies (no kind)"
    )


def chessboard_sheet(board: Chessboard, name: str) -> Sheet:
    """Squares, black at the top left: the one diagonal to the origin."""
    columns, rows = (n + 1 for n in board.inner_corners)
    side = board.square_mm
    shapes: list[Shape] = [
        Rectangle(x * side, y * side, side, side)
        for y in range(rows)
        for x in range(columns)
        if (x + y) % 2 == 0
    ]
    text = f"{name}: {board.inner_corners[0]} x {board.inner_corners[1]} inner corners, {side:g} mm"
    note = ""
    if len(board.turns) > 1:
        note = (
            f"{same_after(board)}: no picture shows which corner is its origin; take one with an "
            "odd and an even number of inner corners, or a ChArUco board"
        )
    sheet = lay_out(shapes, (columns * side, rows * side), (side, side), text)
    return replace(sheet, note=note)


def charuco_sheet(board: Charuco, name: str) -> Sheet:
    """Squares with markers in the white ones, as OpenCV places and numbers them."""
    (columns, rows), side = board.squares, board.square_mm
    size = (columns * side, rows * side)
    with_marker, dictionary = set(), board.pattern.getDictionary()
    markers: list[Shape] = []
    for number, corners in zip(
        np.ravel(board.pattern.getIds()), board.pattern.getObjPoints(), strict=True
    ):
        left, top = np.asarray(corners, dtype=np.float64).reshape(4, 3)[:, :2].min(axis=0)
        with_marker.add((int(left // side), int(top // side)))
        bits = np.asarray(dictionary.generateImageMarker(int(number), dictionary.markerSize + 2))
        markers += _cells(bits, float(left), float(top), board.marker_mm, not board.inverted)
    shapes: list[Shape] = [Rectangle(0, 0, *size, black=False)]
    if board.inverted:
        shapes = [Rectangle(-4, -4, size[0] + 8, size[1] + 8)]
    shapes += [
        Rectangle(x * side, y * side, side, side, black=not board.inverted)
        for y in range(rows)
        for x in range(columns)
        if (x, y) not in with_marker
    ]
    text = f"{name}: {side:g} mm squares, {board.marker_mm:g} mm markers, {board.dictionary}"
    return lay_out([*shapes, *markers], size, (side, side), text)


def _cells(bits: Bytes, left: float, top: float, side: float, black: bool = True) -> list[Shape]:
    """The light cells (n, n) of a marker on a box of the other colour."""
    cell = side / len(bits)
    return [
        Rectangle(left, top, side, side, black),
        *(
            Rectangle(left + x * cell, top + y * cell, cell, cell, not black)
            for y, x in zip(*np.nonzero(bits), strict=True)
        ),
    ]


def aprilgrid_sheet(board: AprilGrid, name: str) -> Sheet:
    """Tags as Kalibr prints them, with the small squares that make their corners sharp."""
    (columns, rows), side = board.tags, board.tag_mm
    gap = side * board.tag_spacing
    pitch, size = side + gap, (columns * (side + gap) + gap, rows * (side + gap) + gap)
    shapes: list[Shape] = [
        Rectangle(column * pitch, row * pitch, gap, gap)
        for row in range(rows + 1)
        for column in range(columns + 1)
    ]
    dictionary = aruco_dictionary(DICTIONARY)
    cells = dictionary.markerSize + 2 * BORDER_BITS
    for number, (x, y, _) in enumerate(board.points[::4].tolist()):
        tag = dictionary.generateImageMarker(number, cells, borderBits=BORDER_BITS)
        shapes += _cells(np.rot90(np.asarray(tag), 2), x + gap, y + gap, side)
    text = f"{name}: {columns} x {rows} tags of 36h11, {side:g} mm, spacing {board.tag_spacing:g}"
    return lay_out(shapes, size, (gap, gap), text)


def marker_sheet(field: MarkerField, name: str, dot_mm: float) -> Sheet:
    """Where the posts stand, from above: a cross and a dot of true size at each place, x right."""
    low = field.points.min(axis=0) - 15
    high = field.points.max(axis=0) + 15
    size = (float(high[0] - low[0]), float(high[1] - low[1]))
    origin = (float(-low[0]), float(high[1]))
    shapes: list[Shape] = []
    if 0 <= origin[0] <= size[0] and 0 <= origin[1] <= size[1]:
        shapes += _cross(*origin, 10.0)
        shapes.append(Label(origin[0] + 2, origin[1] - 2, "world origin: x right, y up"))
    else:
        x, y, _ = field.points[0]
        text = f"x right, y up; {field.names[0]} stands at x = {x:g}, y = {y:g} mm"
        shapes.append(Label(2, 4, text, 2.2))
    labels: dict[tuple[float, float], list[str]] = {}
    for marker, (x, y, z) in zip(field.names, field.points.tolist(), strict=True):
        labels.setdefault((origin[0] + x, origin[1] - y), []).append(f"{marker} z={z:g}")
    for (x, y), texts in labels.items():
        shapes += _cross(x, y, _CROSS_MM)
        shapes.append(Disc(x, y, dot_mm / 2))
        shapes.append(Label(x - 12, y + 8, ", ".join(texts), 2.2))
    return lay_out(shapes, size, origin, name)


def body_sheet(body: Body) -> Sheet:
    """The balls' outlines and centres in the body's x-y plane, x right, y up."""
    low = (body.centers[:, :2] - body.radii[:, None]).min(axis=0) - 10
    high = (body.centers[:, :2] + body.radii[:, None]).max(axis=0) + 10
    low, high = np.minimum(low, -12), np.maximum(high, 12)
    size = (float(high[0] - low[0]), float(high[1] - low[1]))
    origin = (float(-low[0]), float(high[1]))
    shapes: list[Shape] = _cross(*origin, 10.0)
    shapes.append(Label(origin[0] + 2, origin[1] + 6, "origin"))
    for ball in body.balls:
        x, y = origin[0] + float(ball.center_mm[0]), origin[1] - float(ball.center_mm[1])
        shapes.append(Disc(x, y, ball.radius_mm, filled=False))
        shapes += _cross(x, y, _CROSS_MM)
        text = f"{ball.name}: diameter {2 * ball.radius_mm:g} mm, z = {ball.center_mm[2]:g} mm"
        shapes.append(Label(x - ball.radius_mm * 0.8, y - 3, text, 2.0))
    return lay_out(shapes, size, origin, body.name)


def _cross(x: float, y: float, reach: float) -> list[Shape]:
    return [Segment(x - reach, y, 2 * reach, 0), Segment(x, y - reach, 0, 2 * reach)]


_SHEETS: dict[str, Callable[[Any, str], Sheet]] = {
    "chessboard": chessboard_sheet,
    "charuco": charuco_sheet,
    "aprilgrid": aprilgrid_sheet,
}
