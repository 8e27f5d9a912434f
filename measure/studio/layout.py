"""What every page has: the head with the way through them, and what all of them need."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from nicegui import run, ui

from measure import api
from measure.errors import MeasureError
from measure.studio.bench import Bench

_T = TypeVar("_T")
PAGES = (
    ("/", "Cameras"),
    ("/calibration", "Calibration"),
    ("/marks", "Marks"),
    ("/body", "Body"),
    ("/measure", "Measure"),
)
_HEAD = """<link rel="stylesheet" href="/studio/studio.css">
<script defer src="/studio/studio.js"></script>"""


@contextmanager
def page(bench: Bench, path: str) -> Iterator[None]:
    """The frame round a page, with what is being done at the moment at its foot."""
    ui.add_head_html(_HEAD)
    ui.colors(primary="#1f5f99")
    with ui.header().classes("head"), ui.row().classes("way"):
        for target, name in PAGES:
            link = ui.link(name, target).classes("here" if target == path else "")
            link.props(f'aria-current="{"page" if target == path else "false"}"')
    with ui.column().classes("page"):
        yield
    with ui.footer().classes("foot"):
        _job_line(bench)


def _job_line(bench: Bench) -> None:
    """What goes on, how far it is, and how it ended."""
    text = told(lambda: bench.job.told() if bench.job else str(bench.folder), "job")
    stop = ui.button("Stop", on_click=bench.stop).props("dense")

    def show() -> None:
        stop.set_visibility(bench.busy)
        put(text, "wrong", bool(bench.job and bench.job.problem))

    ui.timer(0.3, show)


def told(text: Callable[[], str], kind: str = "lines", mark: str = "") -> ui.label:
    """A label that says what is so at the moment."""
    label = ui.label().classes(kind).props(mark)
    ui.timer(0.4, lambda: label.set_text(text()))
    return label


async def tried(work: Callable[[], _T]) -> _T | None:
    """Do something that may take a while; what the user can mend is shown, and gives None."""
    try:
        return await run.io_bound(work)
    except MeasureError as problem:
        text = str(problem)
    except OSError as problem:
        text = f"{problem.filename or ''}: {problem.strerror}"
    ui.notify(text, type="negative", multi_line=True, timeout=10_000)
    return None


def act(text: str, icon: str, work: Callable[[], str | None]) -> ui.button:
    """A button that does something, and tells what came of it."""

    async def pressed() -> None:
        if said := await tried(work):
            ui.notify(said, type="positive")

    return ui.button(text, icon=icon, on_click=pressed)


def typed(label: str, example: str) -> ui.input:
    """A field to type into, with an example of what it takes."""
    return ui.input(label, placeholder=example).props("stack-label").classes("field")


def choice(
    label: str, bench: Bench, files: Sequence[Path], several: bool = False, newest: bool = True
) -> ui.select:
    """A choice among files of the folder, the newest at first; none of them is a choice, too."""
    names = [str(file.relative_to(bench.folder)) for file in files]
    first = names[:1] if newest else []
    value = first if several else next(iter(first), None)
    made = ui.select(names, label=label, value=value, multiple=several, clearable=True)
    return made.classes("field")


def chosen(bench: Bench, select: ui.select) -> list[Path]:
    """The files that are chosen."""
    names = select.value if isinstance(select.value, list) else [select.value]
    return [api.inside(bench.folder, name) for name in names if name]


def link(text: str, bench: Bench, file: Callable[[], Path | None]) -> None:
    """A link to a file of the folder, once it is there."""
    shown = ui.link(text, "", new_tab=True)

    def show() -> None:
        there = file()
        if there is not None:
            shown.props(f'href="/file/{there.relative_to(bench.folder)}"')
        shown.set_visibility(there is not None)

    ui.timer(0.5, show)


def picture(camera: str, width_px: int) -> None:
    """The newest picture of a camera, which the browser fetches again a few times a second."""
    address = f"/picture/{camera}?width={width_px}"
    ui.element("img").classes("live").props(f'data-live="{address}" alt="{camera}"')


def camera_card(bench: Bench, name: str, width_px: int, line: Callable[[], str]) -> ui.element:
    """The picture of a camera with lines below it; red while it is away."""
    with ui.card() as card:
        picture(name, width_px)
        told(line)
        # While a board is watched nobody counts pictures, and no camera is called away.
        ui.timer(0.5, lambda: put(card, "away", name in bench.now and bool(bench.problem(name))))
    return card


def put(element: ui.element, name: str, there: bool) -> None:
    """Give an element a class, or take it away."""
    element.classes(add=name if there else None, remove=None if there else name)
