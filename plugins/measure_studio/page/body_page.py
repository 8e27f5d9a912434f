"""The body: its colours are picked in live pictures, and its balls located in a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from nicegui import events, ui

from measure import api
from measure.errors import ConfigError
from measure_studio import api as studio_api
from measure_studio.page import drawings
from measure_studio.page.bench import Bench, Job
from measure_studio.page.layout import (
    WIDTH_PX,
    Hint,
    act,
    camera_card,
    choice,
    chosen,
    details,
    empty,
    intro,
    page,
    pictures,
    tell,
    told,
    tried,
)

_ALIKE = 0.5  # Share of a ball's samples from which on they are taken for another ball's colour


@dataclass
class _Making:
    """What is picked and measured; it outlives the browser's page, and what was picked the program.

    Attributes:
        picked: samples by ball, those of each click.
    """

    bench: Bench
    ball: str | None = None
    radius_mm: float = 20.0
    seconds: float = 10.0
    picked: dict[str, list[api.Samples]] = field(init=False)
    found: api.FoundBody | None = None

    def __post_init__(self) -> None:
        learnt = studio_api.learnt_colors(self.bench.folder / studio_api.COLORS)
        self.picked = {ball: [samples] for ball, samples in learnt.items()}

    @property
    def colors(self) -> dict[str, api.Samples]:
        """What was learnt, by ball."""
        return {ball: np.concatenate(some) for ball, some in self.picked.items()}

    def names(self, bodies: list[Path]) -> Path:
        """The file that the balls are looked for by."""
        return self.bench.folder / studio_api.COLORS if self.picked else like(bodies)

    def pick(self, bodies: list[Path], camera: str, share: tuple[float, float]) -> str:
        """Learn a ball's colour where it was clicked, and look for all of them at once."""
        image = self.bench.preview.last_shown(camera, WIDTH_PX)
        if self.ball is None or image is None:
            raise ConfigError("choose the ball's name first, and wait for a picture")
        height, width = image.pixels.shape[:2]
        at = share[0] * width - 0.5, share[1] * height - 0.5
        body = api.read_body(like(bodies))
        ball = body.balls[body.index(self.ball)]
        samples = api.sampled_color(image.pixels, ball, at)
        self.picked.setdefault(ball.name, []).append(samples)
        self.look(bodies)
        for other in body.balls:
            looks_like = np.mean(other.color.matches(samples)) > _ALIKE
            if looks_like and np.mean(ball.color.matches(samples)) < _ALIKE:
                return Hint(
                    f"{ball.name} was learnt here, but it looks like {other.name}: if it is, take "
                    "the colour away again below, and choose the right name"
                )
        return f"{ball.name} was learnt in {camera}"

    def forget(self, ball: str, bodies: list[Path]) -> None:
        """Take away what was learnt of a ball: it has the colour of its file again."""
        self.picked.pop(ball, None)
        if not self.picked:
            (self.bench.folder / studio_api.COLORS).unlink(missing_ok=True)
        self.look(bodies)

    def look(self, bodies: list[Path]) -> None:
        """Look for the balls, by what was learnt."""
        self.bench.body = self.names(bodies)
        if self.picked:
            body = api.read_body(like(bodies))
            colors = {ball: some for ball, some in self.colors.items() if ball in body.names}
            api.write_body(self.bench.body, body, colors)
        if not self.bench.busy:
            self.bench.look_for_balls()

    def measure(self, bodies: list[Path], calibrations: list[Path]) -> None:
        """Record the body while it is turned about, and locate its balls."""
        bench, folder = self.bench, self.bench.folder
        if not calibrations:
            raise ConfigError("choose a calibration: step 2, Calibration, makes it")
        session = folder / studio_api.next_free(folder, "session")
        out = folder / studio_api.next_free(folder, "body", ".toml")
        names = self.names(bodies)

        def work(job: Job) -> str:
            bench.record(job, session, self.seconds, calibrations[0])
            job.title = f"looking for the balls in {session.name}"
            search = api.BodySearch(self.radius_mm, names)
            found = api.find_body(session, bench.registry, search, job.progress)
            api.write_body(out, found.body)
            self.found, bench.body = found, out
            return f"{out.name}: {len(found.body.balls)} balls, {found.frame_sets} frame sets"

        bench.begin(f"recording {session.name}", work, needs_cameras=True)

    def figures(self) -> str:
        """What was found, with standard deviations."""
        if self.found is None:
            return ""
        sides = {f"{a} - {b}": length for (a, b), length in self.found.distances.items()}
        sides |= {f"{ball}, radius": size for ball, size in self.found.seen_radii.items()}
        return "\n".join(f"{what}  {mm:.3f} ± {sd:.3f} mm" for what, (mm, sd) in sides.items())


