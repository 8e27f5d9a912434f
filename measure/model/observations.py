"""What was seen: expectations, detections, their state, positions and poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np

from measure.arrays import Floats, stacked
from measure.geometry import RigidTransform


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
    flags: tuple[str, ...] = ()  # reasons to doubt it, empty if none
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
