"""What cameras see of things whose place in the world is known, and how exactly it is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.boards import Board, Corners
from measure.geometry import RigidTransform


@dataclass(frozen=True, eq=False)
class BoardObservation:
    """A board of known pose, seen by one camera."""

    board: Board
    corners: Corners  # those that are seen
    world_from_board: RigidTransform

    @property
    def points(self) -> Floats:
        """The seen corners (n, 3) in the board frame, mm."""
        return self.board.points[self.corners.ids]


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
    boards: Mapping[str, BoardObservation] = field(default_factory=dict)
    marks: Mapping[str, MarkerObservation] = field(default_factory=dict)
    tolerances: Tolerances = field(default_factory=Tolerances)
