"""The body: its balls are found by their colours, those that are clicked too, and located."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from shutil import rmtree

from nicegui import events, ui

from measure import api
from measure.errors import ConfigError, MeasureError
from measure_studio import api as studio_api
from measure_studio.page import drawings
from measure_studio.page.bench import CALIBRATION, Bench, Job
from measure_studio.page.layout import (
    WIDTH_PX,
    Listed,
    act,
    camera_card,
    choice,
    chosen,
    details,
    empty,
    intro,
    kept_so,
    live_label,
    page,
    pictures,
    put,
    tell,
    tried,
    undo,
)
from measure_studio.page.words import named

_SEEN_BY = 2  # Cameras that must see a colour, where there are as many, before it is listed


@dataclass(frozen=True)
class _Written:
    """What a file of a body was written by."""

    found: api.FoundBody
    names: dict[str, str]
    left_out: set[str]


@dataclass
class _Making:
    """What is picked and measured; it outlives the browser's page, and what was picked the program.

    Attributes:
        colors: what balls are searched by.
        session: the recording in which the body was found.
        out: the file of the body that was found.
        is_changed: whether other colours are searched for than those of `found`.
        written: what is in the file of the body, and `before` what was.
        seen: colours that several cameras see.
    """

    bench: Bench
    radius_mm: float = 20.0
    seconds: float = 10.0
    colors: studio_api.BallColors = field(init=False)
    found: api.FoundBody | None = None
    session: Path | None = None
    out: Path | None = None
    is_changed: bool = False
    written: _Written | None = None
    before: _Written | None = None
    seen: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.colors = studio_api.BallColors(self.bench.folder / studio_api.COLORS)

    def pick(self, like: Path | None, camera: str, share: tuple[float, float]) -> str:
        """Learn a ball's colour where it was clicked, and look for all of them at once."""
        image = self.bench.preview.last_shown(camera, WIDTH_PX)
        if image is None:
            raise ConfigError("wait for a picture, then click a ball in it")
        height, width = image.pixels.shape[:2]
        ball = self.colors.learn(image.pixels, (share[0] * width - 0.5, share[1] * height - 0.5))
        self.look(like)
        return f"{self.colors.name(ball)} was learnt in {camera}"

    def leave_out(self, like: Path | None, color: str) -> None:
        """Search for this colour no more."""
        self.colors.leave_out(color)
        self.look(like)

    def add(self, like: Path | None, color: str) -> None:
        """Search for a colour again, which is listed at once."""
        self.colors.add(color)
        self.seen.add(color)
        self.look(like)

    def look(self, like: Path | None, is_new: bool = True) -> None:
        """Look for the balls in the previews."""
        self.is_changed = is_new and self.found is not None
        if self.found is not None and not self.is_changed:
            self.bench.look_for([self.colors.named(self.found).body])
        else:
            self.bench.look_for([])
            self.bench.look_for(self.colors.bodies(self.radius_mm, like))

    def call(self, color: str, name: str) -> None:
        """Call a ball so, in the file of the body that was found, too."""
        self.colors.call(color, name)
        if self.found is not None and self.out is not None and color in self.found.body.names:
            self._write(self.out, self.found, "the name")

    def _write(self, out: Path, found: api.FoundBody, what: str) -> None:
        """Write the body that was found, and keep what was written before."""
        held, body = out.read_bytes() if out.is_file() else None, self.colors.named(found).body
        api.write_body(out, body)
        self.bench.keep(out, held, what)
        if self.session is not None:
            studio_api.name_body(self.session, body)
        names, left_out = dict(self.colors.names), set(self.colors.left_out)
        self.before, self.written = self.written, _Written(found, names, left_out)

    def return_to_before(self, like: Path | None) -> None:
        """The file of the body holds what was written before: show that."""
        self.before, self.written = self.written, self.before
        if (shown := self.written) is not None:
            self.found = shown.found
            self.colors.names, self.colors.left_out = dict(shown.names), set(shown.left_out)
            if self.session is not None:
                studio_api.name_body(self.session, self.colors.named(shown.found).body)
        self.look(like, is_new=False)

    def measure(self, like: Path | None, calibration: Path | None) -> None:
        """Record the body while it is turned about, and locate its balls; it waits its turn."""
        bench, radius_mm = self.bench, self.radius_mm

        def work(job: Job) -> str:
            known = calibration or bench.folder / CALIBRATION
            if not known.is_file():
                raise ConfigError("choose a calibration: step 2, Calibration, makes it")
            self.out = None  # Another body
            session = bench.folder / studio_api.next_free(bench.folder, "session")
            job.title = f"recording {session.name}"
            try:
                bench.record(job, session, self.seconds, known)
                found = self._find(job, session, radius_mm, like)
            except BaseException:
                rmtree(session, ignore_errors=True)
                raise
            return found

        bench.begin("recording the body", work, needs_cameras=True, waits=True)

    def search_again(self, like: Path | None) -> None:
        """Locate the balls in the recording that is there, by the colours as they are now."""
        if self.session is None:
            raise ConfigError("nothing is recorded yet: record the body first")
        work = partial(self._find, session=self.session, radius_mm=self.radius_mm, like=like)
        self.bench.begin("looking for the balls", work, waits=True)

    def _find(self, job: Job, session: Path, radius_mm: float, like: Path | None) -> str:
        bench = self.bench
        job.title = f"looking for the balls in {session.name}"
        found = self.colors.find(session, bench.registry, radius_mm, like, job.progress)
        out = self.out or bench.folder / studio_api.next_free(bench.folder, "body", ".toml")
        self.session = session
        self._write(out, found, "the body")
        self.found, self.out = found, out
        bench.body = out
        self.look(like, is_new=False)
        return f"{out.name}: {len(found.body.balls)} balls, {found.frame_sets} frame sets"

    def chips(self) -> list[tuple[str, str]]:
        """Each ball's colour that is listed, and what is so of it."""
        bench, colors = self.bench, self.colors
        inside = self.found.body.names if self.found is not None else ()
        several = min(_SEEN_BY, len(bench.names)) or 1
        called = {given: color for color, given in colors.names.items()}
        views = [
            [called.get(ball, ball) for ball in bench.preview.balls(name)] for name in bench.names
        ]
        # What was seen before stays until all were looked at anew.
        if bench.looks and all(map(self._is_looked_at, bench.names)):
            self.seen = {
                ball for some in views for ball in some if sum(ball in v for v in views) >= several
            }
        states = {ball: "in the body" for ball in inside if ball not in colors.left_out}
        states |= {ball: "learnt" for ball in colors.learnt if ball not in states}
        if self.found is None or self.is_changed:
            more = sorted(self.seen - states.keys() - colors.left_out)
            states |= dict.fromkeys(more, "seen")
        return [*states.items(), *((ball, "left out") for ball in sorted(colors.left_out))]

    def _is_looked_at(self, camera: str) -> bool:
        return self.bench.preview.has_looked(camera) or bool(self.bench.problem(camera))

    def figures(self) -> str:
        """What was found, with standard deviations."""
        if self.found is None:
            return ""
        found = self.colors.named(self.found)
        sides = {f"{a} - {b}": length for (a, b), length in found.distances.items()}
        sides |= {f"{ball}, radius": size for ball, size in found.seen_radii.items()}
        return "\n".join(f"{what}  {mm:.3f} ± {sd:.3f} mm" for what, (mm, sd) in sides.items())