def like(bodies: list[Path]) -> Path:
    """The body whose names, colours and frame are used: what was chosen, or the paper's."""
    return bodies[0] if bodies else api.shipped_targets()["raven_three_ball"]


def add(bench: Bench) -> None:
    """Add the page."""
    making = _Making(bench)

    @ui.page("/body")
    def page_of_body() -> None:
        with page(bench, "/body"):
            intro(
                "Turn the body slowly before the cameras while it is recorded: its balls are found "
                "by their colours. One that is not found: choose its name, and click it.",
                drawings.body_in_hand(),
            )
            body = _settings(bench, making)
            told(making.figures, "figure", "data-body")
            told(lambda: _judgement(making), "hint")
            shown = _learnt(bench, making, body)
            with pictures():
                for one in bench.cameras:
                    _camera(bench, making, body, one.name, shown)
            if not bench.cameras:
                empty("The cameras' pictures come here: step 1, Cameras, adds them.")
            making.look(chosen(bench, body))


def _settings(bench: Bench, making: _Making) -> ui.select:
    """How it is recorded, and which body it is like."""
    there = studio_api.contents_of(bench.folder)

    def names() -> list[str]:
        return [*api.read_body(like(chosen(bench, body))).names]

    async def other() -> None:
        ball.set_options(names(), value=None)
        await tried(lambda: making.look(chosen(bench, body)))

    with ui.row().classes("line"):
        act(
            "Record and measure the body",
            "straighten",
            lambda: making.measure(chosen(bench, body), chosen(bench, calibration)),
            primary=True,
        )
        for label, value in (("Radius of the balls, mm", "radius_mm"), ("Seconds", "seconds")):
            ui.number(label, min=0.1).bind_value(making, value)
        first = [*api.read_body(like([])).names]
        making.ball = making.ball if making.ball in first else None
        ball = ui.select(first, label="Ball to click").classes("field")
        ball.bind_value(making, "ball")
    with details("More: names and colours, calibration"), ui.row().classes("line"):
        body = choice("Names and colours as in", bench, there.bodies, newest=False)
        calibration = choice("Calibration", bench, there.calibrations)
        body.on_value_change(other)
    return body


def _learnt(bench: Bench, making: _Making, body: ui.select) -> ui.refreshable[..., None]:
    """The colours that were learnt, each with its name and a button that takes it away."""

    @ui.refreshable
    def swatches() -> None:
        with ui.row().classes("line learnt"):
            for ball, samples in making.colors.items():
                b, g, r = np.median(samples, axis=0).astype(int)
                with ui.element("div").classes("swatch").props(f'data-learnt="{ball}"'):
                    ui.element("span").style(f"background: rgb({r} {g} {b})")
                    ui.label(f"{ball}, as it was clicked")
                    remove = ui.button(icon="close", color=None).props("flat dense round size=sm")
                    remove.props(f'aria-label="forget the colour of {ball}"')

                    async def forget(ball: str = ball) -> None:
                        await tried(lambda: making.forget(ball, chosen(bench, body)))
                        swatches.refresh()

                    remove.on_click(forget)

    swatches()
    return swatches


def _judgement(making: _Making) -> str:
    if (found := making.found) is None:
        return ""
    return (
        f"{found.frame}; each coordinate known to {found.body.tolerance_mm:.3f} mm, "
        f"reprojection error {found.rms_px:.2f} px RMS; radii from the outlines"
    )


def _camera(
    bench: Bench, making: _Making, body: ui.select, name: str, learnt: ui.refreshable[..., None]
) -> None:
    async def click(at: events.GenericEventArguments) -> None:
        u, v = at.args
        if said := await tried(lambda: making.pick(chosen(bench, body), name, (u, v))):
            tell(said, "warning" if isinstance(said, Hint) else "positive")
            learnt.refresh()

    card = camera_card(bench, name, line=lambda: f"{name}: {_balls(bench, name)}")
    card.on("click", click, js_handler="(e) => e.target.naturalWidth && emit(...sharesOf(e))")


def _balls(bench: Bench, name: str) -> str:
    """Which balls a camera sees, once it was looked for them."""
    if not bench.preview.has_looked(name):
        return "looking for balls ..."
    return ", ".join(bench.preview.balls(name)) or "no ball found"
