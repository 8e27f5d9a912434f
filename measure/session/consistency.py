"""Whether bodies can be measured together, and whether cameras and body are in one unit."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np

from measure.arrays import Floats
from measure.errors import CalibrationError, DegenerateGeometryError, SessionError
from measure.geometry import align_points
from measure.model import Ball, Body, Camera, ColorRange
from measure.model.body import HUE_PERIOD
from measure.session.calibration_file import Calibration

_MOST_BODIES = 6
_ALIKE_MM = 3.0
"""Bodies whose balls can be laid on each other this closely are distinguished by colours alone."""
_NO_NAME = set('/\\:,"\n\r\t')  # A body's name stands in file names, entity paths and tables


def check_bodies(bodies: Sequence[Body], reference: str, source: str) -> None:
    """Refuse (SessionError) bodies of one name, alike, or with a reference that is none of them."""
    names = [body.name for body in bodies]
    if len(names) > _MOST_BODIES:
        raise SessionError(f"{source}: {len(names)} bodies, but at most {_MOST_BODIES} fit a run")
    if reference and (reference not in names or len(names) == 1):
        raise SessionError(
            f"{source}: the reference '{reference}' must be one of several bodies; there is "
            f"{', '.join(names)}"
        )
    if len(names) == 1:
        return
    for name in names:
        if names.count(name) > 1:
            raise SessionError(
                f"{source}: two bodies are called '{name}': write another name = \"...\" at the "
                "top of one body file"
            )
        if not name.strip() or _NO_NAME & set(name):
            raise SessionError(f"{source}: {name!r} cannot name a body: take letters and digits")
    for one, other in combinations(bodies, 2):
        if may_be_confused(one, other):
            raise SessionError(
                f"{source}: bodies '{one.name}' and '{other.name}' cannot be distinguished: "
                f"balls of the same colours lie at the same places within {_ALIKE_MM:g} mm; "
                "change a colour, or move a ball of one of them"
            )


def may_be_confused(one: Body, other: Body) -> bool:
    """Whether all balls of the body with fewer lie on balls of their colours of the other."""
    few, many = sorted((one, other), key=lambda body: len(body.balls))
    for balls in permutations(many.balls, len(few.balls)):
        if not all(map(_same_color, few.balls, balls)):
            continue
        places = np.stack([ball.center_mm for ball in balls])
        try:
            off_mm = align_points(places, few.centers).apply(few.centers) - places
        except DegenerateGeometryError:
            continue
        if np.max(np.linalg.norm(off_mm, axis=1)) < _ALIKE_MM:
            return True
    return False


def _same_color(one: Ball, other: Ball) -> bool:
    """Whether each hue's range holds the middle of the other; of red and orange neither does."""
    return any(
        a.space == b.space
        and _hue_inside(a, b)
        and _hue_inside(b, a)
        and all(max(a.low[i], b.low[i]) <= min(a.high[i], b.high[i]) for i in (1, 2))
        for a in one.color.ranges
        for b in other.color.ranges
    )


def _hue_inside(box: ColorRange, other: ColorRange) -> bool:
    """Whether the middle of another range's first level lies in this range."""
    (low, *_), (high, *_) = box.low, box.high
    middle = (other.low[0] + other.high[0]) // 2
    if other.low[0] > other.high[0]:
        middle = (middle + HUE_PERIOD // 2) % HUE_PERIOD
    return low <= middle <= high if low <= high else not high < middle < low


_FARTHEST_BASES = 20.0
"""No rig is used at a distance beyond this multiple of that between its cameras."""
_LEAST_PX = 1.0
"""No body appears smaller than this from the middle of the distances at which cameras meet."""
_SIGHTS, _STEPS = np.array([0.25, 0.5, 0.75]), 40


def check_unit(calibration: Calibration, body: Body, source: str, cure: str = "") -> None:
    """Refuse translations of the cameras that cannot be in the unit of the body's lengths.

    CalibrationError: wherever two cameras look, the body is larger than their pictures or too small
    to be seen. `cure` says what to do; what to write into the file if omitted.
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
