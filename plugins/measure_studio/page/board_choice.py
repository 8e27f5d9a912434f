"""Which board is waved: chosen, drawn to be printed, and measured with a ruler."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from nicegui import ui

from measure import api
from measure.errors import MeasureError
from measure_studio import api as studio_api
from measure_studio.page import drawings
from measure_studio.page.bench import BOARD, Bench
from measure_studio.page.layout import act, button, details, kept_so, link, put, tried

_WHY = (
    "The ChArUco board is the fastest and the safest: parts of it count, so that corners of "
    "pictures are reached, and it cannot be mistaken for its half turn or its mirror image."
)


def choose_board(bench: Bench) -> None:
    """The choice of a board, its drawing, and how long it is on paper."""
    printed: list[Path] = []
    shown = bench.board

    def draw() -> None:
        out = bench.folder / f"{bench.target().stem}.pdf"
        printed[:] = [api.draw_target(bench.target(), out, overwrite=True)[1]]

    @ui.refreshable
    def offered() -> None:
        for name in _names(bench):
            _tile(bench, name, choose)

    def choose(name: str) -> None:
        bench.board = name
        offered.refresh()
        length.refresh()

    def wait_for_other() -> None:
        nonlocal shown
        if bench.board != shown:  # Chosen elsewhere, as by what was seen
            shown = bench.board
            choose(shown)

    with ui.row().classes("boards").props('role="radiogroup" aria-label="Board"'):
        offered()
    with ui.row().classes("line board"):
        with ui.column().classes("choice"):
            with ui.row().classes("line"):
                act("Draw it", "print", draw)
                link("PDF, to print at 100 %", bench, lambda: next(iter(printed), None))
            ui.label(_WHY).classes("hint")

        @ui.refreshable
        def length() -> None:
            _length(bench, choose)

        length()
    _own(bench, choose)
    ui.timer(1.0, wait_for_other)


def _tile(bench: Bench, name: str, choose: Callable[[str], None]) -> None:
    """A board to choose: its picture, its kind and its squares."""
    file = api.shipped_targets().get(name) or bench.folder / name
    try:
        board = api.read_board(file)
    except MeasureError:
        return
    tile = ui.element("button").classes("board-tile").props('type="button" role="radio"')
    tile.props["data-board"] = name
    tile.props["aria-checked"] = "true" if name == bench.board else "false"
    put(tile, "chosen", name == bench.board)
    with tile:
        if isinstance(board, api.Charuco | api.Chessboard):
            has_markers = isinstance(board, api.Charuco)
            columns, rows = (count + 1 for count in board.inner_corners)
            ui.html(drawings.board(columns, rows, has_markers), sanitize=False)
            kind = "ChArUco" if has_markers else "chessboard"
            ui.label(f"{kind}, {columns} x {rows} squares")
            ui.label(f"{board.square_mm:.4g} mm · {Path(name).stem}").classes("hint")
        else:
            ui.label(board.title)
            ui.label(Path(name).stem).classes("hint")
    tile.on("click", lambda: choose(name))


def board_like(bench: Bench, seen: api.Board) -> str | None:
    """The first board on offer with the pattern that is seen; None without one."""
    for name in _names(bench):
        with suppress(MeasureError):
            file = api.shipped_targets().get(name) or bench.folder / name
            if _pattern(api.read_board(file)) == _pattern(seen):
                return name
    return None


def _pattern(board: api.Board) -> tuple[object, ...]:
    """What pictures tell of a board: all but its size, and how many markers of a kind there are."""
    if isinstance(board, api.Charuco):
        kind = board.dictionary.rpartition("_")[0]
        return board.inner_corners, kind, board.inverted, board.first_marker
    return tuple(sorted(board.inner_corners)) if isinstance(board, api.Chessboard) else ()


def _own(bench: Bench, choose: Callable[[str], None]) -> None:
    """A board of one's own: its kind, its squares and their size."""
    with details("My board: another one than these") as own, ui.row().classes("line"):
        kind = ui.select({"charuco": "ChArUco", "chessboard": "chessboard"}, value="chessboard")
        kind.props('label="Kind"').classes("field")
        columns = ui.number("Squares along the long side", value=10, min=3, precision=0)
        rows = ui.number("Squares along the short side", value=7, min=3, precision=0)
        square = ui.number("Square, mm", value=25.0, min=0.1)
        for field in (columns, rows, square):
            field.classes("field")

        def write() -> str:
            counts = int(columns.value or 0), int(rows.value or 0)
            made = studio_api.own_board(kind.value, *counts, float(square.value or 0.0))
            return studio_api.write_board(bench.folder, made, "my-board").name

        async def take() -> None:
            if name := await tried(write):
                choose(name)

        button("Use it", "done", take)

    def ask() -> None:
        """Of a board that was seen all is known but its size."""
        if (seen := bench.seen_board) is not None:
            bench.seen_board = None
            kind.value = "charuco" if isinstance(seen, api.Charuco) else "chessboard"
            columns.value, rows.value = (count + 1 for count in seen.inner_corners)
            square.value = None
            own.open()

    kept_so(1.0, ask)


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


def _length(bench: Bench, choose: Callable[[str], None]) -> None:
    """How long the printed board's squares are, with a ruler's picture."""
    with ui.row().classes("line no-wrap"):
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
            choose(made)
        else:
            fill()

    field.on("blur", measured).on("keydown.enter", measured)
    fill()


def _measured(bench: Bench, square_mm: float) -> str:
    """The board with squares of this size, as a file of the folder; its name."""
    target = bench.target()
    out = bench.folder / f"{target.stem.removesuffix('-measured')}-measured.toml"
    api.write_measured_board(target, square_mm, out)
    return out.name
