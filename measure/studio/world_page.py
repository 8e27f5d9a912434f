"""World: where the origin is and how the axes lie, by a board or a body at rest, or by markers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nicegui import ui

from measure import api
from measure.errors import ConfigError
from measure.studio import drawings
from measure.studio.bench import CALIBRATION, Bench, Job
from measure.studio.layout import act, camera_card, choice, chosen, details, intro, page, pictures

_REST_S, _REST_POSES = 2.0, 10  # How long, and how often, a body at rest is measured at least


@dataclass
class _World:
    """What is asked for; it outlives the browser's page."""

    bench: Bench

    def calibration(self) -> Path:
        """The calibration whose world is moved; ConfigError if there is none yet."""
        file = self.bench.folder / CALIBRATION
        if not file.is_file():
            raise ConfigError("calibrate the cameras first: without that no place can be told")
        return file

    def by_board(self) -> None:
        """Put the world where the board lies now."""
        folder, out = self.bench.folder, self.calibration()
        names, still = self.bench.names, folder / api.next_free(folder, "world")

        def work(_: Job) -> str:
            self.bench.preview.write(names, still)
            moved, _ = api.world_by_board(out, self.bench.target(), still)
            api.write_calibration(out, moved)
            return f"{CALIBRATION}: the world is the board's frame"

        self.bench.begin("moving the world", work)

    def by_body(self, body: Path | None) -> None:
        """Put the world where a body rests now: it is measured for some seconds."""
        out = self.calibration()
        if body is None:
            raise ConfigError("choose the body that lies at rest")
        bench = self.bench
        cameras, run = bench.addresses(), bench.folder / api.next_free(bench.folder, "world")
        times_s: list[float] = []

        def work(job: Job) -> str:
            def hear(state: api.LiveState) -> None:
                times_s.append(state.latest[0].time_s)
                if len(times_s) >= _REST_POSES and times_s[-1] - times_s[0] > _REST_S:
                    job.stop.set()

            made = api.LiveOptions(stop=job.stop, request=bench.request, on_image=bench.preview.add)
            profile = api.load_profile()
            api.live(cameras, run, out, [body], profile, bench.registry, made, hear)
            api.write_calibration(out, api.world(out, run)[0])
            return f"{CALIBRATION}: the world is the frame of {body.name}, as it lay"

        bench.begin("measuring the body at rest", work, needs_cameras=True)


def add(bench: Bench) -> None:
    """Add the page."""
    world = _World(bench)

    @ui.page("/world")
    def page_of_world() -> None:
        with page(bench, "/world"):
            intro(
                "Lay the board where the world is to begin, so that cameras see it, and press.",
                drawings.axes_on_board(),
            )
            with ui.row().classes("line"):
                act("The world is where the board lies", "my_location", world.by_board, True)
            with pictures():
                for one in bench.cameras:
                    camera_card(bench, one.name)
            _others(bench, world)


def _others(bench: Bench, world: _World) -> None:
    """Other ways to a world."""
    with details("Other ways: a body at rest, or markers at known places"):
        with ui.row().classes("line"):
            body = choice("Body at rest", bench, api.contents_of(bench.folder).bodies)
            act(
                "The world is the body's frame",
                "my_location",
                lambda: world.by_body(next(iter(chosen(bench, body)), None)),
            )
        ui.link("Markers: click them in pictures", "/marks")