def add(bench: Bench) -> None:
    """Add the page."""
    making = _Making(bench)

    @ui.page("/body")
    def page_of_body() -> None:
        with page(bench, "/body"):
            like = _settings(bench, making)
            _chips(making, like)
            with ui.element("div").classes("duo"):
                with ui.element("div").classes("watching"):
                    with pictures().classes("fitted low"):
                        for one in bench.cameras:
                            _camera(bench, making, like, one.name)
                    if not bench.cameras:
                        empty("The cameras' pictures come here: step 1, Cameras, adds them.")
                with ui.element("div").classes("saying"):
                    intro(
                        "Turn the body slowly before the cameras while it is recorded: its balls "
                        "are found by their colours. Click a ball that is not outlined.",
                        drawings.body_in_hand(),
                    )
                    live_label(making.figures, "figure", "data-body")
                    live_label(lambda: _judgement(making), "hint")
                    live_label(
                        lambda: "\n".join(making.found.left_out if making.found else ()), "lines"
                    )
            with suppress(MeasureError):  # too few colours are left, which was reported then
                making.look(like(), is_new=making.is_changed)


def _settings(bench: Bench, making: _Making) -> Callable[[], Path | None]:
    """How it is recorded; gives which body it is like."""

    def like() -> Path | None:
        return next(iter(chosen(bench, body)), None)

    async def other() -> None:
        await tried(lambda: making.look(like()))

    with ui.row().classes("line"):
        act(
            "Record and measure the body",
            "straighten",
            lambda: making.measure(like(), next(iter(chosen(bench, calibration)), None)),
            primary=True,
        )
        again = act("Search the recording again", "refresh", lambda: making.search_again(like()))
        undo(bench, lambda: making.out, lambda: making.return_to_before(like()))
        for label, value in (("Radius of the balls, mm", "radius_mm"), ("Seconds", "seconds")):
            ui.number(label, min=0.1).bind_value(making, value).classes("field")
    with details("More: names and colours of a body file, calibration"), ui.row().classes("line"):
        body = choice("Names and colours as in", bench, "bodies", newest=False)
        calibration = choice("Calibration", bench, "calibrations")
        body.on_value_change(other)
    kept_so(0.5, lambda: again.set_visibility(making.is_changed and not bench.busy))
    return like


