"""The interfaces of all kinds of plugins.

A plugin is a class with a `name`, a `Config` and one method. Plugins of this project and of others
are treated alike; `measure.testing` checks that a class keeps its contract.

Detectors, triangulators and pose solvers measure; a tracker holds the state that the pipeline keeps
between frame sets; estimators correct a robot's position error; sinks send poses as soon as they
are known.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, TypeAlias

from measure.arrays import Floats
from measure.errors import ConfigError, PluginError
from measure.host.dataset import Dataset, Turns
from measure.host.settings import Settings
from measure.model import (
    BallPosition,
    BallView,
    Body,
    Camera,
    Detection,
    Doubt,
    Expectation,
    FrameSet,
    Image,
    Motion,
    Pose,
)

NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
"""Pattern of plugin names: lower case, words joined by "-"."""


class Plugin(ABC):
    """Base of all kinds of plugins."""

    name: ClassVar[str]  # how a user selects it; lower case, words joined by "-"
    Config: ClassVar[type[Settings]] = Settings  # its settings, a frozen pydantic model

    def warm_up(self) -> None:  # noqa: B027 - most plugins have nothing to do here
        """Compile or load what is slow, before the first frame is timed or waited for."""

    def warm_up_parts(self) -> Sequence[Callable[[], object]]:
        """`warm_up` in parts that may run in either order: two processes share what takes long."""
        return (self.warm_up,)


class Detector(Plugin):
    """Finds the balls of a body in one camera's images.

    What it finds in an image depends on that image alone, unless the class says `stateful`.
    """

    # whether results depend on the images seen before. Images then come in order of time. A
    # detector that keeps no state may be shown images again.
    stateful: ClassVar[bool] = False
    # whether its detections hold outlines (`Detection.outline_px`); None if that depends on the
    # images, and is found out from the first ones.
    provides_outlines: ClassVar[bool | None] = None

    def __init__(self, config: Settings, body: Body, camera: Camera) -> None:
        self.config = config
        self.body = body
        self.camera = camera

    @abstractmethod
    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """Find balls.

        Args:
            image: BGR uint8 pixels of size `camera.intrinsics.size_wh`, with time and name.
            expected: at most one per ball; a ball without one is searched for in the whole frame.

        Returns:
            Detections. A ball that is not seen is simply absent. For an expected ball there is at
            most one; for a searched ball there may be several candidates, the best score first, and
            geometry decides.
        """


class SelfCalibratingDetector(Detector):
    """Optional interface: a detector that estimates its camera's image formation from the images.

    It uses an image for that only if it is later than all before. Images known to it may therefore
    come again, in any order, and then give the same detections; it is not `stateful`.
    """

    @property
    @abstractmethod
    def needs_burn_in(self) -> bool:
        """Whether it needs more images before those of a recording are measured.

        While any camera's detector says so, the first frame sets of a recording are measured for
        this alone, up to a limit; then the recording is measured from its start. Images of cameras
        that deliver now are not repeated.
        """

    @property
    @abstractmethod
    def calibration_state(self) -> object:
        """Its estimates, for the detectors of the other cameras; None if there are none yet."""

    @abstractmethod
    def fuse_calibration(self, states: Sequence[object]) -> None:
        """Combine the estimates of all cameras; called once, at the end of the burn-in.

        Args:
            states: `calibration_state` of the detectors of all cameras, its own among them.
        """

    @abstractmethod
    def enter_realtime(self) -> None:
        """Do work that takes longer than an image in the background from now on.

        Called where cameras are measured live, after the burn-in. Results may then
        depend on the speed of the machine.
        """


class Triangulator(Plugin):
    """Turns detections of one ball in several cameras into its centre in the world."""

    def __init__(self, config: Settings) -> None:
        self.config = config

    @abstractmethod
    def triangulate(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> BallPosition | None:
        """Locate one ball.

        Args:
            detections: of one ball, at most one per camera, all effective.
            cameras: by name.

        Returns:
            The position, or None if the detections do not determine one (fewer than two cameras,
            parallel rays).
        """

    def triangulate_all(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> list[BallPosition]:
        """Locate every ball, ball by ball unless overridden: one call may cost less than many.

        Args:
            detections: of any balls, at most one per ball and camera, all effective.
            cameras: by name.

        Returns:
            The results of `triangulate` for all balls of two detections or more, in order of first
            appearance.
        """
        by_ball: dict[str, list[Detection]] = {}
        for detection in detections:
            by_ball.setdefault(detection.ball, []).append(detection)
        several = [seen for seen in by_ball.values() if len(seen) > 1]
        positions = [self.triangulate(seen, cameras) for seen in several]
        return [position for position in positions if position is not None]


class PoseSolver(Plugin):
    """Turns detections and positions of the balls into the body's pose.

    Attributes:
        requires_outlines: whether it needs detections that hold outlines.
        config: its settings.
        body: what is located.
    """

    requires_outlines: ClassVar[bool] = False

    def __init__(self, config: Settings, body: Body) -> None:
        self.config = config
        self.body = body

    @abstractmethod
    def solve(
        self,
        positions: Sequence[BallPosition],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body.

        Args:
            positions: at most one per ball.
            detections: every effective detection; a solver may fit these and skip the positions.
            cameras: by name.
            time_s: the instant of the pose; each detection has its own `time_s`.
            prior: where the body is expected and how it moves, if known.

        Returns:
            The pose, or None if there is too little to determine one.
        """


