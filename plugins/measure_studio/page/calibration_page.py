"""Calibration: a board is waved until its pictures are enough, and the cameras come from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shutil import rmtree

import numpy as np
from nicegui import ui

from measure import api
from measure.errors import ConfigError
from measure_studio import api as studio_api
from measure_studio.page import drawings, overlays
from measure_studio.page.bench import CALIBRATION, Bench, Job
from measure_studio.page.board_choice import board_like, choose_board
from measure_studio.page.layout import (
    Hint,
    act,
    camera_pictures,
    choice,
    chosen,
    details,
    findings_shown,
    intro,
    kept_so,
    link,
    live_label,
    page,
    put,
    undo,
)

_BODY = "body.toml"  # In the folder, where no body is chosen
_FINEST_MM = 0.01
_ADVISED = 2  # Pieces of advice that are shown at a time: hands follow no more


@dataclass
class _Wave:
    """What is asked for, and what was taken and calibrated last; it outlives the browser's page."""

    bench: Bench
    goal_mm: float = 0.2
    capture: Path | None = None
    state: api.WaveState | None = None
    result: api.CalibrationResult | None = None
    report: Path | None = None
    is_waved: bool = False
    what: str = "board"  # that is waved
    suffices: bool = False  # whether whoever waves has had enough

    def take(self, body: Path | None, waits: bool = False) -> None:
        """Take pictures of the board until they are enough, and calibrate by them."""
        bench, cameras = self.bench, self.bench.addresses()

        def work(job: Job) -> str:
            out, options = self._begin(job, "capture", "board")
            try:
                last = studio_api.capture_board(
                    cameras,
                    bench.target(),
                    out,
                    options,
                    body=body,
                    goal_mm=self.goal_mm,
                    on_state=partial(setattr, self, "state"),
                    on_corners=self._see,
                )
            finally:
                self.is_waved = False
            if last is None or not any(seen.views for seen in last.cameras.values()):
                rmtree(out, ignore_errors=True)
                self.capture = None
                return "stopped: no picture was kept"
            if not (last.enough or self.suffices):
                return f"stopped: {_kept(last)} kept; More calibrates by them"
            return bench.calibrated(job, out, self._hear, body)

        bench.begin("watching the board", work, needs_cameras=True, waits=waits)

    def take_body(self, body: Path | None, lenses: Path | None) -> None:
        """Record the waved body until that is enough, and calibrate by it.

        Where no body is chosen it is the paper's, which is then written to the folder.
        """
        bench, cameras = self.bench, self.bench.addresses()

        def work(job: Job) -> str:
            out, options = self._begin(job, "waved", "body")
            said = ""
            try:
                last = studio_api.capture_body(
                    cameras,
                    out,
                    bench.registry,
                    options,
                    body=body,
                    lenses=lenses,
                    goal_mm=self.goal_mm,
                    on_state=partial(setattr, self, "state"),
                    on_balls=self._see_balls,
                )
                self.is_waved = False
                if last is None or not (last.enough or self.suffices):
                    return "stopped: the waving was not enough, and is not kept"
                said = bench.calibrated(job, out, self._hear, body, lenses)
            finally:
                self.is_waved = False
                if not said:
                    rmtree(out, ignore_errors=True)
                    self.capture = None
            if body is None and not (bench.folder / _BODY).is_file():
                api.write_body(bench.folder / _BODY, api.paper_body())
            return said

        bench.begin("watching the body", work, needs_cameras=True)

    def _begin(self, job: Job, folder: str, what: str) -> tuple[Path, studio_api.CaptureOptions]:
        """Forget what was waved before; where pictures go, and how cameras are read."""
        bench = self.bench
        out = bench.folder / studio_api.next_free(bench.folder, folder)
        self.capture, self.state, self.result = out, None, None
        self.is_waved, self.suffices, self.what = True, False, what
        options = studio_api.CaptureOptions(
            request=bench.request, on_image=bench.preview.add, stop=job.stop
        )
        return out, options

    def _see_balls(
        self, images: Sequence[api.Image], balls: Mapping[str, Sequence[api.Detection]]
    ) -> None:
        for image in images:
            self.bench.preview.note_balls(image, studio_api.best_balls(balls[image.camera]))

    def take_other(self, body: Path | None) -> str:
        """Take the board that is seen, in place of the chosen one, and wave on.

        Where no board on offer is like it, nobody knows how large its squares are: that is asked.
        """
        other = self.state.other if self.state is not None else None
        if other is None or other.board is None:
            raise ConfigError("no other board is seen any more")
        self.bench.stop()
        if (known := board_like(self.bench, other.board)) is None:
            self.bench.seen_board = other.board
            return Hint("My board holds its squares: type how long one is, then wave it")
        self.bench.board = known
        self.take(body, waits=True)
        return f"{known} is the board that is seen"

    def end(self) -> None:
        """Take what there is for enough."""
        self.suffices = True
        self.bench.stop()

    def calibrate(self, body: Path | None, lenses: Path | None) -> None:
        """Calibrate by the newest pictures."""
        capture = self.capture or max(self.bench.folder.glob("capture-*"), default=None)
        if capture is None:
            raise ConfigError("there are no pictures of a board yet: wave it first")
        self.bench.calibrate(capture, self._hear, body, lenses)

    def _see(self, images: Sequence[api.Image], corners: Mapping[str, overlays.Floats]) -> None:
        for image in images:
            if image.camera in corners:
                self.bench.preview.hold(image, corners[image.camera])

    def _hear(self, result: api.CalibrationResult, report: Path) -> None:
        self.result, self.report = result, report

    @property
    def can_calibrate(self) -> bool:
        """Whether cameras can be calibrated by what is kept already."""
        return self.state is not None and self.state.position_sd_mm > 0

    @property
    def share(self) -> float:
        """How much of the accuracy that is asked for is there, 0 to 1."""
        state = self.state if self.can_calibrate else None
        return min(state.goal_mm / state.position_sd_mm, 1.0) if state else 0.0

    def advice(self) -> str:
        """What to do next, in large letters."""
        if not self.is_waved:
            return ""
        if self.state is None:
            return f"show the {self.what} to the cameras"
        return "\n".join(self.state.advice[:_ADVISED])

    def reached(self) -> str:
        """How far it is."""
        if not self.is_waved or self.state is None:
            return ""
        if not self.state.position_sd_mm > 0:
            return "too few views yet to say how accurate it will be"
        mm, goal_mm = self.state.position_sd_mm, self.state.goal_mm
        return f"expected error at the body {mm:.3f} mm; goal {goal_mm:g} mm"

    def seen_by(self, name: str) -> str:
        """What a camera has seen of what is waved, in a line."""
        if self.state is None or not (seen := self.state.cameras.get(name)) or not seen.views:
            return name
        return f"{name}: {_pictures(seen.views)}, {seen.tilts} of them tilted"

    def drawn_over(self, name: str) -> str:
        """Where a camera has seen it."""
        facts = self.bench.preview.facts(name)
        seen = self.state.cameras.get(name) if self.state is not None and self.is_waved else None
        if seen is None or facts is None:
            return ""
        return overlays.over(facts.size_wh, overlays.cells(facts.size_wh, seen.cells))


