"""The body: its colours are picked in live pictures, and its balls located in a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from nicegui import events, ui

from measure import api
from measure.errors import ConfigError
from measure.studio.bench import Bench, Job
from measure.studio.layout import act, camera_card, choice, chosen, page, told, tried

_COLORS, _WIDTH_PX = "colours.toml", 640


@dataclass
class _Making:
    """What is picked and measured; it outlives the browser's page."""

    bench: Bench
    ball: str | None = None
    radius_mm: float = 20.0
    seconds: float = 10.0
    picked: dict[str, list[api.Samples]] = field(default_factory=dict)
    found: api.FoundBody | None = None

    def pick(self, bodies: list[Path], camera: str, share: tuple[float, float]) -> None:
        """Learn a ball's colour where it was clicked, and look for all of them at once."""
        bench, image = self.bench, self.bench.preview.last_shown(camera, _WIDTH_PX)
        if self.ball is None or image is None:
            raise ConfigError("choose the ball's name first, and wait for a picture")
        height, width = image.pixels.shape[:2]
        at = share[0] * width - 0.5, share[1] * height - 0.5
        samples = api.sampled_color(image.pixels, self.ball, at)
        self.picked.setdefault(self.ball, []).append(samples)
        colors = {ball: np.concatenate(some) for ball, some in self.picked.items()}
        bench.body = bench.folder / _COLORS
        api.write_body(bench.body, api.read_body(like(bodies)), colors)
        bench.look_for_balls()

    def measure(self, bodies: list[Path], calibrations: list[Path]) -> None:
        """Record the body while it is turned about, and locate its balls."""
        bench, folder = self.bench, self.bench.folder
        if not calibrations:
            raise ConfigError("choose a calibration: the page Calibration makes it")
        session = folder / api.next_free(folder, "session")
        out = folder / api.next_free(folder, "body", ".toml")
        names = folder / _COLORS if self.picked else like(bodies)

        def work(job: Job) -> str:
            bench.record(job, session, self.seconds, calibrations[0])
            job.title, size = f"looking for the balls in {session.name}", self.radius_mm
            found = api.find_body(session, bench.registry, size, names, progress=job.progress)
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

    @ui.page("/body", title="Body")
    def page_of_body() -> None:
        with page(bench, "/body"):
            names = _settings(bench, making)
            told(making.figures, "figure", "data-body")
            told(lambda: _judgement(making), "hint")
            with ui.element("div").classes("cards"):
                for one in bench.cameras:
                    _camera(bench, making, names, one.name)


def _settings(bench: Bench, making: _Making) -> ui.select:
    """Which body it is like, and how it is recorded."""
    there = api.contents_of(bench.folder)

    def names() -> list[str]:
        return [*api.read_body(like(chosen(bench, body))).names]

    with ui.row().classes("line"):
        body = choice("Names and colours as in", bench, there.bodies, newest=False)
        making.ball = making.ball if making.ball in names() else None
        ball = ui.select(names(), label="Ball to click").classes("field")
        ball.bind_value(making, "ball")
        body.on_value_change(lambda: ball.set_options(names(), value=None))
        act("Forget colours", "undo", making.picked.clear)
    with ui.row().classes("line"):
        calibration = choice("Calibration", bench, there.calibrations)
        for label, value in (("Radius, mm", "radius_mm"), ("Seconds", "seconds")):
            ui.number(label, min=0.1).bind_value(making, value)

        act(
            "Record and measure the body",
            "straighten",
            lambda: making.measure(chosen(bench, body), chosen(bench, calibration)),
        )
    return body


def _judgement(making: _Making) -> str:
    if (found := making.found) is None:
        return "Choose a ball and click it in a picture; then turn the body before the cameras."
    return (
        f"{found.frame}; each coordinate known to {found.body.tolerance_mm:.3f} mm, what is left "
        f"in the pictures {found.rms_px:.2f} px RMS; radii as the outlines show them"
    )


def _camera(bench: Bench, making: _Making, body: ui.select, name: str) -> None:
    async def click(at: events.GenericEventArguments) -> None:
        u, v = at.args
        await tried(lambda: making.pick(chosen(bench, body), name, (u, v)))

    def balls() -> str:
        return f"{name}: {', '.join(bench.preview.balls(name)) or 'no ball found'}"

    card = camera_card(bench, name, _WIDTH_PX, balls)
    card.on("click", click, js_handler="(e) => e.target.naturalWidth && emit(...sharesOf(e))")
