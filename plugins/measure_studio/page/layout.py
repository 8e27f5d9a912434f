"""What every page has: the head with the way through them, and what all of them need."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar
from urllib.parse import quote

from nicegui import run, ui

from measure import api
from measure.errors import ConfigError, MeasureError
from measure_studio import api as studio_api
from measure_studio.page.bench import Bench, before_of
from measure_studio.page.steps import ASIDE, STEPS, step_of
from measure_studio.page.words import plain

_T = TypeVar("_T")
_Key = TypeVar("_Key")
_Part = tuple[ui.element, Callable[[_T], object]]
_Kind = Literal["bodies", "calibrations"]
Drawn = Callable[[], str]
"""Gives what is drawn into a picture: SVG in the picture's px, empty for nothing."""
_NEWS_S = 15.0  # How long the foot says how something ended
HELP = "/help"
"""Where words and findings of all steps are explained."""
WIDTH_PX = 720
"""Of pictures as they are sent: two stand beside each other in a window of 1440 px."""
_HEAD = """<link rel="stylesheet" href="/studio/studio.css">
<script defer src="/studio/studio.js"></script>"""


@contextmanager
def page(bench: Bench, path: str) -> Iterator[None]:
    """The frame round a page: the steps at its head, what is being done at its foot."""
    here = step_of(path)
    ui.add_head_html(_HEAD)
    ui.page_title(f"{ASIDE[path][0] if path in ASIDE else STEPS[here].name} · triball studio")
    ui.colors(primary="#1f5f99")
    with ui.header().classes("head"):
        ui.label("triball").classes("product")
        with ui.element("nav").classes("way").props('aria-label="steps"'):
            links = [_step_link(n, n == here and path != HELP) for n in range(len(STEPS))]
        recorded = ui.link("Recordings", "/recordings").classes("help recorded")
        recorded.props('aria-label="Recordings"')
        put(recorded, "here", path == "/recordings")
        help_link = ui.link("Help", f"{HELP}#{STEPS[here].name.lower()}", new_tab=path != HELP)
        help_link.classes("help").props("data-help")
        put(help_link, "here", path == HELP)
    with ui.column().classes("page") as body:
        _problem(bench)
        yield
    with ui.footer().classes("foot"):
        _job_line(bench)
        onward = None if path in ("/recordings", HELP) else _next_link(here)

    def tick() -> None:
        done = [step.is_done(bench) for step in STEPS]
        for link, is_done in zip(links, done, strict=True):
            put(link, "done", is_done)
        if onward is not None:  # One button stands out: what is to be done, then the way on
            put(onward, "primary", done[here])
            put(body, "is-done", done[here] and not bench.busy)

    kept_so(1.0, tick)


def _step_link(number: int, is_here: bool) -> ui.link:
    """A step in the head: its number, or a tick once it is done, and its name."""
    step = STEPS[number]
    with ui.link(target=step.path) as link:
        ui.element("span").classes("number").props(f'data-number="{number + 1}" aria-hidden="true"')
        ui.label(step.name).classes("name")
    link.classes("here" if is_here else "")
    link.props(f'aria-label="{number + 1}. {step.name}" data-step="{step.name}"')
    return link.props(f'aria-current="{"page" if is_here else "false"}"')


def _next_link(here: int) -> ui.link | None:
    """The way on to the next step; it stands out once this one is done."""
    if here + 1 == len(STEPS):
        return None
    after = STEPS[here + 1]
    return ui.link(f"Next: {after.name}", after.path).classes("act next").props("data-next")


def _job_line(bench: Bench) -> None:
    """What goes on, how far it is, and for a while how it ended; else how the cameras are."""
    with ui.element("div").classes("job").props('role="status"'):
        text = ui.label().classes("lines")
        bar = ui.linear_progress(0.0, show_value=False).props('rounded aria-label="progress"')
    stop = ui.button("Stop", on_click=bench.stop, color=None).classes("act stop")
    stop.props("flat no-caps")

    def show() -> None:
        job = bench.job
        is_news = job is not None and not job.problem and time.monotonic() - job.ended_s < _NEWS_S
        said = job.text() if job is not None and is_news else ""
        after = ", ".join(title for title, _ in bench.waiting)
        said += f"; then: {after}" if after else ""
        text.set_text(plain(said, bench.folder) or bench.cameras_told())
        share = job.share if job is not None and job.runs else None
        bar.set_visibility(share is not None)
        bar.value = share or 0.0
        stop.set_visibility(bench.busy)

    kept_so(0.3, show)


def _problem(bench: Bench) -> None:
    """Why what was done last failed, until something else is done or it is put away."""
    known = bench.job  # What ended before this page was opened is over
    with ui.row().classes("alert line no-wrap").props('role="alert"') as shown:
        ui.icon("error").classes("shape")
        text = ui.label().classes("lines")
        closing = ui.button(icon="close", color=None).props(
            'flat dense round aria-label="put away"'
        )

    def put_away() -> None:
        nonlocal known
        known = bench.job

    closing.on_click(put_away)

    def show() -> None:
        job = bench.job
        problem = job.problem if job is not None and not job.runs and job is not known else ""
        text.set_text(plain(problem, bench.folder))
        shown.set_visibility(bool(problem))

    kept_so(0.3, show)


