"""What circles of unknown distance let us expect of the balls that they may be."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.model import Camera, Expectation
from measure.model.lens import bearing


def radii_about(radius_px: float) -> tuple[float, float]:
    """Smallest and largest radius, px, of an outline that a rough circle leads to."""
    spread = 0.25 * radius_px + 3
    return radius_px - spread, radius_px + spread


def center_by_size(expectation: Expectation, camera: Camera, radius_mm: float) -> Floats:
    """Where (3,) in the camera frame, in mm, a ball is that looks as large as expected."""
    axis = bearing(expectation.center_px, camera.intrinsics.row)
    half_angle = sum(expectation.radius_px) / 2 / camera.intrinsics.focal_px
    return axis * (radius_mm / np.sin(half_angle))
