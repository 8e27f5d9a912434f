"""Targets as printable sheets: vector shapes in millimetres, at their true size, as PDF or SVG."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from measure.arrays import Bytes
from measure.calibration import boards, targets
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
_FOOTER_TEXT_MM = 2.6
_LINE_MM = 0.2


@dataclass(frozen=True)
class Shape:
    """An element of SVG (rect, circle, line or text), in mm, y downwards."""

    tag: str
    place: dict[str, float]  # attributes: where it is and how large
    style: dict[str, str]  # attributes: how it looks
    text: str = ""

    def moved(self, left: float, top: float) -> Shape:
        """The same elsewhere."""
        shift = {"x": left, "y": top}
        place = {key: v + shift.get(key.strip("c12"), 0.0) for key, v in self.place.items()}
        return replace(self, place=place)


def box(x: float, y: float, width: float, height: float, black: bool = True) -> Shape:
    """A filled rectangle, from its top left corner."""
    style = {"fill": "black" if black else "white", "shape-rendering": "crispEdges"}
    return Shape("rect", {"x": x, "y": y, "width": width, "height": height}, style)


def disc(x: float, y: float, radius: float, filled: bool = True) -> Shape:
    """A circle about its centre, filled or a hairline."""
    style = {"fill": "black" if filled else "none", "stroke": "none" if filled else "black"}
    return Shape("circle", {"cx": x, "cy": y, "r": radius}, style | {"stroke-width": f"{_LINE_MM}"})


def line(x: float, y: float, dx: float, dy: float) -> Shape:
    """A line from a place, so far."""
    place = {"x1": x, "y1": y, "x2": x + dx, "y2": y + dy}
    return Shape("line", place, {"stroke": "black", "stroke-width": f"{_LINE_MM}"})


def label(x: float, y: float, text: str, height: float = 3.0) -> Shape:
    """Text, from its baseline's left end."""
    style = {"font-family": f"{_FONT},Arial,sans-serif"}
    return Shape("text", {"x": x, "y": y, "font-size": height}, style, text)


@dataclass(frozen=True)
class Sheet:
    """A page: size in mm, origin at the top left, y downwards; later shapes lie on earlier ones."""

    size_mm: tuple[float, float]
    paper: str  # its name, "A4" and so on, or "" if none fits
    origin_mm: tuple[float, float]  # where the target's own origin came to lie
    shapes: tuple[Shape, ...]
    note: str = ""  # what to know before it is used, or ""


def lay_out(
    shapes: list[Shape], size_mm: tuple[float, float], origin_mm: tuple[float, float], text: str
) -> Sheet:
    """Put a drawing, in mm from its top left corner, on the smallest paper, with a scale bar."""
    wanted = (size_mm[0] + 2 * MARGIN_MM, size_mm[1] + MARGIN_MM + FOOTER_MM)
    paper, page = "", wanted
    for name, sides in _PAPERS_MM.items():
        fitting = [p for p in (sides, sides[::-1]) if p[0] >= wanted[0] and p[1] >= wanted[1]]
        if fitting:
            paper, page = name, fitting[0]
            break
    left = (page[0] - size_mm[0]) / 2
    top = MARGIN_MM + (page[1] - wanted[1]) / 2
    hint = f"Print at 100 %: the bar must measure {BAR_MM:.0f} mm; measure the drawing too."
    at, bar = MARGIN_MM + BAR_MM + 6, page[1] - FOOTER_MM / 2
    footer = [line(MARGIN_MM, bar, BAR_MM, 0)]
    for tick in range(0, int(BAR_MM) + 1, 10):
        footer += [line(MARGIN_MM + tick, bar, 0, -2.5 if tick % 50 == 0 else -1.5)]
    footer += [_fitted(at, bar - 2, text, page[0] - MARGIN_MM)]
    footer += [_fitted(at, bar + 2, hint, page[0] - MARGIN_MM)]
    origin = (origin_mm[0] + left, origin_mm[1] + top)
    return Sheet(page, paper, origin, (*(shape.moved(left, top) for shape in shapes), *footer))


def _fitted(x: float, y: float, text: str, right: float) -> Shape:
    """A label of the footer, smaller if it would reach past `right`."""
    from reportlab.pdfbase.pdfmetrics import stringWidth

    width = stringWidth(text, _FONT, _FOOTER_TEXT_MM)
    return label(x, y, text, _FOOTER_TEXT_MM * min(1.0, (right - x) / max(width, 1e-9)))


