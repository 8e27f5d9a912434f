"""What circles of unknown distance let us expect of the balls that they may be."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.model import Camera, Expectation
from measure.model.lens import bearing


def expected_at(ball: str, x: float, y: float, radius_px: float) -> Expectation:
    """A ball looked for where a rough circle, approached, has been found."""
    spread = 0.25 * radius_px + 3
    return Expectation(
        ball=ball,
        center_px=np.array([x, y]),
        radius_px=(radius_px - spread, radius_px + spread),
        min_distance_px=0.0,
        reach_px=0.0,
    )


def center_by_size(expectation: Expectation, camera: Camera, radius_mm: float) -> Floats:
    """Where (3,) in the camera frame, in mm, a ball is that looks as large as expected."""
    axis = bearing(expectation.center_px, camera.intrinsics.row)
    half_angle = sum(expectation.radius_px) / 2 / camera.intrinsics.focal_px
    return axis * (radius_mm / np.sin(half_angle))
