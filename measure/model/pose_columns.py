"""A pose as the columns of a table: their names, and the values."""

from __future__ import annotations

from typing import Any

from measure.model.observations import Pose

PLACE = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""The columns of a pose; the first three are those of any place."""
QUALITY = ("position_sd_mm", "rotation_sd_deg", "residual_mm", "rms_px")
"""Those that say how good it is."""


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