def intro(sentence: str, drawing: str = "") -> None:
    """What is to be done on a page, in one sentence, and a drawing where hands are needed."""
    with ui.row().classes("intro"):
        ui.label(sentence).classes("sentence")
        if drawing:
            ui.html(drawing, sanitize=False).classes("by-hand")


_LEVELS = {"wrong": "✕", "weak": "▲", "note": "·"}
"""Findings differ in shape as well as in colour."""


def findings_shown(findings: Iterable[Any]) -> str:
    """Findings as an HTML list, the gravest first; notes are folded away.

    What is found of several cameras alike stands in one line.
    """
    cameras: dict[tuple[str, str], list[str]] = {}
    for one in findings:
        cameras.setdefault((one.level.value, one.text), []).append(one.camera)
    listed = dict.fromkeys(_LEVELS, "")
    for (level, text), names in cameras.items():
        words = ": ".join(filter(None, (", ".join(filter(None, names)), text)))
        mark = f"<b>{_LEVELS[level]} {level}</b>"
        listed[level] += f'<li class="{level}">{mark} {escape(plain(words))}</li>'
    notes = (
        f"<details><summary>Details (nothing to do)</summary><ul>{listed['note']}</ul></details>"
    )
    grave = listed["wrong"] + listed["weak"]
    return f"<ul>{grave}</ul>" * bool(grave) + notes * bool(listed["note"])


def empty(text: str) -> ui.label:
    """What will stand in a place that is still empty."""
    return ui.label(text).classes("empty")


def details(title: str) -> ui.expansion:
    """A part that is folded away till it is asked for; use it as a context manager."""
    return ui.expansion(title).classes("details").props("dense")


def live_label(text: Callable[[], str], kind: str = "lines", mark: str = "") -> ui.label:
    """A label that says what is so at the moment; it takes no room while it says nothing."""
    label = ui.label().classes(kind).props(mark)

    def show() -> None:
        label.set_text(said := text())
        label.set_visibility(bool(said))

    kept_so(0.4, show)
    return label


async def tried(work: Callable[[], _T]) -> _T | None:
    """Do something that may take a while; what the user can mend is shown, and gives None."""
    try:
        return await run.io_bound(work)
    except MeasureError as problem:
        text = str(problem)
    except OSError as problem:
        text = f"{Path(problem.filename or '').name}: {problem.strerror}"
    tell(plain(text), "negative")
    return None


def tell(text: str, kind: Literal["positive", "warning", "negative", "info"] = "info") -> None:
    """A note for some seconds, above the foot."""
    ui.notify(text, type=kind, position="bottom", multi_line=True, timeout=8_000)


class Hint(str):
    """What came of an action that is no success, and no error either."""


def button(
    text: str, icon: str, on_click: Callable[[], object], primary: bool = False
) -> ui.button:
    """A button; one of a page is its primary, which stands out."""
    made = ui.button(text, icon=icon, on_click=on_click, color=None).props("flat no-caps")
    made.props(f'aria-label="{text}"{" data-begin" * primary}')
    return made.classes("act primary" if primary else "act")


def act(text: str, icon: str, work: Callable[[], str | None], primary: bool = False) -> ui.button:
    """A button that does something, and tells what came of it."""

    async def pressed() -> None:
        if said := await tried(work):
            tell(said, "warning" if isinstance(said, Hint) else "positive")

    return button(text, icon, pressed, primary)


def undo(bench: Bench, file: Callable[[], Path | None], after: Callable[[], object] = str) -> None:
    """A button that takes back what was changed last in a file, where the version before is kept.

    Args:
        after: called when it was.
    """

    def take_back() -> str:
        if (there := file()) is None:
            raise ConfigError("nothing was changed yet")
        said = bench.take_back(there)
        after()
        return said

    made = act("Take back", "undo", take_back)

    def show() -> None:
        there = file()
        is_kept = there is not None and there.is_file() and before_of(there).is_file()
        made.set_visibility(is_kept and not bench.busy)
        made.text = f"Take back {bench.changed(there)}" if there is not None else ""

    kept_so(1.0, show)


def typed(label: str, example: str) -> ui.input:
    """A field to type into, with an example of what it takes."""
    return ui.input(label, placeholder=example).props("stack-label").classes("field")


