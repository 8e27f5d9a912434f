"""What all pages share: the folder, the cameras, and the one thing that is done at a time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from measure import api
from measure.errors import ConfigError, MeasureError
from measure_studio import api as studio_api
from measure_studio.page.words import named

BOARD = "charuco_8x5_27"
"""Offered first: parts of it count, its turns are distinguishable, and it is found fast."""
CALIBRATION = "calibration.toml"  # In the folder: the newest, whichever page made it
CameraState = Literal["live", "away", "held"]
CONNECTING = studio_api.WatchedCamera.CONNECTING
_FRESH_S = 3.0  # A camera delivers if its newest picture is younger
_PATIENCE_S = 3.0  # Longest wait for cameras to be closed
_CAMERAS = "cameras.txt"  # In the folder: NAME=ADDRESS a line, without those that hold a secret


class Job:
    """Work in a thread of its own; its result is for people, its problem empty if there is none."""

    def __init__(
        self, title: str, work: Callable[[Job], str], on_end: Callable[[Job], object] = id
    ) -> None:
        self.stop = threading.Event()
        self.title = title
        self.result = self.problem = ""
        self.ended_s = math.inf  # When it was over
        self._on_end = on_end
        self._thread = threading.Thread(target=self._run, args=(work,), daemon=True)
        self._thread.start()

    @property
    def title(self) -> str:
        """What is being done; a new title begins a new part of the work."""
        return self._title

    @title.setter
    def title(self, title: str) -> None:
        self._title, self._begun_s = title, time.monotonic()
        self._pace = api.ProgressClock(self._begun_s)
        self.stop.clear()

    @property
    def runs(self) -> bool:
        """Whether it is not over yet."""
        return self._thread.is_alive()

    def wait(self, seconds: float) -> None:
        """Wait for its end, not for longer than this."""
        self._thread.join(seconds)

    def progress(self, done: int, total: int | None) -> None:
        """Hear how far it is; MeasureError where it is to stop."""
        if self.stop.is_set():
            raise MeasureError(f"stopped: {self.title}")
        self._pace.note(done, total, time.monotonic())

    def lasts(self, seconds: float | None) -> None:
        """Hear that this part takes so long, and how far it is by the clock."""
        if seconds:
            now_s = time.monotonic()
            self._pace.note(0, round(1e3 * seconds), self._begun_s)
            self._pace.note(round(1e3 * (now_s - self._begun_s)), round(1e3 * seconds), now_s)

    @property
    def share(self) -> float | None:
        """How much of this part is done, below 1; None if nobody knows."""
        return self._pace.share

    @property
    def lasted_s(self) -> float:
        """How long this part of the work goes on already."""
        return time.monotonic() - self._begun_s

    def text(self) -> str:
        """What is being done and the clock, or how it ended."""
        if self.runs:
            return f"{self.title}: {self._pace.text(time.monotonic())}"
        return self.problem or self.result

    def _run(self, work: Callable[[Job], str]) -> None:
        try:
            self.result = work(self)
        except MeasureError as problem:
            self.problem = str(problem)
        except OSError as problem:
            self.problem = f"{problem.filename or ''}: {problem.strerror}"
        except BrokenProcessPool:
            self.problem = f"{self.title}: a process was killed, perhaps for want of memory"
        finally:
            self.ended_s = time.monotonic()
            self._on_end(self)


def before_of(file: Path) -> Path:
    """Where the version before of a file is kept."""
    return file.with_name(f"{file.name}.before")


class Bench:
    """The state of a set-up.

    Attributes:
        folder: everything read and written lies below it.
        local: whether only this machine can look.
        given: what cameras of this machine are set to.
        cameras: in the order in which they were given.
        preview: their newest pictures.
        job: what is or was being done last; None at first.
        waiting: what is done next, in turn: titles, and what begins it.
        board: file in the folder, or shipped target, that is waved and that the world begins at;
            the newest file at first, for a board was measured then.
        seen_board: a board that was seen, and whose size nobody knows yet.
        body: the body that was chosen last, to be looked for in the previews.
        searched: the bodies whose balls are looked for in them.
        viewer: address of the Rerun viewer, while it is there.
    """

    def __init__(
        self, folder: Path, registry: api.Registry, local: bool, request: studio_api.CaptureRequest
    ) -> None:
        self.folder, self.registry, self.local = folder.resolve(), registry, local
        self.given, self.cameras = request, list[studio_api.CameraAddress]()
        self.preview = studio_api.Preview()
        self.job: Job | None = None
        boards = studio_api.contents_of(folder).boards if folder.is_dir() else ()
        self.board = str(boards[0].relative_to(folder)) if boards else BOARD
        self.seen_board: api.Charuco | api.Chessboard | None = None
        self.body: Path | None = None
        self.searched: Sequence[api.Body] = ()
        self.viewer = ""
        self.waiting = list[tuple[str, Callable[[], None]]]()
        self._holds = False  # Whether what goes on has taken the cameras
        self._watched: dict[studio_api.CameraAddress, studio_api.WatchedCamera] = {}
        self._balls: studio_api.BallWatch | None = None
        self._counts: Mapping[str, studio_api.CameraCount] | None = None
        self._changed = dict[Path, str]()  # The last change of files that keep one version
        self._turn = threading.Lock()
        self._calibration: tuple[int, api.Calibration] | None = None  # When it was written, too

    @property
    def busy(self) -> bool:
        """Whether something is being done that needs the cameras, or much of this computer."""
        return self.job is not None and self.job.runs

    @property
    def now(self) -> Mapping[str, studio_api.CameraNow]:
        """State of each camera, whoever reads it at the moment."""
        if self._counts is not None:
            return {
                name: studio_api.CameraNow.of(name, count) for name, count in self._counts.items()
            }
        return {one.name: watched.now for one, watched in self._watched.items()}

    def state(self, name: str) -> tuple[CameraState, str]:
        """How a camera is, and why it delivers nothing, if so."""
        known = self.now.get(name)
        problem = known.problem.removeprefix(f"camera '{name}': ") if known else ""
        if not self._holds:
            if problem == CONNECTING:
                return "held", problem
            return ("away", problem or "not read") if problem or not known else ("live", "")
        # While a board is watched nobody counts pictures: they come, or do not.
        if self.preview.age_s(name) < _FRESH_S:
            return "live", ""
        if any(self.preview.age_s(one) < _FRESH_S for one in self.names):
            return "away", problem or "no picture comes"
        return "held", f"in use: {self.job.title if self.job else ''}"

    def problem(self, name: str) -> str:
        """Why a camera delivers nothing now; empty if it does, or if it is in use."""
        state, why = self.state(name)
        return why if state == "away" else ""

    @property
    def names(self) -> list[str]:
        """Names of the cameras, in their order."""
        return [one.name for one in self.cameras]

    @property
    def calibration(self) -> api.Calibration | None:
        """The newest calibration that was made here, read once; None without one."""
        file = self.folder / CALIBRATION
        try:
            changed = file.stat().st_mtime_ns
            if self._calibration is None or self._calibration[0] != changed:
                self._calibration = changed, api.read_calibration(file)
        except (OSError, MeasureError):
            return None
        return self._calibration[1]

    def target(self) -> Path:
        """The file of the board."""
        return api.shipped_targets().get(self.board) or api.inside(self.folder, self.board)

    def cameras_told(self) -> str:
        """How the cameras are, in a line."""
        if not self.cameras:
            return "no camera yet"
        problems = {name: text for name in self.names if (text := self.problem(name))}
        if len(problems) > 2:  # more sentences than a line holds
            return f"{len(problems)} of {len(self.cameras)} cameras deliver nothing"
        if problems:
            return "; ".join(named(name, text) for name, text in problems.items())
        count = len(self.cameras)
        return f"{count} cameras deliver" if count > 1 else "one camera delivers"

    def load_cameras(self, words: tuple[str, ...] = ()) -> None:
        """Take the cameras that were given, or those of the last time."""
        file = self.folder / _CAMERAS
        if not words and file.is_file():
            words = tuple(file.read_text("utf-8").split("\n"))
        self.set_cameras(studio_api.parse_cameras([word for word in words if word.strip()]))

    def set_cameras(self, cameras: list[studio_api.CameraAddress]) -> None:
        """Watch these from now on; MeasureError if that cannot be now, or of a file elsewhere."""
        self.refuse_if_busy()
        self.job = self.job if self.job and not self.job.problem else None
        for one in cameras:
            if not (one.is_device or "://" in one.address):
                api.inside(self.folder, one.address)
        self.cameras = cameras
        kept = [f"{one.name}={one.address}\n" for one in cameras if not one.holds_secret]
        (self.folder / _CAMERAS).write_text("".join(kept), "utf-8")
        self.watch()

    def set_controls(self, text: str, lock: bool) -> None:
        """Set cameras of this machine, as `--control` and `--lock` do, now and from now on."""
        self.refuse_if_busy()
        self.given = replace(self.given, control=(text,) if text.strip() else (), lock=lock)
        self.let_go()
        self.watch()

    def watch(self) -> None:
        """Read the cameras for looking at them, and for nothing else."""
        for gone in self._watched.keys() - set(self.cameras):
            self._watched.pop(gone).stop()
        for one in self.cameras:
            if one not in self._watched:
                # A file is meant from the folder, wherever the program was started.
                there = one.below(self.folder)
                self._watched[one] = studio_api.WatchedCamera(there, self.preview.add, self.given)
        self._look_for_balls()

    def let_go(self) -> None:
        """Close the cameras, for whoever needs them next."""
        if self._balls is not None:
            self._balls.stop()
        for one in self._watched.values():
            one.stop()
        until_s = time.monotonic() + _PATIENCE_S
        for one in self._watched.values():
            one.wait(max(until_s - time.monotonic(), 0.0))
        self._watched, self._balls = {}, None

    @property
    def looks(self) -> bool:
        """Whether balls are being looked for in the previews."""
        return self._balls is not None

    def look_for(self, bodies: Sequence[api.Body]) -> None:
        """Search the previews for the balls of these, as soon as cameras are watched."""
        self.searched = bodies
        if not self._holds:
            self._look_for_balls()

    def _look_for_balls(self) -> None:
        if self._balls is not None:
            self._balls.stop()
        self._balls = None
        if self.searched:
            self._balls = studio_api.BallWatch(
                self.preview, self.names, self.searched, self.registry
            )

    def refuse_if_busy(self) -> None:
        """Refuse (ConfigError) a second thing at a time."""
        if self.job is not None and self.busy:
            raise ConfigError(f"{self.job.title} goes on: stop it, or wait until it has ended")

    def begin(
        self,
        title: str,
        work: Callable[[Job], str],
        needs_cameras: bool = False,
        waits: bool = False,
    ) -> None:
        """Do something in the background; the cameras are watched again when it is over.

        Args:
            waits: whether it waits for its turn, if something else goes on; else it is refused
                (ConfigError) then.
        """

        def with_cameras(job: Job) -> str:
            self._holds = True
            self.let_go()
            try:
                return work(job)
            finally:
                self._counts = None
                self.watch()
                self._holds = False

        def start() -> None:
            self.job = Job(title, with_cameras if needs_cameras else work, self._go_on)

        with self._turn:
            if not waits:
                self.refuse_if_busy()
            if not self.busy:
                start()
            elif title not in [other for other, _ in self.waiting]:
                self.waiting.append((title, start))

    def _go_on(self, ended: Job) -> None:
        """Begin what waits, unless what it waited for failed."""
        with self._turn:
            if ended.problem:
                self.waiting.clear()
            if self.waiting:
                self.waiting.pop(0)[1]()

    def note_counts(self, counts: Mapping[str, studio_api.CameraCount]) -> None:
        """Hear from whoever reads the cameras what came of them."""
        self._counts = counts

    @property
    def request(self) -> studio_api.CaptureRequest:
        """What `record` and `live` are to set cameras to; nothing if none can be set."""
        takes = any(one.is_device for one in self.cameras)
        return self.given if takes else studio_api.CaptureRequest()

    def addresses(self) -> list[studio_api.CameraAddress]:
        """The cameras as `record` and `live` take them; ConfigError if there is none."""
        if not self.cameras:
            raise ConfigError("there is no camera yet: add them on the page Cameras")
        return [one.below(self.folder) for one in self.cameras]

    def record(
        self,
        job: Job,
        session: Path,
        seconds: float | None,
        calibration: Path | None,
        bodies: Sequence[Path] = (),
    ) -> studio_api.RecordedSession:
        """Record into a session, as part of a job."""

        def hear(counts: Mapping[str, studio_api.CameraCount]) -> None:
            self.note_counts(counts)
            job.lasts(seconds)

        look, stop = self.preview.add, job.stop
        options = studio_api.CaptureOptions(seconds, self.request, on_image=look, stop=stop)
        cameras = self.addresses()
        return studio_api.record(
            cameras, session, options, calibration=calibration, bodies=bodies, on_state=hear
        )

    def calibrate(
        self,
        capture: Path,
        hear: Callable[[api.CalibrationResult, Path], None],
        body: Path | None = None,
        lenses: Path | None = None,
    ) -> None:
        """Calibrate by a capture, or a waved body; `hear` gets what was found, and its report."""
        work = partial(self.calibrated, capture=capture, hear=hear, body=body, lenses=lenses)
        self.begin(f"calibrating by {capture.name}", work)

    def calibrated(
        self,
        job: Job,
        capture: Path,
        hear: Callable[[api.CalibrationResult, Path], None],
        body: Path | None = None,
        lenses: Path | None = None,
    ) -> str:
        """The same as part of a job."""
        job.title, out = f"calibrating by {capture.name}", self.folder / CALIBRATION
        before = out.read_bytes() if out.is_file() else None
        found = api.calibrate_to(
            capture,
            out,
            self.registry,
            overwrite=True,
            body=body,
            lenses=lenses if api.is_session(capture) else None,
            progress=job.progress,
        )
        self.keep(out, before, "the calibration")
        hear(*found)
        return f"{capture.name} gave {CALIBRATION}"

    def keep(self, file: Path, before: bytes | None, what: str) -> None:
        """Keep what a file held before, if it was there; `take_back` brings it back.

        Args:
            what: what was changed, for people: "the world".
        """
        kept, self._changed[file] = before_of(file), what
        if before is None:
            kept.unlink(missing_ok=True)
        else:
            kept.write_bytes(before)

    def changed(self, file: Path) -> str:
        """What was changed last in a file."""
        return self._changed.get(file, "the last change")

    def take_back(self, file: Path) -> str:
        """Exchange a file for what it held before; ConfigError if nothing is kept of it."""
        self.refuse_if_busy()
        kept = before_of(file)
        if not kept.is_file():
            raise ConfigError(f"no other version of {file.name} is kept")
        now = file.read_bytes()
        file.write_bytes(kept.read_bytes())
        kept.write_bytes(now)
        what = self._changed.get(file, file.name)
        return f"{what} is as it was before; once more takes this back"

    def stop(self) -> None:
        """End what goes on, as an interrupt would, and forget what waits."""
        self.waiting.clear()
        if self.job is not None:
            self.job.stop.set()

    def close(self) -> None:
        """End everything, and wait till what was measured is written."""
        until_s = time.monotonic() + 10.0
        while self.job is not None and self.job.runs and time.monotonic() < until_s:
            self.stop()  # Each part of the work: a process that ends amidst it may be aborted
            self.job.wait(0.2)
        self.let_go()
