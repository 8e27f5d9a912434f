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

from measure.lazily import load_lazily

__all__ = load_lazily(__name__)