def write_sheet(sheet: Sheet, path: Path) -> None:
    """Write a PDF or an SVG, by the path's ending; ConfigError for another."""
    if path.suffix.lower() == ".pdf":
        _write_pdf(sheet, path)
    elif path.suffix.lower() == ".svg":
        path.write_text(_svg(sheet), encoding="utf-8")
    else:
        raise ConfigError(f"{path}: a target is written as .pdf or .svg")


def _svg(sheet: Sheet) -> str:
    """The sheet as SVG, one user unit a millimetre."""
    width, height = sheet.size_mm
    page = f'width="{width:g}mm" height="{height:g}mm" viewBox="0 0 {width:g} {height:g}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {page}>',
        f'<rect width="{width:g}" height="{height:g}" fill="white"/>',
    ]
    for shape in sheet.shapes:
        attributes = {key: f"{v:.4f}" for key, v in shape.place.items()} | shape.style
        said = " ".join(f'{key}="{value}"' for key, value in attributes.items())
        lines.append(f"<{shape.tag} {said}>{escape(shape.text)}</{shape.tag}>")
    return "\n".join([*lines, "</svg>", ""])


def _write_pdf(sheet: Sheet, path: Path) -> None:
    from reportlab.pdfgen.canvas import Canvas

    width, height = sheet.size_mm
    size = (width * _POINTS_PER_MM, height * _POINTS_PER_MM)
    canvas = Canvas(str(path), pagesize=size, invariant=1)
    canvas.scale(_POINTS_PER_MM, _POINTS_PER_MM)
    canvas.setLineWidth(_LINE_MM)
    for shape in sheet.shapes:
        at, fill = shape.place, shape.style.get("fill", "black")
        canvas.setFillGray(1.0 if fill == "white" else 0.0)
        if shape.tag == "rect":
            bottom = height - at["y"] - at["height"]
            canvas.rect(at["x"], bottom, at["width"], at["height"], stroke=0, fill=1)
        elif shape.tag == "circle":
            hollow = fill == "none"
            canvas.circle(at["cx"], height - at["cy"], at["r"], stroke=hollow, fill=not hollow)
        elif shape.tag == "line":
            canvas.line(at["x1"], height - at["y1"], at["x2"], height - at["y2"])
        else:
            text = shape.text.encode("cp1252", "replace").decode("cp1252")  # what the font holds
            canvas.setFont(_FONT, at["font-size"])
            canvas.drawString(at["x"], height - at["y"], text)
    canvas.save()


_CROSS_MM = 6.0


def target_sheet(path: Path) -> Sheet:
    """The sheet of a target file: a board, marker field or body; raises if it cannot be used."""
    kind = "aprilgrid" if path.suffix.lower() in (".yaml", ".yml") else targets.kind_of(path)
    if kind in _SHEETS:
        given = targets.read_board_file(path)
        return _SHEETS[given.kind](given.board(), given.name)
    if kind == "markers":
        field = load_toml(path, targets.MarkerFieldFile, CalibrationError)
        return marker_sheet(targets.read_markers(path), field.name, field.dot_mm)
    if kind == "body":
        return body_sheet(read_body(path))
    raise ConfigError(
        f'{path}: kind = "{kind}" cannot be drawn; there is chessboard, charuco, markers, and '
        "bodies (no kind)"
    )


def chessboard_sheet(board: boards.Chessboard, name: str) -> Sheet:
    """Squares, black at the top left: the one diagonal to the origin."""
    columns, rows = (n + 1 for n in board.inner_corners)
    side = board.square_mm
    shapes: list[Shape] = [
        box(x * side, y * side, side, side)
        for y in range(rows)
        for x in range(columns)
        if (x + y) % 2 == 0
    ]
    text = f"{name}: {boards.in_squares(board.inner_corners)}, {side:g} mm"
    note = ""
    if len(board.turns) > 1:
        note = (
            f"{boards.same_after(board)}: no picture shows which corner is its origin; take one "
            "with an odd and an even number of squares, or a ChArUco board"
        )
    sheet = lay_out(shapes, (columns * side, rows * side), (side, side), text)
    return replace(sheet, note=note)


def charuco_sheet(board: boards.Charuco, name: str) -> Sheet:
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
    shapes: list[Shape] = [box(0, 0, size[0], size[1], black=False)]
    if board.inverted:
        shapes = [box(-4, -4, size[0] + 8, size[1] + 8)]
    shapes += [
        box(x * side, y * side, side, side, black=not board.inverted)
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
        box(left, top, side, side, black),
        *(
            box(left + x * cell, top + y * cell, cell, cell, not black)
            for y, x in zip(*np.nonzero(bits), strict=True)
        ),
    ]


