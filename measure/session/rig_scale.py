"""Whether cameras and body are in one unit: the body must fit into the cameras' common view."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.model import Body, Camera
from measure.session.calibration_file import Calibration

_FARTHEST_BASES = 20.0
"""No rig is used at a distance beyond this multiple of that between its cameras."""
_LEAST_PX = 1.0
"""No body appears smaller than this from the middle of the distances at which cameras meet."""
_SIGHTS, _STEPS = np.array([0.25, 0.5, 0.75]), 40


def check_unit(calibration: Calibration, body: Body, source: str, cure: str = "") -> None:
    """Refuse translations of the cameras that cannot be in the unit of the body's lengths.

    Args:
        source: where the calibration comes from, for the message.
        cure: what to do, for the message; what to write into the file if omitted.

    Raises:
        CalibrationError: wherever two cameras look, the body is larger than their pictures or too
            small to be seen.
    """
    distance = _common_distances(calibration.cameras)
    if not len(distance):
        return
    apart = np.linalg.norm(body.centers[:, None] - body.centers[None], axis=2)
    size = float(np.max(apart + body.radii[:, None] + body.radii[None]))
    focal = np.array([camera.intrinsics.focal_px for camera in calibration.cameras])
    pictures = np.array([max(camera.intrinsics.size_wh) for camera in calibration.cameras])
    width = float(np.max(distance) * np.max(pictures / focal))
    if size > width:
        usual = "multiply each translation_mm by 1000 (or 10)"
        if "format" in calibration.provenance:
            usual = 'say calibration_unit = "m" (or "cm") in [session], or unit = "m" in the file'
        raise CalibrationError(
            f"{source}: the translations look like m (or cm), not mm: two cameras share a view of "
            f"{width:.2g} mm at most, and body '{body.name}' measures {size:.3g} mm; "
            f"{cure or usual}"
        )
    appears = size * float(np.max(focal) / np.median(distance))
    if appears < _LEAST_PX:
        raise CalibrationError(
            f"{source}: the translations are no mm, or the lengths of body '{body.name}' are none: "
            f"it measures {size:.3g} mm and would appear {appears:.1g} px wide; "
            + (cure or 'of another program\'s file calibration_unit = "mm" in [session] says so')
        )


def _common_distances(cameras: tuple[Camera, ...]) -> Floats:
    """Distances (n,) from a camera at which another one sees the same place, in their unit."""
    centers = np.stack([camera.center for camera in cameras])
    base = float(np.linalg.norm(centers[:, None] - centers[None], axis=2).max())
    steps = np.geomspace(1e-2, _FARTHEST_BASES, _STEPS) * base
    u, v = np.meshgrid(_SIGHTS, _SIGHTS)
    common = [np.zeros(0)]
    for camera in cameras:
        rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]) * camera.intrinsics.size_wh)
        places = (rays.origins[:, None] + steps[:, None] * rays.directions[:, None]).reshape(-1, 3)
        others = (other for other in cameras if other is not camera)
        seen = [other.intrinsics.contains(other.project(places)) for other in others]
        common += [np.tile(steps, len(rays.directions))[shared] for shared in seen]
    return np.concatenate(common)
