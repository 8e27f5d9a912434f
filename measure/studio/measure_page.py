"""Recording, and measuring live: what is measured, how well, and what was made of it."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from measure import api
from measure.errors import ConfigError
from measure.studio.bench import Bench, Job
from measure.studio.layout import choice, chosen, link, page, picture, put, tried

_LISTED = 8  # Rests, and events, that are listed, the latest
_REST_COLUMNS = ("body", "rest", "x y z mm", "from the first, mm")


@dataclass
class _Live:
    """What was measured or recorded last; it outlives the browser's page."""

    run: Path | None = None
    session: Path | None = None
    report: Path | None = None
    state: api.LiveState | None = None
    bodies: list[str] = field(default_factory=list)
    rests: list[api.RestsSoFar] = field(default_factory=list)
    viewer: str = ""


def add(bench: Bench) -> None:
    """Add the page."""
    live = _Live()

    @ui.page("/measure", title="Measure")
    def measure() -> None:
        with page(bench, "/measure"):
            _settings(bench, live)
            _figures(live)
            _afterwards(bench, live)
            _viewer(live)
            with ui.element("div").classes("cards"):
                for one in bench.cameras:
                    _view(bench, one.name)


def _settings(bench: Bench, live: _Live) -> None:
    there = api.contents_of(bench.folder)
    with ui.row().classes("line"):
        calibration = choice("Calibration", bench, there.calibrations)
        bodies = choice("Bodies", bench, there.bodies, several=True)
        profile = ui.select([*api.profile_names()], value="precise", label="Profile")
        seconds = ui.number("Seconds (empty: until stopped)", min=0.1).classes("field")
        keep = ui.checkbox("keep the pictures", value=True)
        viewer = ui.checkbox("3-D viewer")
        viewer.set_enabled(bench.local)

    async def record() -> None:
        given = chosen(bench, calibration), chosen(bench, bodies), seconds.value
        await tried(lambda: _record(bench, live, *given))

    async def measure() -> None:
        given = chosen(bench, calibration), chosen(bench, bodies), seconds.value
        how = profile.value, keep.value, viewer.value
        await tried(lambda: _measure(bench, live, *given, *how))

    async def mark() -> None:
        run = live.run
        if run is not None and bench.busy:
            await tried(lambda: api.mark_event(run, what.value or "event"))

    with ui.row().classes("line"):
        ui.button("Record", icon="fiber_manual_record", on_click=record)
        ui.button("Measure", icon="straighten", on_click=measure)
        ui.button("Mark (M)", icon="flag", on_click=mark)
        what = ui.input("Event", value="event")
    ui.keyboard(
        lambda pressed: mark() if pressed.action.keydown and pressed.key == "m" else None,
        ignore=["input", "textarea"],
    )


def _record(
    bench: Bench, live: _Live, calibrations: list[Path], bodies: list[Path], seconds: float | None
) -> None:
    cameras, session = bench.addresses(), bench.folder / api.next_free(bench.folder, "session")

    def work(job: Job) -> str:
        live.session, live.run, live.report = session, None, None
        recorded = api.record(
            cameras,
            session,
            calibration=next(iter(calibrations), None),
            bodies=bodies,
            seconds=seconds,
            on_state=bench.note_counts,
            on_image=bench.preview.add,
            stop=job.stop,
        )
        pictures = sum(count.pictures for count in recorded.cameras.values())
        return f"{session.name}: {pictures} pictures of {len(cameras)} cameras"

    bench.begin(f"recording {session.name}", work, needs_cameras=True)


def _measure(
    bench: Bench,
    live: _Live,
    calibrations: list[Path],
    bodies: list[Path],
    seconds: float | None,
    profile: str,
    keep: bool,
    viewer: bool,
) -> None:
    if not (calibrations and bodies):
        raise ConfigError("choose a calibration and a body: other pages make them")
    cameras, run = bench.addresses(), bench.folder / api.next_free(bench.folder, "run")
    known, read = api.read_calibration(calibrations[0]).cameras, [*map(api.read_body, bodies)]
    options = api.LiveOptions(
        record=bench.folder / api.next_free(bench.folder, "session") if keep else None,
        seconds=seconds,
        on_image=bench.preview.add,
    )

    def hear(state: api.LiveState) -> None:
        live.state = state
        bench.note_counts(state.cameras)
        for one, measured in zip(live.rests, state.latest, strict=True):
            one.add(measured)
            bench.preview.note_measured(measured)

    def work(job: Job) -> str:
        live.run, live.session, live.report, live.state = run, options.record, None, None
        live.bodies = [body.name for body in read]
        live.rests = [api.RestsSoFar(body, known) for body in read]
        with ExitStack() as stack:
            stack.callback(setattr, live, "viewer", "")
            made = replace(options, stop=job.stop)
            if viewer:
                live.viewer, listens = stack.enter_context(api.web_viewer())
                made = replace(made, viewer=listens, image_every=10)
            to, how = (run, calibrations[0], bodies), api.load_profile(profile)
            summary = api.live(cameras, *to, how, bench.registry, made, hear).summary
        live.report = api.report(run)
        return f"{run.name}: {summary.frame_sets} frame sets, {summary.ok} of them believed"

    bench.begin(f"measuring {run.name}", work, needs_cameras=True)