def _kept(last: api.WaveState) -> str:
    return _pictures(max(seen.views for seen in last.cameras.values()))


def _pictures(count: int) -> str:
    return "1 picture" if count == 1 else f"{count} pictures"


def add(bench: Bench) -> None:
    """Add the page."""
    wave = _Wave(bench)

    @ui.page("/calibration")
    def calibration() -> None:
        with page(bench, "/calibration"):
            with ui.column().classes("still") as still:
                intro(
                    "Glue the printed board to something flat, and wave it slowly where you will "
                    "measure: tilted, near and far, two cameras seeing it at a time. No board? "
                    "Wave the body, if the places of its balls are known.",
                    drawings.waving(),
                )
                _judgement(bench, wave)
            _progress(bench, wave, lambda: _one(bench, body), lambda: _one(bench, lenses))
            with ui.element("div").classes("duo"):
                with ui.element("div").classes("watching"):
                    camera_pictures(bench, wave.seen_by, wave.drawn_over).classes("watched")
                with ui.element("div").classes("saying") as boards:
                    choose_board(bench)
            body, lenses = _more(bench, wave)

        for one in (still, boards):  # Who waves looks at the pictures, from afar
            one.bind_visibility_from(wave, "is_waved", lambda is_waved: not is_waved)


def _more(bench: Bench, wave: _Wave) -> tuple[ui.select, ui.select]:
    """What is seldom changed; gives the choices of the body, and of lenses that are known."""
    more = details("More: the accuracy asked for, and pictures that are there already")
    with more, ui.row().classes("line"):
        body = choice("Body to be measured, or waved", bench, "bodies")
        lenses = choice("Lenses known from, for a waved body", bench, "calibrations")
        goal = ui.number("Error at the body that is small enough, mm", min=0.001, step=0.01)
        goal.bind_value(wave, "goal_mm").classes("field")
        by_newest = partial(_calibrate, bench, wave, body, lenses)
        act("Calibrate by the newest pictures", "tune", by_newest)
    return body, lenses


