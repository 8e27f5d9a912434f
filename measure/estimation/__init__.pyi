from measure.estimation.body_layout import layout_flags, looks_mirrored, thickness
from measure.estimation.expected_accuracy import (
    body_pose_sd,
    noise_sd,
    tolerance_covariance,
    tolerance_sd,
)
from measure.estimation.multiview import (
    PointObservations,
    calibration_noise,
    fit_point,
    point_sensitivity,
    ray_distances,
)
from measure.estimation.point_fit import (
    PointFit,
    PointFits,
    fit_point_rows,
    fit_points,
    warm_up_point_fits,
)
from measure.estimation.pose_fit import PoseFit, PoseObservations, fit_pose

__all__ = [
    "PointFit", "PointFits", "PointObservations", "PoseFit", "PoseObservations", "body_pose_sd",
    "calibration_noise", "fit_point", "fit_point_rows", "fit_points", "fit_pose", "layout_flags",
    "looks_mirrored", "noise_sd", "point_sensitivity", "ray_distances", "thickness",
    "tolerance_covariance", "tolerance_sd", "warm_up_point_fits",
]  # fmt: skip