def _figures(live: _Live) -> None:
    """Poses in large figures; rests and events below."""
    pose, told = ui.label().classes("figure").props("data-pose"), ui.label().classes("hint")
    with ui.row().classes("line"):
        columns = [{"name": name, "label": name, "field": name} for name in _REST_COLUMNS]
        rests = ui.table(rows=[], columns=columns).props("flat dense")
        marks = ui.label().classes("lines").props("data-events")

    def show() -> None:
        state = live.state
        pose.text = "\n".join(map(_pose_text, state.latest)) if state else "no pose yet"
        told.text = _pace(live, state) if state else ""
        marks.text = "" if live.run is None else "\n".join(_event_lines(live.run))

    async def settle() -> None:
        rests.rows = await tried(lambda: list(_rest_rows(live))) or []
        rests.set_visibility(bool(rests.rows))

    ui.timer(0.3, show)
    ui.timer(2.0, settle)


def _pose_text(measured: api.Measurement) -> str:
    pose = measured.pose
    if pose is None:
        return f"{measured.status.value}: {measured.reason}"
    x, y, z = pose.world_from_body.translation
    a, b, c = np.degrees(pose.world_from_body.rotvec)
    return (
        f"{x:.2f}  {y:.2f}  {z:.2f}  ± {pose.position_sd_mm:.3f} mm\n"
        f"{a:.2f}  {b:.2f}  {c:.2f}  ± {pose.rotation_sd_deg:.3f} deg"
    )


def _event_lines(run: Path) -> list[str]:
    told = [
        f"{number}. {what} at {datetime.fromtimestamp(time_s):%H:%M:%S.%f}"[:-4]
        for number, (time_s, what) in enumerate(api.events(run), 1)
    ]
    return told[-_LISTED:]


def _pace(live: _Live, state: api.LiveState) -> str:
    told = [
        f"{name}: {one.status.value}" + (f" ({one.reason})" if one.reason else "")
        for name, one in zip(live.bodies, state.latest, strict=True)
    ]
    if state.away:
        told.append(f"{', '.join(state.away)} away")
    pace = f"{state.frame_sets} frame sets, {state.rate_hz:.1f} per s"
    return "; ".join([*told, f"{pace}, known after {1e3 * state.age_s:.0f} ms"])


def _rest_rows(live: _Live) -> list[dict[str, Any]]:
    rows = []
    for name, body in zip(live.bodies, live.rests, strict=True):
        found = body.find()
        for number, rest in list(enumerate(found.rests))[-_LISTED:]:
            place = " ".join(f"{value:.2f}" for value in rest.world_from_body.translation)
            move = found.displacement(0, number)
            far = f"{move.distance_mm:.3f} ± {move.distance_sd_mm:.3f}" if number else ""
            rows.append(dict(zip(_REST_COLUMNS, (name, number, place, far), strict=True)))
    return rows


def _afterwards(bench: Bench, live: _Live) -> None:
    """What can be made of the run, or of the recording."""

    def check(job: Job) -> str:
        found = api.check(live.session or Path(), bench.registry, progress=job.progress)
        told = [f"{one.level.value}: {one.topic}: {one.text}" for one in found.findings]
        return "; ".join(told) or "nothing wrong, nothing weak"

    def evaluate(job: Job) -> str:  # noqa: ARG001
        truth = bench.folder / "truth.csv"
        found = api.evaluate(live.run or Path(), truth if truth.is_file() else None).body
        return (
            "no pose could be compared"
            if found is None
            else (f"position error against the truth: {found.rms_3d_mm:.3f} mm RMS")
        )

    with ui.row().classes("line"):
        link("Report", bench, lambda: live.report)
        checks = ui.button("Check", on_click=lambda: tried(lambda: bench.begin("checking", check)))
        compares = ui.button(
            "Evaluate", on_click=lambda: tried(lambda: bench.begin("evaluating", evaluate))
        )

    def show() -> None:
        checks.set_visibility(live.session is not None and not bench.busy)
        compares.set_visibility(live.report is not None and not bench.busy)

    ui.timer(0.5, show)


def _viewer(live: _Live) -> None:
    """The viewer of the run that goes on, as it is served to this machine."""
    frame = ui.element("iframe").classes("viewer").props('title="3-D viewer"')

    def show() -> None:
        frame.set_visibility(bool(live.viewer))
        if frame.props.get("src", "") != live.viewer:
            frame.props(f'src="{live.viewer}"')

    ui.timer(1.0, show)


def _view(bench: Bench, name: str) -> None:
    with ui.card() as card:
        picture(name, 320)
        told = ui.label()

    def show() -> None:
        now = bench.now.get(name)
        problem = "not read" if now is None else now.problem
        told.text = (
            f"{name}: {problem}"
            if problem or now is None
            else (f"{name}: {now.count.pictures} pictures, {now.count.rate_hz:.1f} per s")
        )
        put(card, "away", bool(problem))

    ui.timer(0.5, show)
