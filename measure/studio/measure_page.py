"""Recording, and measuring live: what is measured, how well, and what was made of it."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from measure import api
from measure.errors import ConfigError
from measure.studio.bench import Bench, Job
from measure.studio.layout import act, camera_card, choice, chosen, link, page, told, tried

_LISTED = 8  # Rests, and events, that are listed, the latest
_REST_COLUMNS = ("body", "rest", "x y z mm", "from the first, mm")


@dataclass
class _Live:
    """What is asked for, and what was measured or recorded last; it outlives the browser's page."""

    bench: Bench
    profile: str = "precise"
    seconds: float | None = None
    keep: bool = True
    viewer: bool = False
    run: Path | None = None
    session: Path | None = None
    report: Path | None = None
    state: api.LiveState | None = None
    rests: dict[str, api.RestsSoFar] = field(default_factory=dict)

    def record(self, calibrations: list[Path], bodies: list[Path]) -> None:
        """Record until it is stopped."""
        bench, session = self.bench, self._next("session")
        calibration = next(iter(calibrations), None)

        def work(job: Job) -> str:
            self.session, self.run, self.report = None, None, None
            recorded = bench.record(job, session, self.seconds, calibration, bodies)
            self.session = session
            pictures = sum(count.pictures for count in recorded.cameras.values())
            return f"{session.name}: {pictures} pictures of {len(recorded.cameras)} cameras"

        bench.begin(f"recording {session.name}", work, needs_cameras=True)

    def measure(self, calibrations: list[Path], bodies: list[Path]) -> None:
        """Measure until it is stopped."""
        if not (calibrations and bodies):
            raise ConfigError("choose a calibration and a body: other pages make them")
        bench, run = self.bench, self._next("run")
        cameras, profile = bench.addresses(), api.load_profile(self.profile)
        rig, read = api.read_calibration(calibrations[0]).cameras, [*map(api.read_body, bodies)]
        options = api.LiveOptions(
            record=self._next("session") if self.keep else None,
            seconds=self.seconds,
            request=bench.request,
            on_image=bench.preview.add,
        )

        def work(job: Job) -> str:
            self.run, self.session, self.report, self.state = run, None, None, None
            self.rests = {body.name: api.RestsSoFar(body, rig) for body in read}
            with ExitStack() as stack:
                stack.callback(setattr, bench, "viewer", "")
                made = replace(options, stop=job.stop)
                if self.viewer and bench.local:
                    bench.viewer, listens = stack.enter_context(api.web_viewer())
                    made = replace(made, viewer=listens, image_every=10)
                to = run, calibrations[0], bodies, profile, bench.registry, made
                summary = api.live(cameras, *to, self._hear).summary
            self.session, self.report = options.record, api.report(run)
            return f"{run.name}: {summary.frame_sets} frame sets, {summary.ok} of them believed"

        bench.begin(f"measuring {run.name}", work, needs_cameras=True)

    def _next(self, stem: str) -> Path:
        return self.bench.folder / api.next_free(self.bench.folder, stem)

    def _hear(self, state: api.LiveState) -> None:
        self.state = state
        self.bench.note_counts(state.cameras)
        for rests, measured in zip(self.rests.values(), state.latest, strict=True):
            rests.add(measured)
            self.bench.preview.note_measured(measured)

    def check(self) -> None:
        """Say what is wrong or weak in the session."""

        def work(job: Job) -> str:
            found = api.check(self.session or Path(), self.bench.registry, progress=job.progress)
            lines = [f"{one.level.value}: {one.topic}: {one.text}" for one in found.findings]
            return "; ".join(lines) or "nothing wrong, nothing weak"

        self.bench.begin("checking", work)

    def evaluate(self) -> None:
        """Compare the run with the truth in the folder."""
        truth = self.bench.folder / "truth.csv"

        def work(_: Job) -> str:
            found = api.evaluate(self.run or Path(), truth if truth.is_file() else None).body
            error = "no pose to compare" if found is None else f"{found.rms_3d_mm:.3f} mm RMS"
            return f"position error against the truth: {error}"

        self.bench.begin("evaluating", work)


def add(bench: Bench) -> None:
    """Add the page."""
    live = _Live(bench)

    @ui.page("/measure", title="Measure")
    def measure() -> None:
        with page(bench, "/measure"):
            _settings(bench, live)
            _figures(live)
            _afterwards(bench, live)
            frame = ui.element("iframe").classes("viewer").props('title="3-D viewer"')
            ui.timer(1.0, lambda: _show_viewer(frame, bench.viewer.partition("?")[2]))
            with ui.element("div").classes("cards"):
                for one in bench.cameras:
                    camera_card(bench, one.name, 320, partial(_camera_line, bench, one.name))


