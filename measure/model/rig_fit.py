"""What cameras see of things of known place, and a fit of all cameras to that."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from measure.arrays import Floats, Ints, floats
from measure.geometry import RigidTransform
from measure.model.camera import Camera


@dataclass(frozen=True, eq=False)
class BoardObservation:
    """A board of known pose, seen by one camera."""

    points: Floats  # (n, 3) its corners that are seen, in the board frame, mm
    pixels: Floats  # (n, 2) where they appear
    world_from_board: RigidTransform  # as stated


@dataclass(frozen=True, eq=False)
class MarkerObservation:
    """Markers seen by one camera."""

    ids: Ints  # (n,) their numbers in the field
    pixels: Floats  # (n, 2) where they appear
    # whether most of them were found by search. The light draws found dots one way, so that all
    # marks of a picture may share an offset; a hand has no such habit.
    searched: bool = False


@dataclass(frozen=True)
class Tolerances:
    """How exactly the things of known place are known, as standard deviations."""

    marker_mm: float = 0.1  # of each coordinate of a marker; 0 is exact
    board_mm: float = 0.0  # of each coordinate of a board's origin; 0 is exact
    board_deg: float = 0.0  # of a board's turn about each axis; 0 is exact
    # of each coordinate of the offset that found marks of a picture share; 0: none.
    common_px: float = 0.0


@dataclass(frozen=True, eq=False)
class RigObservations:
    """All that the cameras see of things whose place in the world is known."""

    # (k, 3) stated positions of the markers in the world, mm.
    markers: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    boards: Mapping[str, BoardObservation] = field(default_factory=dict)  # by camera name
    marks: Mapping[str, MarkerObservation] = field(default_factory=dict)  # by camera name
    tolerances: Tolerances = field(default_factory=Tolerances)  # as stated, or estimated


@dataclass(frozen=True, eq=False)
class RigFit:
    """Cameras as fitted to `RigObservations`."""

    cameras: tuple[Camera, ...]  # with their covariances, in the order in which they were given
    # of all cameras' poses and free lens parameters (`Intrinsics.free`) together, camera after
    # camera.
    covariance: Floats
    mark_sd_px: float  # of marks, as stated or estimated from the residuals
    corner_sd_px: float | None = None  # the same of corners; None: the boards have no say in it
    # by camera name (n, 2) px, where they are not marks less projected markers.
    mark_residuals: Mapping[str, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = sum(6 + len(camera.intrinsics.free) for camera in self.cameras)
        floats("covariance", self.covariance, size, size)


CameraFit = Callable[[tuple[Camera, ...], RigObservations, float | None], RigFit]
"""Takes cameras at their rough poses, what they see, and the marks' standard deviation in px if it
is stated. `CalibrationError`: what is seen does not suffice."""
