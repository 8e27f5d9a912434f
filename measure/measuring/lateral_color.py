"""Lateral colour of cameras whose calibration does not say it, from what they see."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from measure.estimation.lateral_color import lateral_color
from measure.model import Camera, FrameSet

_FRAME_SETS, _STEP = 3, 4
_SIGMAS = 4.0
_FLOOR_PX = 0.04
"""Standard deviation at the picture's corner by colours of the scene, however many blocks agree."""
_SAME_FOCAL = 1.06  # Cameras whose focal lengths differ by no more than this factor are of one make


def with_lateral_color(
    cameras: Sequence[Camera], frame_sets: Iterable[FrameSet]
) -> tuple[Camera, ...]:
    """The cameras with the lateral colour that the first pictures show beyond doubt.

    Cameras of one size and focal length are of one make: what they see counts together.

    Args:
        cameras: those whose lateral colour is known keep it.
        frame_sets: from the start of a recording.
    """
    unknown = [camera for camera in cameras if camera.intrinsics.lateral_color is None]
    if not unknown:
        return tuple(cameras)
    seen = list(islice(frame_sets, 0, _STEP * _FRAME_SETS, _STEP))
    found: dict[str, Camera] = {}
    for camera in unknown:
        if camera.name not in found:
            alike = [one for one in unknown if one.name not in found and _of_one_make(one, camera)]
            found |= {one.name: one for one in _informed(alike, seen)}
    return tuple(found.get(camera.name, camera) for camera in cameras)


def _of_one_make(one: Camera, other: Camera) -> bool:
    a, b = one.intrinsics, other.intrinsics
    ratio = a.focal_px / b.focal_px
    return a.size_wh == b.size_wh and 1 / _SAME_FOCAL < ratio < _SAME_FOCAL


def _informed(alike: Sequence[Camera], seen: Sequence[FrameSet]) -> list[Camera]:
    """Cameras of one make with what their pictures show; as they are where that may be chance."""
    found = lateral_color(
        (frame_set.images[camera.name].pixels, camera.intrinsics.matrix[:2, 2])
        for frame_set in seen
        for camera in alike
        if camera.name in frame_set.images
    )
    if found is None:
        return list(alike)
    corner_px = np.hypot(*alike[0].intrinsics.size_wh) / 2
    sure = np.abs(found.red_blue) > _SIGMAS * np.hypot(found.sd, _FLOOR_PX / corner_px)
    red, blue = np.where(sure, found.red_blue, 0.0).tolist()
    return [
        replace(one, intrinsics=replace(one.intrinsics, lateral_color=(red, blue))) for one in alike
    ]
