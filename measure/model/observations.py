"""What was seen: images, expectations, detections, their state, positions, poses and motions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Bytes, Floats, floats, stacked
from measure.geometry import RigidTransform

FULL = 250
"""Picture values from here on may be clipped: JPEG moves them by some levels."""


@dataclass(frozen=True, eq=False)
class Image:
    """One camera's picture."""

    camera: str  # the camera's name
    frame: int  # its number in that camera's recording
    time_s: float  # the middle of its exposure, on the session's clock
    # returns the pixels, BGR (h, w, 3) uint8; called once, maybe in another thread, and
    # again only if they are used after `release`.
    decode: Callable[[], Bytes]
    # the original JPEG bytes where there are any (for the viewer), else None.
    encoded: bytes | None = None
    time_sd_s: float = 0.0  # standard deviation of `time_s`, where its stamps show one
    _turn: Lock = field(default_factory=Lock, init=False, repr=False)
    _decoded: list[Bytes] = field(default_factory=list, init=False, repr=False)

    @property
    def pixels(self) -> Bytes:
        """BGR pixels (h, w, 3), decoded on first use."""
        # Not a `cached_property`: before Python 3.12 all instances share its lock, so that only
        # one thread of all would decode.
        with self._turn:
            if not self._decoded:
                self._decoded.append(self.decode())
            return self._decoded[0]

    def release(self) -> None:
        """Let go of the pixels, where they can be decoded again."""
        if self.encoded is not None:
            with self._turn:
                self._decoded.clear()


@dataclass(frozen=True, eq=False)
class FrameSet:
    """The images of all cameras that belong to one instant; a camera without one is left out."""

    index: int  # number of the set in the session
    time_s: float  # the instant
    images: dict[str, Image]  # by camera name
    # cameras whose image is damaged, and left out, with the name of its file.
    damaged: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Motion:
    """A pose at a time, with a velocity in the pose's `perturb` chart."""

    world_from_body: RigidTransform  # the pose at `time_s`
    time_s: float  # the instant
    velocity: Floats  # (6,) mm/s and rad/s, both in the world
    covariance: Floats | None = None  # (6, 6) of the pose at `time_s`; None if unknown
    velocity_covariance: Floats | None = None  # (6, 6) of the velocity; None if unknown
    # (6, 6) mean square of the acceleration that `moved` leaves out, in mm/s^2 and rad/s^2; None if
    # it leaves out none, or that is unknown.
    acceleration_square: Floats | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", floats("velocity", self.velocity, 6))

    @classmethod
    def at_rest(cls, world_from_body: RigidTransform, time_s: float) -> Motion:
        """A body that does not move."""
        return cls(world_from_body, time_s, np.zeros(6))

    def moved(self, time_s: ArrayLike) -> Floats:
        """How far (..., 6) the body has moved at other times (...), in the chart of the pose."""
        return np.multiply.outer(np.asarray(time_s) - self.time_s, self.velocity)

    def at(self, time_s: float) -> RigidTransform:
        """The pose at another time."""
        if time_s == self.time_s:
            return self.world_from_body
        return self.world_from_body.perturb(self.moved(time_s))


@dataclass(frozen=True, eq=False, slots=True)
class Expectation:
    """Where to look for one ball; a ball without one is searched for in the whole frame."""

    ball: str  # name of the ball
    center_px: Floats  # (2,) predicted projection of the sphere's centre
    radius_px: tuple[float, float]  # (smallest, largest) outline radius
    min_distance_px: float  # least distance between the centres of two circles of one colour
    reach_px: float  # how far the true centre may be from `center_px`
    # 1 normally; larger while tracking recovers (the paper's raised parameter range).
    tolerance: float = 1.0
    # (3,) predicted sphere centre in the camera frame in mm, where a 3-D prediction exists.
    center_camera: Floats | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Detection:
    """One ball in one image."""

    ball: str  # name of the ball
    camera: str  # name of the camera
    time_s: float  # middle of the exposure
    # (2,) projection of the *sphere's centre* where the detector knows it, else the circle's
    # centre.
    center_px: Floats
    radius_px: float  # mean outline radius
    covariance_px: Floats  # (2, 2) of `center_px`
    score: float = 1.0  # 0 to 1, the detector's own confidence
    # share of samples inside the border that have the ball's colour, or NaN if not checked.
    color_match: float = float("nan")
    # (n, 2) outline points in the distorted image, in any order, or None.
    outline_px: Floats | None = None
    # (n,) their standard deviations along the normal; None if `outline_px` is.
    outline_sd_px: Floats | None = None

    @property
    def variance_px2(self) -> float:
        """Variance of `center_px` along an axis, the mean of both."""
        return float(self.covariance_px.item(0) + self.covariance_px.item(3)) / 2