def choice(
    label: str, bench: Bench, what: _Kind, several: bool = False, newest: bool = True
) -> ui.select:
    """A choice among files of the folder, those of a job that ends meanwhile, too.

    The newest is chosen at first; none of them is a choice, too.
    """
    first: Any = [] if several else None
    made = ui.select({}, label=label, value=first, multiple=several, clearable=not several)
    before, job = list[str](), object()

    def keep() -> None:
        """A click on the only one that is chosen does not take it away."""
        if several and not made.value and before:
            made.value = list(before)
        before[:] = made.value if several else []

    def show() -> None:
        nonlocal first, job
        if (now := (bench.job, bench.busy)) == job:
            return
        job = now
        files = getattr(studio_api.contents_of(bench.folder), what)
        offered = {
            str(f.relative_to(bench.folder)): studio_api.described(f, bench.folder) for f in files
        }
        if offered != made.options:
            values = made.value if several else [made.value]
            stays = made.value != first and {*values} - {None} <= offered.keys()
            at_first = [*offered][:newest]
            first = at_first if several else next(iter(at_first), None)
            made.set_options(offered, value=made.value if stays else first)

    made.on_value_change(keep)
    kept_so(1.0, show)
    return made.classes("field")


def chosen(bench: Bench, select: ui.select) -> list[Path]:
    """The files that are chosen."""
    names = select.value if isinstance(select.value, list) else [select.value]
    return [api.inside(bench.folder, name) for name in names if name]


def link(text: str, bench: Bench, file: Callable[[], Path | None]) -> ui.link:
    """A link to a file of the folder, once it is there."""
    shown = ui.link(text, "", new_tab=True)

    def show() -> None:
        there = file()
        address = f"/file/{quote(str(there.relative_to(bench.folder)))}" if there else ""
        if shown.props.get("href") != address:
            shown.props["href"] = address
            shown.update()
        shown.set_visibility(there is not None)

    kept_so(0.5, show)
    return shown


def pictures() -> ui.element:
    """Where pictures of cameras stand: two by two, one below the other in a narrow window."""
    return ui.element("div").classes("pictures")


def picture(camera: str, width_px: int = WIDTH_PX, drawn: Drawn | None = None) -> None:
    """The newest picture of a camera, which the browser fetches again a few times a second."""
    with ui.element("div").classes("shot"):
        image = ui.element("img").classes("live")
        # A name may hold what would end an attribute, or an address.
        image.props["data-live"] = f"/picture/{quote(camera, safe='')}?width={width_px}"
        image.props["alt"] = camera
        if drawn is not None:
            over = ui.html("", sanitize=False).classes("over")
            ui.timer(0.4, lambda: over.set_content(drawn()))


def camera_card(
    bench: Bench,
    name: str,
    width_px: int = WIDTH_PX,
    line: Callable[[], str] = str,
    drawn: Drawn | None = None,
) -> ui.element:
    """The picture of a camera with lines below it, and its state.

    Args:
        line: what the lines say.
        drawn: what lies over the picture, as SVG (see `measure_studio.page.overlays`).
    """
    with ui.card() as card:
        picture(name, width_px, drawn)
        live_label(line)
    kept_so(0.5, lambda: show_state(bench, name, card))
    return card


def show_state(bench: Bench, name: str, card: ui.element) -> None:
    """A camera's card is framed in red while it is away, its picture veiled while it is in use."""
    state, why = bench.state(name)
    job = bench.job
    took = f", {job.lasted_s:.0f} s" if state == "held" and job is not None and job.runs else ""
    put(card, "away", state == "away")
    put(card, "held", state == "held")
    if card.props.get("data-why") != (why := f"{why}{took}"):
        card.props["data-why"] = why
        card.update()


def camera_pictures(
    bench: Bench, line: Callable[[str], str], drawn: Callable[[str], str]
) -> ui.element:
    """The pictures of all cameras, with what a page says of each and draws over it, by its name."""
    with pictures() as shown:
        for name in bench.names:
            camera_card(bench, name, line=partial(line, name), drawn=partial(drawn, name))
    if not bench.cameras:
        empty("The cameras' pictures come here: step 1, Cameras, adds them.")
    return shown


class Listed(Generic[_Key, _T]):
    """Parts of a page that stay while what they show changes, or a press or a key would be lost.

    Args:
        place: where they stand.
        make: makes one by its key; gives it, and what shows in it what is so.
    """

    def __init__(self, place: ui.element, make: Callable[[_Key], _Part[_T]]) -> None:
        self._place, self._make, self._parts = place, make, dict[_Key, _Part[_T]]()

    def show(self, now: Mapping[_Key, _T]) -> None:
        """Show what is so of each, in this order; those that are not there any more go."""
        for gone in self._parts.keys() - now.keys():
            self._parts.pop(gone)[0].delete()
        for number, (key, what) in enumerate(now.items()):
            if key not in self._parts:
                with self._place:
                    self._parts[key] = self._make(key)
                self._parts[key][0].move(target_index=number)
            self._parts[key][1](what)


def kept_so(seconds: float, show: Callable[[], object]) -> None:
    """Show what is so, at once and again and again."""
    show()
    ui.timer(seconds, show)


def put(element: ui.element, name: str, there: bool) -> None:
    """Give an element a class, or take it away."""
    element.classes(add=name if there else None, remove=None if there else name)
