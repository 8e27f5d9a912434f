"""Which board is waved: chosen, drawn to be printed, and measured with a ruler."""

from __future__ import annotations

from pathlib import Path

from nicegui import ui

from measure import api
from measure.errors import MeasureError
from measure_studio import api as studio_api
from measure_studio.page import drawings
from measure_studio.page.bench import BOARD, Bench
from measure_studio.page.layout import act, link, tried

_WHY = (
    "The ChArUco board is the fastest and the safest: parts of it count, so that corners of "
    "pictures are reached, and it cannot be mistaken for its half turn or its mirror image."
)


def choose_board(bench: Bench) -> None:
    """The choice of a board, its drawing, and how long it is on paper."""
    printed: list[Path] = []

    def draw() -> None:
        out = bench.folder / f"{bench.target().stem}.pdf"
        printed[:] = [api.draw_target(bench.target(), out, overwrite=True)[1]]

    with ui.row().classes("line board"):
        with ui.column().classes("choice"):
            with ui.row().classes("line"):
                board = ui.select(_names(bench), label="Board").classes("field")
                board.bind_value(bench, "board")
                act("Draw it", "print", draw)
                link("PDF, to print at 100 %", bench, lambda: next(iter(printed), None))
            ui.label(_WHY).classes("hint")
        _length(bench, board)


def _names(bench: Bench) -> list[str]:
    """The boards there are: those of the folder, then the one that is best, then the others."""
    boards = studio_api.contents_of(bench.folder).boards
    own = [str(file.relative_to(bench.folder)) for file in boards]
    shipped = sorted(filter(_is_board, api.shipped_targets()), key=lambda name: name != BOARD)
    return [*own, *shipped]


def _is_board(name: str) -> bool:
    try:
        return bool(api.board_length(name))
    except MeasureError:  # markers, or a body
        return False


def _length(bench: Bench, board: ui.select) -> None:
    """How long the printed board's squares are, with a ruler's picture."""
    ui.html(drawings.ruler(), sanitize=False)
    with ui.column().classes("length"):
        field = ui.number("Squares measured, mm", step=0.5).classes("field")
        one = ui.label().classes("hint")

    def fill() -> None:
        try:
            squares, square_mm = api.board_length(bench.target())
        except MeasureError:
            squares, square_mm = 0, 0.0
        field.set_visibility(squares > 0)
        field.props(f'label="{squares} squares by the ruler, mm"')
        field.value = squares * square_mm
        one.text = f"one square: {square_mm:.3f} mm" if squares else ""

    async def measured() -> None:
        squares, square_mm = api.board_length(bench.target())
        if not field.value or abs(field.value - squares * square_mm) < 1e-9:
            return
        if made := await tried(lambda: _measured(bench, field.value / squares)):
            board.set_options(_names(bench), value=made)
        fill()

    board.on_value_change(fill)
    field.on("blur", measured).on("keydown.enter", measured)
    fill()


def _measured(bench: Bench, square_mm: float) -> str:
    """The board with squares of this size, as a file of the folder; its name."""
    target = bench.target()
    out = bench.folder / f"{target.stem.removesuffix('-measured')}-measured.toml"
    api.write_measured_board(target, square_mm, out)
    return out.name
