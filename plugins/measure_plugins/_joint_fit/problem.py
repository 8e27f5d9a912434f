"""The observations of the joint fit: all outlines of one frame set as arrays.

The model of their residuals is formula 5 of docs/explanation/joint_fit.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.model.lens import RAY, fill_rays

_MIN_POINTS = 3  # Outline points that determine a cone
_MAX_RELATIVE_VARIANCE = 2.0
_MIN_VARIANCE_PX2 = 5e-9  # For detectors that state no uncertainty at all


class PackedOutlines(NamedTuple):
    """k ball-views with n outline points together; ball-view i has those from start[i] on."""

    start: Ints  # (k + 1,)
    rays: Floats  # (9, n) of the points, see `lens.fill_rays`
    sharpness: Floats  # (n,) one over the points' standard deviations, px^-1
    view_of: Ints  # (k,) index of the camera among those used
    centers_body: Floats  # (k, 3) of the balls, mm
    radii: Floats  # (k,) mm
    # (k, 6) how far the body has moved, at the picture's time, from where it is at the pose's time
    # (mm, rad, world).
    motion: Floats
    relative_variance: Floats  # (k,) of each outline's random shift, relative to the others'
    rotations: Floats  # (c, 3, 3) of camera_from_world
    translations: Floats  # (c, 3) of camera_from_world, mm

    def points(self, i: int) -> slice:
        """Where ball-view i's points are."""
        return slice(int(self.start[i]), int(self.start[i + 1]))


class BallRows(NamedTuple):
    """The balls of k ball-views, and the c cameras that show them; see `PackedOutlines`."""

    view_of: Ints
    centers_body: Floats
    radii: Floats
    lenses: Floats  # (c, 16) see `Intrinsics.row`
    rotations: Floats
    translations: Floats


def pack(
    points: Sequence[Floats], sd: Sequence[Floats], covariances: Floats, balls: BallRows
) -> tuple[PackedOutlines, list[int]]:
    """Pack ball-views of a body at rest.

    Points beyond the reach of the lens model are left out.

    Args:
        points: k outlines (n, 2), px.
        sd: (n,) of each, px.
        covariances: (k, 2, 2) of the outlines' centres, px^2.

    Returns:
        The outlines, and which of the k ball-views have points enough to be fitted.
    """
    start = np.array([0, *accumulate(map(len, sd))])
    at, sharpness = np.concatenate(points), 1 / np.concatenate(sd)
    rays, reached, relative = outline_rays(at, start, covariances, balls.view_of, balls.lenses)
    counts, kept = reached.tolist(), list(range(len(sd)))
    if sum(counts) < len(at):
        good = np.isfinite(rays[0])
        kept = [i for i, count in enumerate(counts) if count >= _MIN_POINTS]
        rays, sharpness = rays[:, good].copy(), sharpness[good]
        start = np.array([0, *accumulate(counts)])
    outlines = PackedOutlines(
        start,
        rays,
        sharpness,
        balls.view_of,
        balls.centers_body,
        balls.radii,
        np.zeros((len(sd), 6)),
        relative,
        balls.rotations,
        balls.translations,
    )
    return outlines, kept


@compiled
def outline_rays(
    points: Floats, start: Ints, covariances: Floats, view: Ints, lenses: Floats
) -> tuple[Floats, Ints, Floats]:
    """The rays (9, n) of pixels (n, 2), see `lens.fill_rays`; NaN where the lens has no inverse.

    And how many pixels of each ball-view (k,) have one, and its `relative_variance` (k,).
    """
    rays, reached = np.empty((RAY, len(points))), np.zeros(len(view), np.int64)
    for i in range(len(view)):
        fill_rays(points, start[i], start[i + 1], lenses[view[i]], rays)
        reached[i] = np.sum(np.isfinite(rays[0, start[i] : start[i + 1]]))
    return rays, reached, _relative_variances(covariances)


@compiled
def _relative_variances(covariances: Floats) -> Floats:
    """Variances (k,) of the outlines' random shifts, relative to their median.

    Where the edges of an outline scatter more, the outline as a whole is shifted further as well,
    but by less than in proportion: the root of the relative variance is taken, within limits
    (docs/explanation/joint_fit.md, formula 6).
    """
    out = (covariances[:, 0, 0] + covariances[:, 1, 1]) / 2
    typical = max(np.median(out), _MIN_VARIANCE_PX2)
    for i in range(len(out)):
        relative = np.sqrt(out[i] / typical)
        out[i] = min(max(relative, 1 / _MAX_RELATIVE_VARIANCE), _MAX_RELATIVE_VARIANCE)
    return out
