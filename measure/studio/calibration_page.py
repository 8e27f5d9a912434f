"""Calibration: a board is waved until its pictures are enough; then cameras and world from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nicegui import ui

from measure import api
from measure.errors import ConfigError
from measure.studio.bench import Bench, Job
from measure.studio.layout import act, camera_card, choice, chosen, link, page, told

_ADVISED = 4  # Pieces of advice that are shown at a time


@dataclass
class _Wave:
    """What is asked for, and what was taken and calibrated last; it outlives the browser's page."""

    bench: Bench
    goal_mm: float = 0.2
    capture: Path | None = None
    state: api.WaveState | None = None
    result: api.CalibrationResult | None = None
    report: Path | None = None
    printed: Path | None = None

    def draw(self) -> None:
        """Draw the board, to be printed."""
        out = self.bench.folder / f"{self.bench.target().stem}.pdf"
        self.printed = api.draw_target(self.bench.target(), out, overwrite=True)[1]

    def take(self, body: Path | None) -> None:
        """Take pictures of the board until they are enough."""
        bench = self.bench
        cameras, out = bench.addresses(), bench.folder / api.next_free(bench.folder, "capture")

        def work(job: Job) -> str:
            self.capture, self.state, self.result = out, None, None
            last = api.capture_board(
                cameras,
                self.bench.target(),
                out,
                api.CaptureOptions(bench.request, on_image=bench.preview.add, stop=job.stop),
                body=body,
                goal_mm=self.goal_mm,
                on_state=lambda state: setattr(self, "state", state),
            )
            return f"{out.name}: {last.sentence() if last else 'no picture came'}"

        bench.begin("watching the board", work, needs_cameras=True)

    def calibrate(self, body: Path | None) -> None:
        """Calibrate by the newest pictures."""
        capture = self.capture or max(self.bench.folder.glob("capture-*"), default=None)
        if capture is None:
            raise ConfigError("there are no pictures of a board yet: wave it first")
        self.bench.calibrate(capture, self._hear, body)

    def _hear(self, result: api.CalibrationResult, report: Path) -> None:
        self.result, self.report = result, report

    def advice(self) -> str:
        """What to do next, in a few lines."""
        return "" if self.state is None else "\n".join(self.state.advice[:_ADVISED]) or "enough"

    def seen_by(self, name: str) -> str:
        """What a camera has seen of the board."""
        if self.state is None or name not in self.state.cameras:
            return name
        seen, pairs = self.state.cameras[name], self.state.pairs.items()
        others = [f"{n} with {' '.join({*pair} - {name})}" for pair, n in pairs if name in pair]
        return (
            f"{name}: {seen.views} pictures, {seen.tilts} tilted\n"
            f"farthest {seen.distances:.1f} times the nearest, sharpness {seen.sharpness:.2f}\n"
            f"{', '.join(others)}"
        )


def add(bench: Bench) -> None:
    """Add the page."""
    wave = _Wave(bench)

    @ui.page("/calibration", title="Calibration")
    def calibration() -> None:
        with page(bench, "/calibration"):
            _steps(bench, wave)
            _progress(wave)
            with ui.element("div").classes("cards"):
                for one in bench.cameras:
                    _camera(bench, wave, one.name)
            _judgement(bench, wave)


def _steps(bench: Bench, wave: _Wave) -> None:
    there = api.contents_of(bench.folder)
    own = [str(file.relative_to(bench.folder)) for file in there.boards]
    with ui.row().classes("line"):
        board = ui.select([*own, *api.shipped_targets()], label="Board").classes("field")
        board.bind_value(bench, "board")
        act("Draw it", "print", wave.draw)
        link("PDF, to print at 100 %", bench, lambda: wave.printed)
        body = choice("Body to be measured", bench, there.bodies)
        goal = ui.number("Goal at the body, mm", min=0.001, step=0.01)
        goal.bind_value(wave, "goal_mm")

    def with_body(work: Callable[[Path | None], None]) -> Callable[[], None]:
        return lambda: work(next(iter(chosen(bench, body)), None))

    with ui.row().classes("line"):
        act("Wave the board", "waving_hand", with_body(wave.take))
        act("Calibrate", "tune", with_body(wave.calibrate))


def _progress(wave: _Wave) -> None:
    told(wave.advice, "figure lines", "data-advice")
    bar = ui.linear_progress(0.0, show_value=False).props("rounded size=1.2rem")
    told(
        lambda: f"{wave.state.sentence()}; goal {wave.state.goal_mm:g} mm" if wave.state else "",
        "hint",
    )

    def show() -> None:
        state = wave.state
        known = state is not None and state.position_sd_mm > 0
        bar.value = min(state.goal_mm / state.position_sd_mm, 1.0) if state and known else 0.0
        bar.set_visibility(state is not None)

    ui.timer(0.4, show)


def _camera(bench: Bench, wave: _Wave, name: str) -> None:
    card = camera_card(bench, name, 480, lambda: wave.seen_by(name))
    with card, ui.element("div").classes("cells").props('title="where the board was seen"'):
        cells = [ui.element("div") for _ in range(9)]

    def show() -> None:
        if wave.state is not None and name in wave.state.cameras:
            corners = wave.state.cameras[name].cells.ravel()
            for cell, share in zip(cells, corners / max(corners.max(), 1.0), strict=True):
                cell.style(f"--share: {share:.2f}")

    ui.timer(0.5, show)


def _judgement(bench: Bench, wave: _Wave) -> None:
    told(lambda: "\n".join(wave.result.lines()) if wave.result else "", mark="data-judgement")
    link("Report of the calibration, with the cameras in 3-D", bench, lambda: wave.report)