def _settings(bench: Bench, live: _Live) -> None:
    there = api.contents_of(bench.folder)
    with ui.row().classes("line"):
        calibration = choice("Calibration", bench, there.calibrations)
        bodies = choice("Bodies", bench, there.bodies, several=True)
        ui.select([*api.profile_names()], label="Profile").bind_value(live, "profile")
        seconds = ui.number("Seconds (empty: until stopped)", min=0.1).classes("field")
        seconds.bind_value(live, "seconds")
        ui.checkbox("keep the pictures").bind_value(live, "keep")
        ui.checkbox("3-D viewer").bind_value(live, "viewer").set_enabled(bench.local)

    def given() -> tuple[list[Path], list[Path]]:
        return chosen(bench, calibration), chosen(bench, bodies)

    def mark() -> None:
        if (run := live.run) is not None and bench.busy:
            api.mark_event(run, what.value or "event")

    with ui.row().classes("line"):
        act("Record", "fiber_manual_record", lambda: live.record(*given()))
        act("Measure", "straighten", lambda: live.measure(*given()))
        act("Mark (M)", "flag", mark)
        what = ui.input("Event", value="event")
    ui.keyboard(
        lambda pressed: tried(mark) if pressed.action.keydown and pressed.key == "m" else None,
        ignore=["input", "textarea"],
    )


def _figures(live: _Live) -> None:
    """Poses in large figures; rests and events below."""
    told(
        lambda: "\n".join(map(_pose, live.state.latest)) if live.state else "no pose yet",
        *("figure", "data-pose"),
    )
    told(lambda: _pace(live, live.state) if live.state else "", "hint")
    with ui.row().classes("line"):
        columns = [{"name": name, "label": name, "field": name} for name in _REST_COLUMNS]
        rests = ui.table(rows=[], columns=columns).props("flat dense")
        told(lambda: "\n".join(_event_lines(live.run)) if live.run else "", mark="data-events")

    async def settle() -> None:
        rests.rows = await tried(lambda: _rest_rows(live)) or []
        rests.set_visibility(bool(rests.rows))

    ui.timer(2.0, settle)


def _pose(measured: api.Measurement) -> str:
    pose = measured.pose
    if pose is None:
        return f"{measured.status.value}: {measured.reason}"
    x, y, z = pose.world_from_body.translation
    a, b, c = np.degrees(pose.world_from_body.rotvec)
    return (
        f"x {x:.2f}  y {y:.2f}  z {z:.2f}  ± {pose.position_sd_mm:.3f} mm\n"
        f"turned {a:.2f}  {b:.2f}  {c:.2f}  ± {pose.rotation_sd_deg:.3f} deg"
    )


def _event_lines(run: Path) -> list[str]:
    lines = [
        f"{number}. {what} at {datetime.fromtimestamp(time_s):%H:%M:%S.%f}"[:-4]
        for number, (time_s, what) in enumerate(api.events(run), 1)
    ]
    return lines[-_LISTED:]


def _pace(live: _Live, state: api.LiveState) -> str:
    lines = [
        f"{name}: {one.status.value}" + (f" ({one.reason})" if one.reason else "")
        for name, one in zip(live.rests, state.latest, strict=True)
    ]
    lines += [f"{', '.join(state.away)} away"] if state.away else []
    pace = f"{state.frame_sets} frame sets, {state.rate_hz:.1f} per s"
    return "; ".join([*lines, f"{pace}, known after {1e3 * state.age_s:.0f} ms"])


def _rest_rows(live: _Live) -> list[dict[str, Any]]:
    rows = []
    for name, body in live.rests.items():
        found = body.find()
        for number, rest in list(enumerate(found.rests))[-_LISTED:]:
            place = " ".join(f"{value:.2f}" for value in rest.world_from_body.translation)
            move = found.displacement(0, number)
            far = f"{move.distance_mm:.3f} ± {move.distance_sd_mm:.3f}" if number else ""
            rows.append(dict(zip(_REST_COLUMNS, (name, number, place, far), strict=True)))
    return rows


def _afterwards(bench: Bench, live: _Live) -> None:
    """What can be made of the run, or of the recording."""
    with ui.row().classes("line"):
        link("Report", bench, lambda: live.report)
        act("Check", "rule", live.check).bind_visibility_from(live, "session", bool)
        act("Evaluate", "compare", live.evaluate).bind_visibility_from(live, "report", bool)


def _show_viewer(frame: ui.element, query: str) -> None:
    """The viewer of the run that goes on, as it is served to this machine."""
    frame.set_visibility(bool(query))
    if query not in frame.props.get("src", "?"):
        frame.props(f'src="/viewer/?{query}"')


def _camera_line(bench: Bench, name: str) -> str:
    count = bench.now[name].count if name in bench.now else None
    problem = bench.problem(name)
    rate = "" if count is None else f"{count.pictures} pictures, {count.rate_hz:.1f} per s"
    return f"{name}: {problem or rate}"
