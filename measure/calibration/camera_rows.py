"""The cameras of a calibration as rows of a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.model import Camera


def camera_rows(
    cameras: Sequence[Camera],
) -> list[tuple[str, float, float, float, float | None]]:
    """Per camera: name, focal length px, position sd mm, rotation sd deg, reprojection RMS px.

    The standard deviations are in 3-D, NaN where the calibration states none.
    """
    rows = []
    for camera in cameras:
        P = camera.pose_covariance
        position, rotation = float("nan"), float("nan")
        if P is not None:
            position = float(np.sqrt(np.trace(P[:3, :3])))
            rotation = float(np.rad2deg(np.sqrt(np.trace(P[3:, 3:]))))
        rms = camera.reprojection_rms_px
        rows.append((camera.name, camera.intrinsics.focal_px, position, rotation, rms))
    return rows
