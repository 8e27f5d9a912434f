"""Recording, and measuring live: what is measured, how well, and what was made of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from html import escape
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
from nicegui import events, ui

from measure import api
from measure.errors import ConfigError
from measure.limits import MOST_LISTED
from measure_lab import api as lab
from measure_studio import api as studio_api
from measure_studio.page.bench import Bench, Job
from measure_studio.page.layout import (
    Hint,
    act,
    camera_pictures,
    choice,
    chosen,
    details,
    empty,
    findings_shown,
    kept_so,
    live_label,
    page,
    put,
    tell,
    tried,
)
from measure_studio.page.live_view import LiveView
from measure_studio.page.words import named, plain

_REST_COLUMNS = ("body", "rest", "x y z mm", "from the first, mm")
_OLD_S = 2.0  # After so long without a pose the last one is no longer shown as if it were live
_TRUTH = "truth.csv"  # In the folder, if there is one
_WORDS = {"ok": ("OK", "good"), "flagged": ("DOUBTFUL", "weak")}
"""State of a pose in large letters, and its colour; all others are lost."""
_SHAPES = {"OK": "●", "DOUBTFUL": "▲", "LOST": "✕", "OLD": "◌", "STOPPED": "■"}
"""States differ in shape as well as in colour."""
_KEYS_OF_FRAME = """(e) => e.target.contentWindow?.addEventListener("keydown", (k) =>
    document.body.dispatchEvent(
        new KeyboardEvent("keydown", {key: k.key, code: k.code, bubbles: true})))"""
"""A frame that was clicked into has the keyboard: what is struck there counts here, too."""


@dataclass(frozen=True)
class Ended:
    """How a run ended, to be shown in its place."""

    run: str
    ok: int
    frame_sets: int
    seconds: float
    before_s: float  # Recorded before the first pose; 0 where nothing is recorded

    @property
    def share(self) -> str:
        """How many of its poses are good."""
        return f"{self.ok} of {self.frame_sets} poses good"


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
    state: studio_api.LiveState | None = None
    goes_on: bool = False
    step: str = ""  # What is done before the first pose
    step_s: float = 0.0  # Since when
    heard_s: float = 0.0
    heard_at: datetime = datetime.min
    before_s: float = 0.0  # From the first picture to the first pose
    ended: Ended | None = None
    findings: Sequence[Any] | None = None  # Of the check of the recording, the worst first
    compared: str = ""  # with the truth
    view: LiveView | None = None
    rests: dict[str, lab.RestsSoFar] = field(default_factory=dict)

    def record(self, calibrations: list[Path], bodies: list[Path]) -> None:
        """Record until it is stopped."""
        bench, session = self.bench, self._next("session")
        calibration = next(iter(calibrations), None)

        def work(job: Job) -> str:
            self._forget()
            try:
                recorded = bench.record(job, session, self.seconds, calibration, bodies)
            finally:
                if not any(session.glob("*/*.jpg")):
                    rmtree(session, ignore_errors=True)
            if not session.is_dir():
                return "stopped: no picture was recorded"
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
        rig, read = api.read_calibration(calibrations[0]), [*map(api.read_body, bodies)]
        options = studio_api.LiveOptions(
            record=self._next("session") if self.keep else None,
            seconds=self.seconds,
            request=bench.request,
            on_image=bench.preview.add,
            on_step=self._begin_step,
        )

        def work(job: Job) -> str:
            self._forget()
            bench.look_for(read)  # When it has ended, too
            self.run, begun_s = run, time.monotonic()
            self.view = LiveView(rig.cameras)
            self.rests = {body.name: lab.RestsSoFar(body, rig) for body in read}
            with ExitStack() as stack:
                stack.callback(setattr, bench, "viewer", "")
                stack.callback(self._drop_empty, run, options.record)
                stack.callback(setattr, self, "goes_on", False)
                self.goes_on = True
                made = replace(options, stop=job.stop)
                if self.viewer and bench.local:
                    bench.viewer, listens = stack.enter_context(studio_api.web_viewer())
                    made = replace(made, connect=listens)
                summary = studio_api.live(
                    cameras,
                    run,
                    calibrations[0],
                    bodies,
                    profile,
                    bench.registry,
                    options=made,
                    on_state=self._hear,
                ).summary
            if not run.exists():  # it was empty, and is deleted
                return "stopped: nothing was measured"
            took_s, before_s = time.monotonic() - begun_s, self.before_s if self.keep else 0.0
            self.ended = Ended(run.name, summary.ok, summary.frame_sets, took_s, before_s)
            self.session, job.title = options.record, f"reporting {run.name}"
            self.report = lab.report(run)
            return f"{run.name}: {self.ended.share}"

        bench.begin(f"measuring {run.name}", work, needs_cameras=True)

    def _forget(self) -> None:
        """Something new begins."""
        self.run, self.session, self.report, self.state = None, None, None, None
        self.ended, self.findings, self.compared, self.view = None, None, "", None

    def _drop_empty(self, run: Path, record: Path | None) -> None:
        """Delete a run in which nothing was measured, and what was recorded for it."""
        if self.state is None:
            self.run = self.view = None
            for folder in filter(None, (run, record)):
                rmtree(folder, ignore_errors=True)

    def _next(self, stem: str) -> Path:
        return self.bench.folder / studio_api.next_free(self.bench.folder, stem)

    def _begin_step(self, step: str) -> None:
        self.step, self.step_s = step, time.monotonic()

    def _hear(self, state: studio_api.LiveState) -> None:
        if self.state is None and self.step == studio_api.LEARNING:
            self.before_s = time.monotonic() - self.step_s
        self.state, self.heard_s, self.heard_at = state, time.monotonic(), datetime.now()
        if self.bench.job is not None:
            self.bench.job.lasts(self.seconds)
        self.bench.note_counts(state.cameras)
        for rests, measured in zip(self.rests.values(), state.latest, strict=True):
            rests.add(measured)
        self.bench.preview.note_measured(state.latest, state.images)
        if self.view is not None:
            self.view.note(state.latest)

    @property
    def truth(self) -> Path | None:
        """The truth that the run can be compared with; None without one."""
        there = self.bench.folder / _TRUTH
        return there if self.report is not None and there.is_file() else None

    def age(self) -> str:
        """Why what is shown is old; empty while poses come."""
        if self.state is None or (self.goes_on and time.monotonic() - self.heard_s < _OLD_S):
            return ""
        at = f"{self.heard_at:%H:%M:%S}"
        return f"{'no pose has come since' if self.goes_on else 'it ended at'} {at}"

    def mark(self, what: str) -> str:
        """Mark an event in the run that goes on."""
        if self.run is None or not self.goes_on:
            return Hint("nothing is being measured: M marks events while Measure goes on")
        api.mark_event(self.run, what or "event")
        return f"marked: {what or 'event'}"

    def check(self) -> None:
        """Say what is wrong or weak in the session."""

        def work(job: Job) -> str:
            found = api.check(self.session or Path(), self.bench.registry, progress=job.progress)
            self.findings = found.findings
            wrong = sum(one.level.value == "wrong" for one in found.findings)
            return f"checked: {wrong or 'nothing'} wrong"

        self.bench.begin("checking the recording", work)

    def evaluate(self) -> None:
        """Compare the run with the truth in the folder."""
        truth = self.truth

        def work(_: Job) -> str:
            found = api.evaluate(self.run or Path(), truth).body
            error = "no pose to compare" if found is None else f"{found.rms_3d_mm:.3f} mm RMS"
            self.compared = f"Position error against the truth: {error}"
            return "compared with the truth"

        self.bench.begin("comparing with the truth", work)


def add(bench: Bench) -> None:
    """Add the page."""
    live = _Live(bench)

    @ui.page("/measure")
    def measure() -> None:
        with page(bench, "/measure"):
            _settings(bench, live)
            with ui.element("div").classes("duo"):
                with ui.element("div").classes("watching"):
                    line = partial(_camera_line, bench)
                    camera_pictures(bench, line, lambda _: "").classes("fitted")
                with ui.element("div").classes("saying"):
                    _figures(live)
                    _afterwards(bench, live)
                    _checked(live)
                    _tile(live)
            _below(live)
            frame = ui.element("iframe").classes("viewer").props('title="3-D viewer"')
            frame.on("load", js_handler=_KEYS_OF_FRAME)
            ui.timer(1.0, lambda: _show_viewer(frame, bench.viewer.partition("?")[2]))


def _settings(bench: Bench, live: _Live) -> None:
    with ui.row().classes("line"):
        begin = act("Measure", "straighten", lambda: live.measure(*given()), primary=True)
        begin.tooltip("space starts and stops it")
        act("Record", "fiber_manual_record", lambda: live.record(*given()))
        calibration = choice("Calibration", bench, "calibrations")
        bodies = choice("Bodies", bench, "bodies", several=True)
        marking = act("Mark (M)", "flag", lambda: live.mark(what.value))
        what = ui.input("Event", value="event")

    def given() -> tuple[list[Path], list[Path]]:
        return chosen(bench, calibration), chosen(bench, bodies)

    with details("More: profile, time, pictures, 3-D viewer"), ui.row().classes("line"):
        ui.select([*api.profile_names()], label="Profile").bind_value(live, "profile")
        seconds = ui.number("Seconds (empty: until stopped)", min=0.1).classes("field")
        seconds.bind_value(live, "seconds")
        ui.checkbox("keep the pictures").bind_value(live, "keep")
        ui.checkbox("3-D viewer").bind_value(live, "viewer").set_enabled(bench.local)

    def show() -> None:
        marking.set_visibility(live.goes_on)
        what.set_visibility(live.goes_on)
        calibration.set_visibility(not live.goes_on)
        bodies.set_visibility(not live.goes_on)
        put(begin, "primary", live.report is None and not bench.busy)  # Else the report is

    ui.timer(0.5, show)

    async def strike(pressed: events.KeyEventArguments) -> None:
        if not pressed.action.keydown or pressed.action.repeat or pressed.key != "m":
            return
        if said := await tried(lambda: live.mark(what.value)):
            tell(said, "warning" if isinstance(said, Hint) else "positive")

    ui.keyboard(strike, ignore=["input", "textarea"])


def _figures(live: _Live) -> None:
    """The state in large letters, poses in large figures; after the end how it was."""
    nothing = empty("").props("data-empty")
    poses = ui.html("", sanitize=False).classes("poses").props("data-pose")

    def show() -> None:
        nothing.set_visibility(live.state is None)
        nothing.text = (
            f"Before the first pose: {live.step}, {time.monotonic() - live.step_s:.0f} s"
            if live.goes_on
            else "Place the body before the cameras and press Measure: its pose comes here."
        )
        poses.set_visibility(live.state is not None)
        if live.state is not None:
            age = live.age()
            shown = zip(live.rests, live.state.latest, strict=True)
            said = "".join(pose_shown(name, one, age, live.goes_on) for name, one in shown)
            poses.set_content(_stopped(live) + said)
        put(poses, "old", bool(live.age()))
        put(poses, "ended", not live.goes_on)

    kept_so(0.3, show)
    live_label(lambda: _pace(live.state) if live.state and live.goes_on else "", "hint")


def _stopped(live: _Live) -> str:
    """What came of a run that has ended, in the place of its state."""
    if live.goes_on:
        return ""
    if (ended := live.ended) is None:
        return '<div class="ending"><span class="state">STOPPED</span></div>'
    before = f"; {ended.before_s:.0f} s were recorded before the first pose" * (ended.before_s > 1)
    return (
        f'<div class="ending"><span class="state">STOPPED</span>'
        f'<div class="figure">{escape(ended.share)}</div>'
        f'<div class="lines">{escape(ended.run)}, {ended.seconds:.0f} s{before}</div></div>'
    )


def _checked(live: _Live) -> None:
    """What the check found, and how far the truth is."""
    with ui.column().classes("findings") as found:
        headline = ui.label().classes("figure").props("data-check")
        listed = ui.html("", sanitize=False)
    live_label(lambda: live.compared, "figure")

    def show() -> None:
        found.set_visibility(live.findings is not None)
        if live.findings is not None:
            wrong = [one for one in live.findings if one.level.value == "wrong"]
            headline.text = "Something is wrong" if wrong else "The recording is sound"
            put(headline, "wrong", bool(wrong))
            put(headline, "good", not wrong)
            listed.set_content(findings_shown(live.findings))

    kept_so(0.5, show)


def _below(live: _Live) -> None:
    """Rests and events."""
    with ui.row().classes("line"):
        columns = [{"name": n, "label": n, "field": n, "align": "left"} for n in _REST_COLUMNS]
        rests = ui.table(rows=[], columns=columns).props("flat dense wrap-cells").classes("rests")
        live_label(
            lambda: "\n".join(_event_lines(live.run)) if live.run else "", mark="data-events"
        )

    async def settle() -> None:
        rests.rows = await tried(lambda: _rest_rows(live)) or []
        rests.set_visibility(bool(rests.rows))

    ui.timer(2.0, settle)


def pose_shown(name: str, measured: api.Measurement, age: str, goes_on: bool = True) -> str:
    """A body's state and pose as HTML, and below it what speaks against the pose, a line each.

    A pose that is not accepted is grey, its ± struck out.
    """
    word, kind = _WORDS.get(measured.status.value, ("LOST", "wrong"))
    if age:
        age = f"was {word}; {age}" if goes_on else f"the last pose was {word}, {age}"
        word, kind = ("OLD", kind) if goes_on else ("STOPPED", kind)
    listed = "".join(f"<li>{escape(plain(one))}</li>" for one in api.counted([measured.doubts]))
    figures = f'<ul class="doubts">{listed}</ul>' if listed else ""
    if (pose := measured.pose) is not None:
        sd = "span" if measured.status.value == "ok" else "s"
        turn = np.degrees(pose.world_from_body.rotvec)
        figures = (
            '<table class="pose-table"><caption>position, mm</caption>'
            f"{_row(pose.world_from_body.translation, pose.position_sd_mm, sd)}</table>"
            '<table class="pose-table"><caption>rotation vector, deg, world from body</caption>'
            f"{_row(turn, pose.rotation_sd_deg, sd)}</table>{figures}"
        )
    large = f'<span class="state {kind}">{_SHAPES[word]} {word}</span>' * (goes_on or not age)
    old = f'<span class="age">{escape(age)}</span>' if age else ""
    return (
        f'<div class="pose {measured.status.value}" data-state="{word}">'
        f'{large}<span class="whose">{escape(name)}</span>{old}{figures}</div>'
    )


def _row(values: Iterable[float], sd: float, tag: str) -> str:
    """Three figures in places of their own, and their standard deviation."""
    cells = "".join(
        f"<td><small>{axis}</small>{value:.2f}</td>"
        for axis, value in zip("xyz", values, strict=True)
    )
    return f"<tr>{cells}<td><{tag}>± {sd:.3f}</{tag}></td></tr>"


def _event_lines(run: Path) -> list[str]:
    lines = [
        f"{number}. {what} at {datetime.fromtimestamp(time_s):%H:%M:%S.%f}"[:-4]
        for number, (time_s, what) in enumerate(api.events(run), 1)
    ]
    return lines[-MOST_LISTED:]


def _pace(state: studio_api.LiveState) -> str:
    lines = [str(cause.finding) for cause in state.causes[:1]]
    lines += [f"{', '.join(state.away)} away"] if state.away else []
    pace = f"{state.frame_sets} frame sets, {state.rate_hz:.1f} per s"
    return "; ".join([*lines, f"{pace}, latency {1e3 * state.age_s:.0f} ms"])


def _rest_rows(live: _Live) -> list[dict[str, Any]]:
    rows = []
    for name, body in live.rests.items():
        found = body.find()
        for number, rest in list(enumerate(found.rests))[-MOST_LISTED:]:
            place = " ".join(f"{value:.2f}" for value in rest.world_from_body.translation)
            move = found.displacement(0, number)
            far = f"{move.distance_mm:.3f} ± {move.distance_sd_mm:.3f}" if number else ""
            rows.append(dict(zip(_REST_COLUMNS, (name, number, place, far), strict=True)))
    return rows


def _tile(live: _Live) -> None:
    """Cameras, balls, their rays and where they were, in 3-D, while it is measured."""
    with ui.element("div").classes("tile").props('data-tile aria-label="3-D"') as tile:
        pass
    shown: LiveView | None = None
    draw: Callable[[], None] | None = None

    def show() -> None:
        nonlocal shown, draw
        if live.view is not shown:
            shown = live.view
            tile.clear()
            draw = None
            if shown is not None:
                with tile:
                    draw = shown.scene()
        tile.set_visibility(shown is not None)
        if draw is not None and live.goes_on:
            draw()

    ui.timer(0.4, show)


def _afterwards(bench: Bench, live: _Live) -> None:
    """What can be made of the run, or of the recording."""
    with ui.row().classes("line"):
        report = ui.link("Open the report", "", new_tab=True).classes("act primary")
        act("Check the recording", "rule", live.check).bind_visibility_from(live, "session", bool)
        compare = act("Compare with the truth", "compare", live.evaluate)

    def show() -> None:
        if live.report is not None:
            report.props(f'href="/file/{live.report.relative_to(bench.folder)}"')
        report.set_visibility(live.report is not None and not bench.busy)
        compare.set_visibility(live.truth is not None)

    ui.timer(0.5, show)


def _show_viewer(frame: ui.element, query: str) -> None:
    """The viewer of the run that goes on, as it is served to this machine."""
    frame.set_visibility(bool(query))
    if query not in frame.props.get("src", "?"):
        frame.props(f'src="/viewer/?{query}"')


def _camera_line(bench: Bench, name: str) -> str:
    count = bench.now[name].count if name in bench.now else None
    if problem := bench.problem(name):
        return named(name, problem)
    return (
        name if count is None else f"{name}: {count.pictures} pictures, {count.rate_hz:.1f} per s"
    )
