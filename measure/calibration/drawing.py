"""A printable sheet in millimetres, as PDF or SVG: vector shapes at their true size."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.sax.saxutils import escape

from measure.errors import ConfigError

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