Review = Callable[[Mapping[str, Sequence[Detection]]], None]
"""Takes the detections of whole images by camera name; what follows holds from the next on."""


@dataclass(frozen=True, eq=False, slots=True)
class Conclusion:
    """An accepted pose, perhaps with flags added and a note, or None and the reason.

    Flags, note and reason are sentences, or `Doubt`s.
    """

    pose: Pose | None  # accepted
    reason: str = ""  # why there is none; with a pose, a note that is no doubt of it


class Tracker(Plugin):
    """Holds the state between frame sets; the pipeline calls its methods in this order for each.

    `expect` -> (detectors) -> `judge` -> `motion` -> (triangulator, solver) -> `conclude`.
    """

    def __init__(self, config: Settings, body: Body, cameras: Sequence[Camera]) -> None:
        self.config = config
        self.body = body
        self.cameras = tuple(cameras)

    def use_cameras(self, cameras: Sequence[Camera]) -> None:
        """From now on cameras of the same names stand elsewhere: one was moved, and is known anew.

        A tracker that keeps more of its cameras than `self.cameras` overrides this.
        """
        self.cameras = tuple(cameras)

    @abstractmethod
    def expect(self, frame_set: FrameSet) -> Mapping[str, Sequence[Expectation]] | None:
        """Where each ball is expected in each camera, by camera name.

        A ball without an expectation is searched for in the whole frame, all of them if the mapping
        is empty. None: this frame set is skipped (the paper's "skips a few frames and restarts").
        """

    def doubt(self, frame_set: FrameSet) -> Review | None:  # noqa: ARG002
        """Takes what whole images show, to settle a doubt; None without one. After `conclude`."""
        return None

    @abstractmethod
    def judge(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> tuple[BallView, ...]:
        """The state of every ball in every camera, each with at most one detection."""

    @abstractmethod
    def motion(self, time_s: float) -> Motion | None:
        """The predicted pose and velocity around `time_s`; None if unknown."""

    @abstractmethod
    def conclude(
        self,
        frame_set: FrameSet,
        views: Sequence[BallView],
        positions: Sequence[BallPosition],
        pose: Pose | None,
        residuals_px: Mapping[tuple[str, str], Floats],
    ) -> Conclusion:
        """Update the state with the result, and accept, flag or refuse the pose.

        Args:
            views: as returned by `judge`.
            positions: from the effective views.
            residuals_px: by (ball, camera), detected minus predicted centre (2,) of every effective
                view; empty without a pose.
        """


Report: TypeAlias = Callable[[float, str], None]
"""Progress of a fit: called often, with the share done (0 to 1) and a few words."""


def quiet(done: float, what: str) -> None:
    """A `Report` that does nothing."""
    del done, what


@dataclass(frozen=True, eq=False)
class Correction:
    """An estimated position error."""

    error_mm: Floats  # (3,) measured minus reported position; add it to the reported position
    covariance: Floats  # (3, 3) in mm^2
    # True if the state is unlike anything in training: do not rely on `error_mm`.
    unfamiliar: bool = False
    turn: Turns | None = None  # a single one, of the tip's rotation, where that was learnt
    # True if the state's joints and reported tip disagree: `error_mm` is zero.
    contradictory: bool = False


@dataclass(frozen=True)
class Epoch:
    """One point of a learning curve."""

    epoch: int  # number of passes over the data so far
    train_mm: float  # RMS error on the training trajectories, mm
    validation_mm: float  # RMS error on the validation trajectories, mm


@dataclass(frozen=True)
class RecordingLeftOut:
    """A recording that a fit has not seen, its covariance fitted to the other such recordings."""

    name: str  # of the recording
    labels: int  # how many it was judged by
    before_mm: float  # RMS error, mm
    after_mm: float  # what the fit left of it, mm
    stated_mm: float  # the SD stated of that, RMS, mm
    inside_95: float  # share of labels in the 95 % region


@dataclass(frozen=True)
class LeftOut:
    """What the covariance was fitted to."""

    recordings: int  # how many recordings there were to learn from
    # how many groups of them were left out in turn; 0 if it was fitted to validation trajectories,
    # which says nothing of a new recording where there is one only.
    groups: int
    before_mm: float  # RMS error of the rows it was fitted to, mm
    after_mm: float  # what fits without them left of it, mm
    by_recording: tuple[RecordingLeftOut, ...] = ()  # where there were two or more to leave out


class Estimator(Plugin):
    """Corrects a robot's reported position from its own state; history is kept inside."""

    curve: tuple[Epoch, ...] = ()  # how the fit went, if it was iterative
    left_out: LeftOut | None = None  # what its covariance was fitted to, if it tells
    # largest number of groups of recordings that a fit may leave out in turn to judge its
    # covariance; 0 leaves none out.
    folds: int = 4
    findings: tuple[str, ...] = ()  # what the fit found, in lines for the model card
    # a folder where a fit may keep what it has reached, and find it again.
    checkpoint: Path | None = None

    def __init__(self, config: Settings) -> None:
        self.config = config

    def after(self, first: Estimator) -> Self:
        """Learn what `first` leaves, which learns before, from the same; PluginError: it cannot."""
        raise PluginError(
            f"estimator '{self.name}' cannot learn what '{first.name}' leaves: both must be "
            "OnnxEstimators"
        )

    @abstractmethod
    def fit(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Learn from `data`; choose and stop, and judge the covariance, by `validation`.

        EstimatorError: the data cannot be learnt from.

        Args:
            data: trajectories to learn from.
            validation: other trajectories of the same robot.
            seed: of everything random.
            report: to be called as the work goes on.
        """

    @abstractmethod
    def save(self, path: Path, card: Mapping[str, Any]) -> None:
        """Write one ONNX file, which `measure_learning.onnx.OnnxModel` can run.

        Args:
            card: what to store beside the network: training data, scores, revision.
        """

    @abstractmethod
    def reset(self) -> None:
        """Forget all history: a new trajectory begins."""

    @abstractmethod
    def update(self, state: Floats, time_s: float) -> Correction:
        """Take the next state (features,), ordered as in training, and estimate the error."""


PLACE = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""The columns of a pose; the first three are those of any place."""
QUALITY = ("position_sd_mm", "rotation_sd_deg", "residual_mm", "rms_px")
"""Those that say how good it is."""


@dataclass(frozen=True, eq=False, slots=True)
class SentPose:
    """A body's pose of one frame set as a sink gets it, or that there is none."""

    body: str  # the body's name
    reference: str  # name of the body whose frame the pose is in; empty for the world
    frame: int  # number of the frame set
    time_s: float  # the instant that the pose holds for, on the run's clock
    # the same instant in seconds since 1970, on this machine's clock; of a run that is played, the
    # time of its turn.
    exposed_s: float
    known_s: float  # when the pose was known, in seconds since 1970
    status: str  # ok, flagged, lost or skipped
    reason: str  # why it is not ok; empty otherwise
    # the pose; its `world_from_body` is reference_from_body where there is a reference.
    pose: Pose | None
    doubts: tuple[Doubt, ...] = ()  # what `reason` is made of

    def plain(self) -> dict[str, Any]:
        """All of it as JSON knows it, by the names of `poses.parquet`; null for NaN."""
        names = ("body", "reference", "time_s", "exposed_s", "known_s", "status", "reason")
        values = {"frame": self.frame, **{name: getattr(self, name) for name in names}}
        values |= {"cameras": (), "balls": (), "flags": (), **pose_columns(self.pose)}
        doubts = [one.plain for one in self.doubts]
        return {**{name: _plain(value) for name, value in values.items()}, "doubts": doubts}


@dataclass(frozen=True, slots=True)
class EventMark:
    """An event that the lab reported while a run was measured."""

    time_s: float  # when, on the run's clock
    marked_s: float  # the same in seconds since 1970, as `SentPose.exposed_s`
    text: str  # what


@dataclass(frozen=True, eq=False)
class SentRun:
    """The run that poses are sent of."""

    name: str  # of the run
    bodies: tuple[Body, ...]  # what is measured
    cameras: tuple[Camera, ...]  # as calibrated
    # name of the body that the others are also sent relative to; empty without one.
    reference: str = ""

    @property
    def streams(self) -> list[tuple[str, str]]:
        """`body` and `reference` of every kind of pose that is sent."""
        names = [body.name for body in self.bodies]
        relative = [(n, self.reference) for n in names if self.reference and n != self.reference]
        return [(name, "") for name in names] + relative


class Sink(Plugin):
    """Sends poses on; used by one thread of its own, which may wait for nobody but itself.

    An exception is reported in one line; the sink is then closed, and opened again a second later.

    Attributes:
        form: how its address is typed after `--send`, such as `udp://HOST:PORT`.
        takes_pictures: whether `send_pictures` is called.
        config: its settings.
        address: what was typed, without the scheme.
        run: what is sent.
        notes: lines for the user about what is sent, made by `prepare`.
        undelivered: how many poses it took and could not hand to every receiver.
    """

    form: ClassVar[str]
    takes_pictures: ClassVar[bool] = False

    def __init__(self, config: Settings, address: str, run: SentRun) -> None:
        self.config, self.address, self.run = config, address, run
        self.undelivered, self.notes = 0, list[str]()
        self.prepare()

    @abstractmethod
    def prepare(self) -> None:
        """Read the address and load libraries; ConfigError: it is none, or one is missing."""

    def open(self) -> None:
        """Connect, or listen for receivers."""

    @abstractmethod
    def send(self, pose: SentPose) -> None:
        """Send a pose, or that there is none."""

    def send_mark(self, mark: EventMark) -> None:
        """Send an event mark."""

    def send_pictures(self, images: Mapping[str, Image]) -> None:
        """Send the pictures of a frame set, by camera, when there is time."""

    def close(self) -> None:
        """Disconnect; whether it was opened or not."""


def pose_columns(pose: Pose | None) -> dict[str, Any]:
    """A pose as columns of `poses.parquet`; NaN without one."""
    if pose is None:
        return dict.fromkeys((*PLACE, *QUALITY), float("nan"))
    place = (*pose.world_from_body.translation, *pose.world_from_body.quat_wxyz)
    return {
        **dict(zip(PLACE, map(float, place), strict=True)),
        "covariance": pose.covariance.ravel(),
        "position_sd_mm": pose.position_sd_mm,
        "rotation_sd_deg": pose.rotation_sd_deg,
        "residual_mm": float(pose.residual_mm),
        "rms_px": float(pose.rms_px),
        "cameras": pose.cameras,
        "balls": pose.balls,
        "flags": pose.flags,
    }


def _plain(value: Any) -> Any:
    """What JSON knows; no digits that mean nothing."""
    if isinstance(value, float):
        return float(f"{value:.9f}") if math.isfinite(value) else None
    if isinstance(value, tuple | list):
        return [float(f"{one:.6g}") if isinstance(one, float) else one for one in value]
    return _plain(value.tolist()) if hasattr(value, "tolist") else value


def host_port(address: str, usual: int = 0) -> tuple[str, int]:
    """Read HOST:PORT; ConfigError for anything else.

    With a `usual` port, HOST alone has that, and nothing at all is 127.0.0.1.
    """
    if usual and (not address or address.endswith("]") or ":" not in address):
        address = f"{address or '127.0.0.1'}:{usual}"
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 65_536):
        raise ConfigError("expected HOST:PORT, such as 127.0.0.1:5005")
    return host.strip("[]"), int(port)
