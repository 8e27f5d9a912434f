"""A camera's focal length by the outlines of balls in one picture.

A ball's outline is stretched away from the principal point, by 1 / cos of the angle between line of
sight and optical axis: the farther out a ball lies, and the shorter the focal length is, the more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import fit_cone
from measure.model import Intrinsics

_STEPS, _REACH = 121, 12.0
"""Focal lengths tried, and how many times as long and as short as expected they are."""
_PIECES = 12
"""Independent pieces of an outline: edges next to each other err alike."""
_LEAST_SD_PX, _LEAST_SD_SHARE = 0.3, 0.003
"""Least error of an outline's pieces, in px and as a share of its radius: no ball is quite
round."""
_FAR_PX = 1e3  # Stands for the distance from a cone where there is none
_CONTRADICTION = 2.0
"""By how much the logarithm of the likelihood has to rise for outlines to contradict what was
expected: a factor of seven."""


class FocalLength(NamedTuple):
    """What outlines say of a focal length."""

    px: float  # the likeliest
    contradicts: bool  # whether the outlines contradict the one that was expected


def focal_by_outlines(
    outlines: Sequence[Floats], lens: Intrinsics, log_sd: float
) -> FocalLength | None:
    """The likeliest focal length of a lens, whose own is the expected one.

    Args:
        outlines: points (n, 2) in px of each ball's outline.
        lens: as it is expected, without distortion.
        log_sd: standard deviation of the logarithm of its focal length.

    Returns:
        None where no outline has a cone through it.
    """
    factors = np.geomspace(1 / _REACH, _REACH, _STEPS)
    costs = []
    for some in outlines:
        off = np.array([_off_px(some, zoomed(lens, factor)) for factor in factors])
        if np.isfinite(off).any():
            radius = float(np.linalg.norm(some - some.mean(axis=0), axis=1).mean())
            least = np.nanmin(off) ** 2 + _LEAST_SD_PX**2 + (_LEAST_SD_SHARE * radius) ** 2
            # Student's distribution: what is no ball has no say.
            costs.append(_PIECES / 2 * np.log1p(np.nan_to_num(off, nan=_FAR_PX) ** 2 / least))
    if not costs:
        return None
    total = np.sum(costs, axis=0)
    best = int(np.argmin(total + (np.log(factors) / log_sd) ** 2 / 2))
    contradicts = total[_STEPS // 2] - total[best] > _CONTRADICTION
    return FocalLength(float(lens.focal_px * factors[best]), bool(contradicts))


def zoomed(lens: Intrinsics, factor: float) -> Intrinsics:
    """The same lens with a focal length that is so many times as long."""
    scale = np.array([[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
    return replace(lens, matrix=lens.matrix * scale)


def _off_px(points: Floats, lens: Intrinsics) -> float:
    """RMS distance in px of outline points (n, 2) from the cone through them; NaN without one."""
    bearings = lens.unproject(points)
    try:
        cone = fit_cone(bearings)
    except DegenerateGeometryError:
        return float("nan")
    across = bearings - (bearings @ cone.axis)[:, None] * cone.axis
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    on_cone = np.cos(cone.half_angle) * cone.axis + np.sin(cone.half_angle) * across
    return float(np.sqrt(np.mean(np.sum((lens.project(on_cone) - points) ** 2, axis=1))))