def _chips(making: _Making, like: Callable[[], Path | None]) -> None:
    """The balls by their colours, in a place of fixed height: pictures do not move."""
    with ui.row().classes("chips").props("data-chips"):
        none = ui.label("Balls that are found are listed here, with their colours.").classes("hint")
        listed = Listed(ui.row().classes("chips-in"), partial(_chip, making, like))

    def show() -> None:
        shown = dict(making.chips())
        none.set_visibility(not shown)
        listed.show(shown)

    kept_so(0.5, show)


def _chip(
    making: _Making, like: Callable[[], Path | None], color: str
) -> tuple[ui.element, Callable[[str], None]]:
    """A ball's colour, its name to edit, and a button that leaves it out or adds it."""
    state = called = ""

    async def swap() -> None:
        how = making.add if state == "left out" else making.leave_out
        await tried(lambda: how(like(), color))

    async def rename() -> None:
        await tried(lambda: making.call(color, name.value or ""))

    with ui.element("div").classes("chip") as chip:
        chip.props["data-ball"] = color
        swatch = ui.element("span").classes("swatch")
        name = ui.input().props("dense borderless")
        name.props["aria-label"] = f"name of the {color} ball"
        name.on("blur", rename).on("keydown.enter", rename)
        label = ui.label().classes("state-of")
        swapping = ui.button(on_click=swap, color=None).props("flat dense round size=sm")

    def show(now: str) -> None:
        nonlocal state, called
        swatch.style(f"background: rgb({' '.join(map(str, making.colors.rgb(color)))})")
        if called != making.colors.name(color):  # Else it is being typed
            called = name.value = making.colors.name(color)
        if now != state:
            state, out = now, now == "left out"
            label.text = now
            put(chip, "out", out)
            put(chip, "sure", now == "in the body")
            swapping.icon, what = ("add", "search for") if out else ("close", "leave out")
            swapping.props(f'aria-label="{what} {color}"')

    return chip, show


def _judgement(making: _Making) -> str:
    if (found := making.found) is None:
        return ""
    return (
        f"Each coordinate is known to {found.body.tolerance_mm:.3f} mm, reprojection error "
        f"{found.rms_px:.2f} px RMS. {found.frame[0].upper()}{found.frame[1:]}."
    )


def _camera(bench: Bench, making: _Making, like: Callable[[], Path | None], name: str) -> None:
    async def click(at: events.GenericEventArguments) -> None:
        u, v = at.args
        if said := await tried(lambda: making.pick(like(), name, (u, v))):
            tell(said, "positive")

    card = camera_card(bench, name, line=lambda: _line(bench, name))
    card.on("click", click, js_handler="(e) => e.target.naturalWidth && emit(...sharesOf(e))")


def _line(bench: Bench, name: str) -> str:
    """What a camera sees, or why it delivers nothing."""
    return named(name, bench.problem(name) or _balls(bench, name))


def _balls(bench: Bench, name: str) -> str:
    """Which balls a camera sees, once it was looked for them."""
    if not bench.looks:
        return "in use" if bench.busy else "not searched"
    if not bench.preview.has_looked(name):
        return "looking for balls ..."
    return ", ".join(bench.preview.balls(name)) or "no ball found"
