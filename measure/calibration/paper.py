"""The paper's camera localisation: one camera at a time from its markers, equation 3.

The board gives a rough pose, the markers refine it: the vector from the camera to a marker, v_c2m,
and the vector from the marker's image to the camera, v_i2c, must be parallel. The paper writes
v_c2m(k) / v_i2c(k) = |v_c2m| / |v_i2c| for k = 1, 2, 3; multiplied out, because a quotient has no
value where a component is zero, and divided by both lengths, that is
v_c2m / |v_c2m| - v_i2c / |v_i2c| = 0: three equations a marker, six unknowns a camera, solved by
Levenberg and Marquardt.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.sights import Sights
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera


def locate_by_markers(
    start: Camera, markers: Floats, pixels: Floats
) -> tuple[RigidTransform, Floats]:
    """Pose of one camera by the paper's equation 3.

    Args:
        start: with the rough pose from its board.
        markers: (n, 3) marker positions in the world, mm, n >= 3.
        pixels: (n, 2) where the camera sees them.

    Returns:
        world_from_camera, and its covariance (6, 6) from the equations' residuals.

    Raises:
        CalibrationError: fewer than three markers, or no optimum found.
    """
    from scipy.optimize import least_squares

    if len(markers) < 3:
        raise CalibrationError(
            f"camera {start.name}: the paper's equation 3 needs 3 markers, got {len(markers)}"
        )
    bearings = start.intrinsics.unproject(pixels)

    def equation_3(unknowns: Floats) -> Floats:
        pose = start.world_from_camera.perturb(unknowns)
        c2m = markers - pose.translation
        i2c = pose.rotate(bearings)
        return np.ravel(c2m / np.linalg.norm(c2m, axis=1, keepdims=True) - i2c)

    found = least_squares(
        equation_3, np.zeros(6), method="lm", x_scale=np.repeat([100.0, 0.1], 3), xtol=1e-12
    )
    if not found.success:
        raise CalibrationError(f"camera {start.name}: equation 3 has no optimum: {found.message}")
    # Two of the three equations of a marker are independent.
    variance = 2 * found.cost / max(2 * len(markers) - 6, 1)
    jacobian = np.asarray(found.jac, dtype=np.float64)
    covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian) * variance, dtype=np.float64)
    return start.world_from_camera.perturb(found.x), covariance


def fit_rig_by_paper(start: tuple[Camera, ...], sights: Sights) -> tuple[Camera, ...]:
    """Every camera by itself, from its markers, beginning at its rough pose.

    Raises:
        CalibrationError: a camera without at least three marks.
    """
    out = []
    for camera in start:
        marks = sights.marks.get(camera.name)
        if marks is None:
            raise CalibrationError(
                f"camera {camera.name}: the paper's method needs its markers: give marks.csv or "
                "marker_image"
            )
        points = sights.markers[marks.ids]
        pose, covariance = locate_by_markers(camera, points, marks.pixels)
        located = replace(camera, world_from_camera=pose, pose_covariance=covariance)
        error = located.project(points) - marks.pixels
        rms = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        out.append(replace(located, reprojection_rms_px=rms))
    return tuple(out)
