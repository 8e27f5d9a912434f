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
from measure.model import Intrinsics

_STEPS, _REACH = 121, 12.0
"""Focal lengths tried, and how many times as long and as short as expected they are."""
_PIECES = 12
"""Independent pieces of an outline: edges next to each other err alike."""
_LEAST_SD_PX, _LEAST_SD_SHARE = 0.3, 0.003
"""Least error of an outline's pieces, in px and as a share of its radius: no ball is quite
round."""
_SINGULAR = 1e-9  # Size of an outline, in rad, and share of singular values that count as none
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
        off = _off_px(some, lens, factors)
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


def _off_px(points: Floats, lens: Intrinsics, factors: Floats) -> Floats:
    """RMS distances (k,) in px of outline points (n, 2) from cones through them; NaN without one.

    Args:
        factors: (k,) by which the lens's focal length is longer. Each has its own cone, fitted as
            by `geometry.fit_cone`, but all at once.
    """
    if len(points) < 3:
        return np.full(len(factors), np.nan)
    rays = lens.unproject(points)
    ideal = rays[:, :2] / rays[:, 2:] / factors[:, None, None]
    v = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=2)
    v /= np.linalg.norm(v, axis=2, keepdims=True)
    frame = np.linalg.svd(v.mean(axis=1, keepdims=True))[2]  # the mean ray, and two across it
    v = v @ frame.mT
    scale = np.ones((len(factors), 3))
    scale[:, 1:] = np.sqrt(np.mean(np.sum(v[..., 1:] ** 2, axis=2), axis=1))[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        u, s, vt = np.linalg.svd(v / np.maximum(scale, _SINGULAR)[:, None], full_matrices=False)
        w = (vt.mT @ (u.sum(axis=1) / s)[..., None])[..., 0] / scale
        length = np.linalg.norm(w, axis=1)
        w /= length[:, None]
        across = v - (v @ w[..., None]) * w[:, None]
        across /= np.linalg.norm(across, axis=2, keepdims=True)
        cosine = (1 / length)[:, None, None]
        on_cone = (cosine * w[:, None] + np.sqrt(1 - cosine**2) * across) @ frame
        off = (on_cone[..., :2] / on_cone[..., 2:] - ideal) * factors[:, None, None]
    off *= np.diag(lens.matrix)[:2]
    fits = (s[:, 2] > _SINGULAR * s[:, 0]) & (length > 1) & (on_cone[..., 2] > 0).all(axis=1)
    return np.where(fits, np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1)), np.nan)