def _calibrate(bench: Bench, wave: _Wave, body: ui.select, lenses: ui.select) -> None:
    wave.calibrate(_one(bench, body), _one(bench, lenses))


def _one(bench: Bench, body: ui.select) -> Path | None:
    return next(iter(chosen(bench, body)), None)


def _progress(
    bench: Bench, wave: _Wave, body: Callable[[], Path | None], lenses: Callable[[], Path | None]
) -> None:
    """The buttons that begin, and what to do next while the board or the body is waved."""
    with ui.row().classes("line"):
        live_label(wave.advice, "figure lines", "data-advice")
        begin = act("Wave the board", "waving_hand", lambda: wave.take(body()), primary=True)
        by_body = act("Wave the body", "sports_handball", lambda: wave.take_body(body(), lenses()))
        enough = act("Enough for me", "done", wave.end, primary=True)
        other = act("Take the board that is seen", "swap_horiz", lambda: wave.take_other(body()))
        undo(bench, lambda: bench.folder / CALIBRATION, lambda: setattr(wave, "result", None))
    with ui.column().classes("advice") as shown:
        bar = ui.linear_progress(0.0, show_value=False).props("rounded size=0.9rem")
        bar.props('aria-label="how accurate it is, of what was asked for"')
        live_label(wave.reached, "hint")

    def show() -> None:
        begin.set_visibility(not bench.busy)
        by_body.set_visibility(not bench.busy)
        enough.set_visibility(wave.is_waved and wave.can_calibrate)
        seen = wave.state.other if wave.is_waved and wave.state is not None else None
        other.set_visibility(seen is not None and seen.board is not None)
        shown.set_visibility(wave.is_waved)
        bar.value = wave.share

    kept_so(0.4, show)


def _judgement(bench: Bench, wave: _Wave) -> None:
    """How good the calibration is, before what was noticed; notes are folded away."""
    with ui.column().classes("verdict") as shown:
        headline = ui.label().classes("figure").props("data-judgement")
        link("Report of the calibration, with the cameras in 3-D", bench, lambda: wave.report)
        found = ui.html("", sanitize=False).classes("findings")

    def show() -> None:
        shown.set_visibility(wave.result is not None and not wave.is_waved)
        if wave.result is None:
            headline.text = ""
        else:
            verdict = wave.result.verdict
            headline.text = _headline(verdict)
            put(headline, "wrong", not verdict.trustworthy)
            put(headline, "good", verdict.trustworthy)
            found.set_content(findings_shown(_findings(wave.result)))

    kept_so(0.5, show)


def _headline(verdict: api.Verdict) -> str:
    mean, worst = np.sqrt(np.mean(verdict.position_sd_mm**2)), verdict.position_sd_mm.max()
    good = "The cameras are calibrated" if verdict.trustworthy else "Do not trust this calibration"
    return f"{good}: expected error at the body {_mm(mean)}, at worst {_mm(worst)}"


def _mm(error_mm: float) -> str:
    """An expected error; no board on paper is known better than to a hundredth of a millimetre."""
    return f"{error_mm:.2f} mm" if error_mm >= _FINEST_MM else f"below {_FINEST_MM:g} mm"


def _findings(result: api.CalibrationResult) -> list[api.Finding]:
    """What was noticed: the judgement's findings, and all other lines as notes."""
    found = list(result.verdict.findings)
    bare = replace(result, verdict=replace(result.verdict, findings=()))
    others = bare.lines()[:-1]  # but for what stands in the headline
    return found + [api.Finding(api.Level.NOTE, "calibration", line) for line in others]
