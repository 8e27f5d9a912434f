"""Small drawings (SVG) that show what hands are to do; they take the page's colours."""

from __future__ import annotations

_HEAD = '<svg class="drawing" viewBox="0 0 {} {}" role="img" aria-label="{}">'


def _squares(columns: int, rows: int, side: float) -> str:
    """The black squares of a chessboard, its white ground first."""
    black = [
        f"M{side * x:g} {side * y:g}h{side:g}v{side:g}h{-side:g}z"
        for y in range(rows)
        for x in range(columns)
        if (x + y) % 2 == 0
    ]
    ground = f'<rect class="paper" width="{side * columns:g}" height="{side * rows:g}"/>'
    return f'{ground}<path class="ink" d="{"".join(black)}"/>'


def _camera(x: float, y: float, turn_deg: float) -> str:
    """A camera that looks to the right before it is turned."""
    return (
        f'<g transform="translate({x:g} {y:g}) rotate({turn_deg:g})">'
        '<rect class="thing" x="-14" y="-8" width="20" height="16" rx="3"/>'
        '<path class="thing" d="M6 -4l7 -4v16l-7 -4z"/></g>'
    )


def _arrow(path: str) -> str:
    return f'<path class="way-of" marker-end="url(#tip)" d="{path}"/>'


_TIP = (
    '<defs><marker id="tip" viewBox="0 0 8 8" refX="5" refY="4" markerWidth="5" markerHeight="5" '
    'orient="auto-start-reverse"><path class="tip" d="M0 0L8 4L0 8z"/></marker></defs>'
)
_HAND = (  # Four fingers behind what is held, and a thumb before it; an arm comes from below
    '<path class="skin" d="M0 0c6 -10 16 -16 28 -16h14c5 0 5 8 0 8h-10c10 0 16 2 16 6s-4 5 -8 5'
    'c4 1 5 8 0 9c2 2 1 7 -4 7h-14c-8 0 -12 8 -14 22h-22c2 -18 6 -31 14 -41z"/>'
)


def waving() -> str:
    """A hand that waves a board before two cameras, and tilts it."""
    board = f'<g transform="translate(92 26) rotate(-12) skewX(-8)">{_squares(8, 6, 10)}</g>'
    hand = f'<g transform="translate(124 88) scale(0.9)">{_HAND}</g>'
    arrows = _arrow("M70 62C58 48 58 34 70 20") + _arrow("M198 26C212 40 212 58 200 74")
    return (
        f"{_HEAD.format(240, 132, 'a hand tilts and moves a board before the cameras')}{_TIP}"
        f"{_camera(26, 24, 12)}{_camera(26, 100, -18)}{board}{hand}{arrows}</svg>"
    )


def board(columns: int, rows: int, has_markers: bool) -> str:
    """A board of so many squares, in small."""
    marks = "".join(
        f'<rect class="thing" x="{x + 0.2:g}" y="{y + 0.2:g}" width="0.6" height="0.6"/>'
        for y in range(rows)
        for x in range(columns)
        if (x + y) % 2 == 1
    )
    head = f'<svg class="small" viewBox="0 0 {columns} {rows}" aria-hidden="true">'
    return f"{head}{_squares(columns, rows, 1)}{marks * has_markers}</svg>"


def ruler() -> str:
    """A ruler along ten squares of a board: the length of one is a tenth of what it shows."""
    ticks = "".join(f"M{8 + 20 * n} 84v{14 if n % 5 == 0 else 8}" for n in range(11))
    return (
        f"{_HEAD.format(240, 124, 'a ruler along several squares of the printed board')}{_TIP}"
        f'<g transform="translate(8 22)">{_squares(10, 3, 20)}</g>'
        f'<rect class="thing" x="2" y="84" width="224" height="28" rx="3"/>'
        f'<path class="fine" d="{ticks}"/>'
        '<path class="way-of" marker-start="url(#tip)" marker-end="url(#tip)" d="M8 12H208"/></svg>'
    )


def axes_on_board() -> str:
    """A board that lies on a table, with the axes of the world on it."""
    board = f'<g transform="matrix(1 -0.28 0.75 0.42 42 82)">{_squares(8, 5, 12)}</g>'
    lines = "".join(
        f'<path class="axis {name}" d="M42 82L{x} {y}"/>'
        f'<text class="axis {name}" x="{x + dx}" y="{y + dy}">{name}</text>'
        for name, x, y, dx, dy in (("x", 100, 66, 4, 0), ("y", 6, 62, -2, -6), ("z", 42, 24, 6, 6))
    )
    return (
        f"{_HEAD.format(200, 132, 'a board on the table: the world begins at its corner')}"
        f"{_camera(176, 18, 150)}{board}{lines}</svg>"
    )


def body_in_hand() -> str:
    """A hand that turns a body of three balls."""
    balls = (
        '<path class="fine" d="M96 34L148 46L112 78z"/>'
        '<circle fill="#2e9e4f" cx="96" cy="34" r="13"/>'
        '<circle fill="#d33a2f" cx="148" cy="46" r="13"/>'
        '<circle fill="#e8c21c" cx="112" cy="78" r="13"/>'
    )
    hand = f'<g transform="translate(106 92) scale(0.8)">{_HAND}</g>'
    arrows = _arrow("M66 66C56 48 60 28 76 16") + _arrow("M176 30C188 46 184 68 168 82")
    return (
        f"{_HEAD.format(240, 132, 'a hand turns the balls before the cameras')}{_TIP}"
        f"{_camera(24, 66, 0)}{_camera(216, 20, 160)}{balls}{hand}{arrows}</svg>"
    )