def aprilgrid_sheet(board: boards.AprilGrid, name: str) -> Sheet:
    """Tags as Kalibr prints them, with the small squares that make their corners sharp."""
    (columns, rows), side = board.tags, board.tag_mm
    gap = side * board.tag_spacing
    pitch, size = side + gap, (columns * (side + gap) + gap, rows * (side + gap) + gap)
    shapes: list[Shape] = [
        box(column * pitch, row * pitch, gap, gap)
        for row in range(rows + 1)
        for column in range(columns + 1)
    ]
    dictionary = boards.aruco_dictionary(boards.DICTIONARY)
    cells = dictionary.markerSize + 2 * boards.BORDER_BITS
    for number, (x, y, _) in enumerate(board.points[::4].tolist()):
        tag = dictionary.generateImageMarker(number, cells, borderBits=boards.BORDER_BITS)
        shapes += _cells(np.rot90(np.asarray(tag), 2), x + gap, y + gap, side)
    text = f"{name}: {columns} x {rows} tags of 36h11, {side:g} mm, spacing {board.tag_spacing:g}"
    return lay_out(shapes, size, (gap, gap), text)


def marker_sheet(field: targets.MarkerField, name: str, dot_mm: float) -> Sheet:
    """Where the posts stand, from above: a cross and a dot of true size at each place, x right."""
    low = field.points.min(axis=0) - 15
    high = field.points.max(axis=0) + 15
    size = (float(high[0] - low[0]), float(high[1] - low[1]))
    origin = (float(-low[0]), float(high[1]))
    shapes: list[Shape] = []
    if 0 <= origin[0] <= size[0] and 0 <= origin[1] <= size[1]:
        shapes += _cross(origin[0], origin[1], 10.0)
        shapes.append(label(origin[0] + 2, origin[1] - 2, "world origin: x right, y up"))
    else:
        x, y, _ = field.points[0]
        text = f"x right, y up; {field.names[0]} stands at x = {x:g}, y = {y:g} mm"
        shapes.append(label(2, 4, text, 2.2))
    labels: dict[tuple[float, float], list[str]] = {}
    for marker, (x, y, z) in zip(field.names, field.points.tolist(), strict=True):
        labels.setdefault((origin[0] + x, origin[1] - y), []).append(f"{marker} z={z:g}")
    for (x, y), texts in labels.items():
        shapes += _cross(x, y, _CROSS_MM)
        shapes.append(disc(x, y, dot_mm / 2))
        shapes.append(label(x - 12, y + 8, ", ".join(texts), 2.2))
    return lay_out(shapes, size, origin, name)


def body_sheet(body: Body) -> Sheet:
    """The balls' outlines and centres in the body's x-y plane, x right, y up."""
    low = (body.centers[:, :2] - body.radii[:, None]).min(axis=0) - 10
    high = (body.centers[:, :2] + body.radii[:, None]).max(axis=0) + 10
    low, high = np.minimum(low, -12), np.maximum(high, 12)
    size = (float(high[0] - low[0]), float(high[1] - low[1]))
    origin = (float(-low[0]), float(high[1]))
    shapes: list[Shape] = _cross(origin[0], origin[1], 10.0)
    shapes.append(label(origin[0] + 2, origin[1] + 6, "origin"))
    for ball in body.balls:
        x, y = origin[0] + float(ball.center_mm[0]), origin[1] - float(ball.center_mm[1])
        shapes.append(disc(x, y, ball.radius_mm, filled=False))
        shapes += _cross(x, y, _CROSS_MM)
        text = f"{ball.name}: diameter {2 * ball.radius_mm:g} mm, z = {ball.center_mm[2]:g} mm"
        shapes.append(label(x - ball.radius_mm * 0.8, y - 3, text, 2.0))
    return lay_out(shapes, size, origin, body.name)


def _cross(x: float, y: float, reach: float) -> list[Shape]:
    return [line(x - reach, y, 2 * reach, 0), line(x, y - reach, 0, 2 * reach)]


_SHEETS: dict[str, Callable[[Any, str], Sheet]] = {
    "chessboard": chessboard_sheet,
    "charuco": charuco_sheet,
    "aprilgrid": aprilgrid_sheet,
}
