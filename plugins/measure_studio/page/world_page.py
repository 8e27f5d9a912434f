"""World: where the origin is and how the axes lie, by a board or a body at rest, or by markers."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shutil import rmtree

import numpy as np
from nicegui import run, ui

from measure import api
from measure.errors import ConfigError, MeasureError
from measure_lab import api as lab
from measure_studio import api as studio_api
from measure_studio.api.previewing import SEARCH_SHARE
from measure_studio.page import drawings, overlays
from measure_studio.page.bench import CALIBRATION, Bench, Job
from measure_studio.page.layout import (
    act,
    camera_pictures,
    choice,
    chosen,
    details,
    intro,
    live_label,
    page,
    undo,
)
from measure_studio.page.steps import STEPS, step_of
from measure_studio.page.words import plain

_has_world = STEPS[step_of("/world")].is_done
_LOOK_S = 1.0  # Between two looks for the board, at least
_AXIS_MM = 100.0  # Of the axes that are drawn, where the board has no squares
_REST_S, _REST_POSES = 2.0, 10  # How long, and how often, a body at rest is measured at least


@dataclass
class _World:
    """What is asked for, and where the board is seen; it outlives the browser's page."""

    bench: Bench
    seen: tuple[api.Calibration, api.RigidTransform] | None = None  # Board in which world, where
    unseen: str = ""  # Why it is in no picture
    rests_until_s: float = 0.0  # Before which nobody looks again

    def calibration(self) -> api.Calibration:
        """The calibration whose world is moved; ConfigError if there is none yet."""
        if self.bench.calibration is None:
            raise ConfigError("calibrate the cameras first: step 2 makes what is moved here")
        return self.bench.calibration

    @property
    def place(self) -> api.RigidTransform | None:
        """Where the board was seen last; None if not, or if the world has moved since."""
        known, place = self.seen or (None, None)
        return place if known is self.bench.calibration else None

    def look(self) -> None:
        """Look for the board in the newest pictures, unless there is other work to do."""
        bench, begun_s = self.bench, time.monotonic()
        known = bench.calibration
        if known is None or bench.busy or begun_s < self.rests_until_s:
            return
        try:
            newest = bench.preview.pixels(bench.names)
            place = lab.world_by_board(known, bench.target(), newest)[1]
            self.seen, self.unseen = (known, place.transform), ""
        except MeasureError as problem:
            self.seen, self.unseen = None, plain(str(problem), bench.folder)
        took_s = time.monotonic() - begun_s
        self.rests_until_s = begun_s + took_s / SEARCH_SHARE

    def by_board(self) -> None:
        """Put the world where the board lies now."""
        bench = self.bench
        if not bench.busy:
            self.calibration()

        def work(_: Job) -> str:
            newest, given = bench.preview.pixels(bench.names), self.calibration()
            moved, _place = lab.world_by_board(given, bench.target(), newest)
            self._write(moved)
            return "the origin is at the board, z up from the paper"

        bench.begin("setting the origin", work, waits=True)

    def _write(self, moved: api.Calibration) -> None:
        file = self.bench.folder / CALIBRATION
        before = file.read_bytes()
        api.write_calibration(file, moved)
        self.bench.keep(file, before, "the world")

    def by_body(self, body: Path | None) -> None:
        """Put the world where a body rests now: it is measured for some seconds."""
        if not self.bench.busy:
            self.calibration()
        if body is None:
            raise ConfigError("choose the body that lies at rest")
        bench, out = self.bench, self.bench.folder / CALIBRATION
        cameras = bench.addresses()
        times_s: list[float] = []

        def work(job: Job) -> str:
            def hear(state: studio_api.LiveState) -> None:
                job.lasts(_REST_S)
                times_s.append(state.latest[0].time_s)
                if len(times_s) >= _REST_POSES and times_s[-1] - times_s[0] > _REST_S:
                    job.stop.set()

            run = bench.folder / studio_api.next_free(bench.folder, "world")
            made = studio_api.LiveOptions(
                stop=job.stop, request=bench.request, on_image=bench.preview.add
            )
            profile = api.load_profile()
            try:
                studio_api.live(cameras, run, out, [body], profile, bench.registry, made, hear)
                self._write(lab.world(out, run)[0])
            except MeasureError:
                rmtree(run, ignore_errors=True)
                raise
            return f"the origin is that of {body.name}, as it lay"

        bench.begin("measuring the body at rest", work, needs_cameras=True, waits=True)

    def said(self) -> str:
        """What the pictures show."""
        if self.bench.calibration is None:
            return "There is no calibration yet: step 2 makes the one that is moved here."
        if self.place is not None:
            return "The board is seen. The thin axes show where the origin will be."
        if _has_world(self.bench):
            return "The axes show where the origin is. Lay the board elsewhere to move it."
        return f"The board is not seen yet: {self.unseen}" if self.unseen else "looking ..."

    def line(self, name: str) -> str:
        """What a camera shows of the origin, in a line."""
        known = self.bench.calibration
        if known is None or name not in known.names or not _has_world(self.bench):
            return name
        camera = known.camera(name)
        is_shown = camera.intrinsics.contains(camera.project(np.zeros((1, 3))))[0]
        return name if is_shown else f"{name}: the origin is outside its picture"

    def drawn_over(self, name: str) -> str:
        """The world's axes as a camera sees them, and thinner those of the board that is seen."""
        known, facts = self.bench.calibration, self.bench.preview.facts(name)
        if known is None or facts is None or name not in known.names:
            return ""
        camera, parts = known.camera(name), list[str]()
        squares, square_mm = api.board_length(self.bench.target())
        length_mm = squares * square_mm / 3 or _AXIS_MM
        if _has_world(self.bench):
            parts.append(overlays.axes(camera, api.RigidTransform.identity(), length_mm))
        if self.place is not None:
            seen = overlays.axes(camera, self.place, length_mm)
            parts.append(f'<g class="proposed">{seen}</g>')
        return overlays.over(facts.size_wh, *parts)


def add(bench: Bench) -> None:
    """Add the page."""
    world = _World(bench)

    @ui.page("/world")
    def page_of_world() -> None:
        with page(bench, "/world"):
            intro(
                "Lay the board where you want the origin, in view of the cameras, and let go of "
                "it. Its corner becomes the origin; z points up from the paper. No board? Lay down "
                "the body: Other ways.",
                drawings.axes_on_board(),
            )
            with ui.row().classes("line"):
                act("Set the origin here", "my_location", world.by_board, True)
                undo(bench, lambda: bench.folder / CALIBRATION)
                live_label(world.said, "hint")
            _others(bench, world)
            camera_pictures(bench, world.line, world.drawn_over).classes("fitted low")
        ui.timer(_LOOK_S, partial(run.io_bound, world.look))


def _others(bench: Bench, world: _World) -> None:
    """Other ways to a world."""
    with details("Other ways: a body at rest, or markers at known places") as others:
        # Who waved the body has no board.
        known = bench.calibration
        others.value = known is not None and known.provenance.get("method") == "body"
        with ui.row().classes("line"):
            body = choice("Body at rest", bench, "bodies")
            act(
                "Set the origin at the body",
                "my_location",
                lambda: world.by_body(next(iter(chosen(bench, body)), None)),
            )
        ui.link("Markers at known places: click them in pictures", "/marks").classes("act")
