"""What triangulators and pose solvers share, open to every plugin.

- One ball centre from its pixels in several cameras: `PointObservations`, `fit_point`,
  `point_sensitivity`, `ray_distances`, `calibration_noise`.
- Many ball centres in one call: `fit_points`; from compiled code: `fit_point_rows`;
  to be called in `warm_up`: `warm_up_point_fits`.
- A pose from ball centres in pictures, without triangulation: `PoseObservations`, `fit_pose`.
- Whether measured centres have the body's distances and handedness: `layout_flags`,
  `looks_mirrored`, `thickness`.
- Which accuracy of a body's pose to expect: `noise_sd`, `tolerance_sd`, `tolerance_covariance`,
  `body_pose_sd`.

Lengths are mm, angles rad, times s, pixels as in `docs/conventions.md`. What is compiled is loaded
when it is first asked for: importing a plugin that names it here at its top costs that time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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

_MODULES = {
    "body_layout": ("layout_flags", "looks_mirrored", "thickness"),
    "expected_accuracy": ("body_pose_sd", "noise_sd", "tolerance_covariance", "tolerance_sd"),
    "point_fit": ("PointFit", "PointFits", "fit_point_rows", "fit_points", "warm_up_point_fits"),
    "pose_fit": ("PoseFit", "PoseObservations", "fit_pose"),
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = next((room for room, names in _MODULES.items() if name in names), "multiview")
    return getattr(import_module(f"{__name__}.{module}"), name)
