"""Targets as printable sheets: vector shapes in millimetres, at their true size, as PDF or SVG."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

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

_PAPERS_MM = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
}
_POINTS_PER_MM = 72 / 25.4
_FONT = "Helvetica"
BAR_MM = 100.0  # Length of the scale bar, which has a tick every 10 mm
MARGIN_MM = 8.0
FOOTER_MM = 16.0


@dataclass(frozen=True)
class Rectangle:
    """A filled rectangle: left, top, width, height in mm, y downwards."""

    x: float
    y: float
    width: float
    height: float
    black: bool = True


@dataclass(frozen=True)
class Disc:
    """A circle: centre and radius in mm, filled or a hairline."""

    x: float
    y: float
    radius: float
    filled: bool = True


@dataclass(frozen=True)
class Segment:
    """A line in mm: where it begins, and how far it goes."""

    x: float
    y: float
    dx: float
    dy: float
    width: float = 0.2


@dataclass(frozen=True)
class Label:
    """Text, its baseline's left end in mm."""

    x: float
    y: float
    text: str
    height: float = 3.0


Shape = Rectangle | Disc | Segment | Label


@dataclass(frozen=True)
class Sheet:
    """A page: size in mm, origin at the top left, y downwards; later shapes lie on earlier ones."""

    size_mm: tuple[float, float]
    paper: str  # its name, "A4" and so on, or "" if none fits
    origin_mm: tuple[float, float]  # where the target's own origin came to lie
    shapes: tuple[Shape, ...] = field(default=())
    note: str = ""  # what to know before it is used, or ""


def lay_out(
    shapes: list[Shape], size_mm: tuple[float, float], origin_mm: tuple[float, float], text: str
) -> Sheet:
    """Put a drawing, in mm from its top left corner, on the smallest paper, with a scale bar."""
    wanted = (size_mm[0] + 2 * MARGIN_MM, size_mm[1] + MARGIN_MM + FOOTER_MM)
    paper, page = "", wanted
    for name, (short, long) in _PAPERS_MM.items():
        fitting = [
            p for p in ((short, long), (long, short)) if p[0] >= wanted[0] and p[1] >= wanted[1]
        ]
        if fitting:
            paper, page = name, fitting[0]
            break
    left = (page[0] - size_mm[0]) / 2
    top = MARGIN_MM + (page[1] - wanted[1]) / 2
    moved = [replace(shape, x=shape.x + left, y=shape.y + top) for shape in shapes]
    hint = f"Print at 100 %: the bar must measure {BAR_MM:.0f} mm; measure the drawing too."
    at, line = MARGIN_MM + BAR_MM + 6, page[1] - FOOTER_MM / 2
    footer: list[Shape] = [Segment(MARGIN_MM, line, BAR_MM, 0)]
    for tick in range(0, int(BAR_MM) + 1, 10):
        footer += [Segment(MARGIN_MM + tick, line, 0, -2.5 if tick % 50 == 0 else -1.5)]
    footer += [_fitted(Label(at, line - 2, text, 2.6), page[0] - MARGIN_MM)]
    footer += [_fitted(Label(at, line + 2, hint, 2.6), page[0] - MARGIN_MM)]
    origin = (origin_mm[0] + left, origin_mm[1] + top)
    return Sheet(page, paper, origin, (*moved, *footer))


def _fitted(label: Label, right: float) -> Label:
    """The label, smaller if it would reach past `right`."""
    from reportlab.pdfbase.pdfmetrics import stringWidth

    width = stringWidth(label.text, _FONT, label.height)
    return replace(label, height=label.height * min(1.0, (right - label.x) / max(width, 1e-9)))


def write_sheet(sheet: Sheet, path: Path) -> None:
    """Write a PDF or an SVG, by the path's ending; ConfigError for another."""
    if path.suffix.lower() == ".pdf":
        _write_pdf(sheet, path)
    elif path.suffix.lower() == ".svg":
        path.write_text(svg(sheet), encoding="utf-8")
    else:
        raise ConfigError(f"{path}: a target is written as .pdf or .svg")


def svg(sheet: Sheet) -> str:
    """The sheet as SVG, one user unit a millimetre."""
    width, height = sheet.size_mm
    body = "\n".join(_svg_shape(shape) for shape in sheet.shapes)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}mm" height="{height:g}mm" '
        f'viewBox="0 0 {width:g} {height:g}">\n'
        f'<rect width="{width:g}" height="{height:g}" fill="white"/>\n{body}\n</svg>\n'
    )


def _svg_shape(shape: Shape) -> str:
    if isinstance(shape, Rectangle):
        fill = "black" if shape.black else "white"
        return (
            f'<rect x="{shape.x:.4f}" y="{shape.y:.4f}" width="{shape.width:.4f}" '
            f'height="{shape.height:.4f}" fill="{fill}" shape-rendering="crispEdges"/>'
        )
    if isinstance(shape, Disc):
        style = 'fill="black"' if shape.filled else 'fill="none" stroke="black" stroke-width="0.2"'
        return f'<circle cx="{shape.x:.4f}" cy="{shape.y:.4f}" r="{shape.radius:.4f}" {style}/>'
    if isinstance(shape, Segment):
        return (
            f'<line x1="{shape.x:.4f}" y1="{shape.y:.4f}" x2="{shape.x + shape.dx:.4f}" '
            f'y2="{shape.y + shape.dy:.4f}" stroke="black" stroke-width="{shape.width:g}"/>'
        )
    return (
        f'<text x="{shape.x:.3f}" y="{shape.y:.3f}" font-family="{_FONT},Arial,sans-serif" '
        f'font-size="{shape.height:g}">{escape(shape.text)}</text>'
    )


def _write_pdf(sheet: Sheet, path: Path) -> None:
    from reportlab.pdfgen.canvas import Canvas

    width, height = sheet.size_mm
    size = (width * _POINTS_PER_MM, height * _POINTS_PER_MM)
    canvas = Canvas(str(path), pagesize=size, invariant=1)
    canvas.scale(_POINTS_PER_MM, _POINTS_PER_MM)
    for shape in sheet.shapes:
        if isinstance(shape, Rectangle):
            level = 0.0 if shape.black else 1.0
            canvas.setFillGray(level)
            bottom = height - shape.y - shape.height
            canvas.rect(shape.x, bottom, shape.width, shape.height, stroke=0, fill=1)
        elif isinstance(shape, Disc):
            canvas.setFillGray(0.0)
            canvas.setLineWidth(0.2)
            canvas.circle(
                shape.x, height - shape.y, shape.radius, stroke=not shape.filled, fill=shape.filled
            )
        elif isinstance(shape, Segment):
            canvas.setLineWidth(shape.width)
            bottom = height - shape.y
            canvas.line(shape.x, bottom, shape.x + shape.dx, bottom - shape.dy)
        else:
            canvas.setFillGray(0.0)
            text = shape.text.encode("cp1252", "replace").decode("cp1252")  # what the font holds
            canvas.setFont(_FONT, shape.height)
            canvas.drawString(shape.x, height - shape.y, text)
    canvas.save()


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