class State(StrEnum):
    """The paper's two states of one ball in one camera (section II.D)."""

    EFFECTIVE = "effective"
    SUSPENDED = "suspended"


class Reason(StrEnum):
    """Why a ball is suspended in a camera."""

    NONE = ""
    JUMPED = "moved too far between frames"
    COLOR = "colour check failed"
    NOT_FOUND = "not found"
    INCONSISTENT = "disagrees with the other cameras"
    RECOVERING = "good again, but not yet for long enough"
    NO_IMAGE = "no image"
    MOVED = "its camera was moved"


@dataclass(frozen=True, eq=False, slots=True)
class BallView:
    """One ball in one camera at one instant."""

    ball: str  # name of the ball
    camera: str  # name of the camera
    state: State  # whether the detection is used
    reason: Reason = Reason.NONE  # why it is suspended; `Reason.NONE` if it is effective
    detection: Detection | None = None  # what was detected, if anything

    @property
    def effective(self) -> bool:
        """Whether the detection may be used."""
        return self.state is State.EFFECTIVE and self.detection is not None


@dataclass(frozen=True, eq=False, slots=True)
class BallPosition:
    """A ball's centre in the world."""

    ball: str  # name of the ball
    time_s: float  # the instant
    center: Floats  # (3,) in mm
    covariance: Floats  # (3, 3) in mm^2
    cameras: tuple[str, ...]  # names of the cameras used
    # distance of each used camera's ray from `center`, in the order of `cameras`.
    residuals_mm: Floats
    dropped: tuple[str, ...] = ()  # cameras left out as outliers

    @property
    def rms_mm(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(np.square(self.residuals_mm))))


@dataclass(frozen=True, eq=False, slots=True)
class Pose:
    """The body's pose."""

    time_s: float  # the instant it holds for
    world_from_body: RigidTransform  # the pose
    # (6, 6) in the pose's `perturb` chart: x y z mm, rotation vector rad, in the world. The world's
    # scale, which all poses share, is not in it: see `scale_sd` of the calibration file.
    covariance: Floats
    residual_mm: float  # RMS distance between positions and the body's balls, NaN if not applicable
    rms_px: float  # RMS reprojection error, of a moving body at the time of each image
    cameras: tuple[str, ...]  # names of the cameras used
    balls: tuple[str, ...]  # names of the balls used
    flags: tuple[str, ...] = ()  # reasons to doubt it, each a `Doubt` or a sentence of its own
    # by name, derivatives (6, 18) of the pose by a camera's pose and intrinsics (see
    # `Camera.covariance`); `covariance` holds the share of it; None if not known.
    by_camera: Mapping[str, Floats] | None = None

    @property
    def position_sd_mm(self) -> float:
        """Standard deviation of the 3-D position: root of the trace of its covariance."""
        return math.sqrt(sum(self.covariance.diagonal()[:3].tolist()))

    @property
    def rotation_sd_deg(self) -> float:
        """Standard deviation of the 3-D rotation: root of the trace of its covariance, in deg."""
        return math.degrees(math.sqrt(sum(self.covariance.diagonal()[3:].tolist())))


@lru_cache(maxsize=8)
def stacked_detections(seen: tuple[Detection, ...]) -> tuple[Floats, Floats]:
    """Centres (n, 2) in px of n >= 1 detections and their covariances (n, 2, 2).

    They are asked about several times, and compare by identity; what is returned is kept, and not
    to be changed.
    """
    return stacked([d.center_px for d in seen]), stacked([d.covariance_px for d in seen])


@lru_cache(maxsize=8)
def stacked_positions(positions: tuple[BallPosition, ...]) -> tuple[Floats, Floats]:
    """Centres (n, 3) in mm and covariances (n, 3, 3) of n positions, as `stacked_detections`."""
    if not positions:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    return stacked([position.center for position in positions]), stacked(
        [position.covariance for position in positions]
    )
