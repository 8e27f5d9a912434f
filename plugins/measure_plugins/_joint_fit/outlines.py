"""All outlines of one frame set as arrays, and what the joint fit sums over their points.

The residual of an outline point with bearing v, about a ball seen along the unit vector u with the
half angle a, is r = g (acos(v.u) - a), in px: g is the picture's scale along the outline's normal.
A step dc of the ball's centre, at the distance D, changes it by -(g / D)(e - tan(a) u).dc, where e
is the unit vector perpendicular to u towards v.

No pixel changes when its bearing only grows. With J, the pixel's derivatives by v, a step along e
therefore moves it by -J u / s, where s = |v x u|: that is the normal, and g = |J u| / s.

The weighted sums of products of those derivatives, the moments, are all that the fit needs of the
points, as long as its pose stays about where they were formed. See docs/explanation/joint_fit.md,
formulas 1 to 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled, inlined
from measure.geometry.covariance import MAD_TO_SD, TUKEY_SIGMAS
from measure.geometry.kernels import turned
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


COLUMNS = 10
"""The pose's six, the view's offset, the outline's normal along x and y, and the residual."""
_LOCAL = 7  # The same with the ball's centre (in the camera frame) for the pose


@compiled
def accumulate_moments(
    outlines: PackedOutlines,
    rotation: Floats,
    translation: Floats,
    offsets: Floats,
    effects: Floats,
    moments: Floats,
) -> None:
    """Fill the moments of all ball-views.

    Args:
        rotation: (3, 3) of world_from_body.
        translation: (3,) of world_from_body.
        offsets: (c,) outward edge offset of every view, px.
        effects: (k, 3) random effects of the ball-views, for the robust weights, px.
        moments: (k, 10, 10) filled.
    """
    arms, arm, center = np.empty((3, 6)), np.empty(3), np.empty(3)
    for k in range(len(outlines.view_of)):
        view, first, last = outlines.view_of[k], outlines.start[k], outlines.start[k + 1]
        _place(outlines, k, rotation, translation, arm, center)
        columns = np.empty((_LOCAL, last - first))
        for i in range(last - first):
            _fill_column(outlines, k, i, center, offsets[view], columns)
        weights = _weights(columns, outlines.sharpness[first:last], effects[k])
        sums = np.dot(columns * weights, columns.T)
        _fill_arms(outlines.rotations[view], arm, arms)
        _by_pose(sums, arms, moments[k])


@inlined
def _place(
    outlines: PackedOutlines,
    k: int,
    rotation: Floats,
    translation: Floats,
    arm: Floats,
    center: Floats,
) -> None:
    """Fill where ball-view k's ball is: from the body's origin, and in the camera frame."""
    body, moved, view = outlines.centers_body[k], outlines.motion[k], outlines.view_of[k]
    for a in range(3):
        arm[a] = rotation[a, 0] * body[0] + rotation[a, 1] * body[1] + rotation[a, 2] * body[2]
    place, inward = turned(moved[3], moved[4], moved[5], arm), outlines.rotations[view]
    x = place[0] + translation[0] + moved[0]
    y = place[1] + translation[1] + moved[1]
    z = place[2] + translation[2] + moved[2]
    for a in range(3):
        center[a] = inward[a, 0] * x + inward[a, 1] * y + inward[a, 2] * z
        center[a] += outlines.translations[view, a]


@inlined
def _fill_column(
    outlines: PackedOutlines, k: int, i: int, center: Floats, offset: float, out: Floats
) -> None:
    """Fill the derivatives of the residual of ball-view k's point i, and the residual.

    Rows: derivatives by the centre's x, y, z (camera frame, px/mm) and by the offset (1), the
    outline's unit normal in the picture, and the residual in px, outward.
    """
    ray = outlines.rays[:, outlines.start[k] + i]
    x, y, z = center
    per_mm = 1 / np.sqrt(x * x + y * y + z * z)
    x, y, z, sine = x * per_mm, y * per_mm, z * per_mm, outlines.radii[k] * per_mm
    cosine = np.sqrt(1 - sine * sine)
    axial = x * ray[0] + y * ray[1] + z * ray[2]
    radial = np.sqrt((1 - axial) * (1 + axial))
    right = -(x * ray[3] + y * ray[4] + z * ray[5])
    down = -(x * ray[6] + y * ray[7] + z * ray[8])
    length = np.sqrt(right * right + down * down)
    # The angle beyond the cone, by its sine; the next term is below 1e-9 rad at 10 px.
    beyond = radial * cosine - axial * sine
    out[6, i] = length / radial * (beyond + beyond * beyond * beyond / 6) - offset
    out[3, i], out[4, i], out[5, i] = 1.0, right / length, down / length
    slope, toward = per_mm * length / (radial * radial), axial + radial * sine / cosine
    out[0, i] = slope * (ray[0] - toward * x)
    out[1, i] = slope * (ray[1] - toward * y)
    out[2, i] = slope * (ray[2] - toward * z)


@inlined
def _weights(columns: Floats, sharpness: Floats, effect: Floats) -> Floats:
    """Tukey's weights (n,) of a ball-view's points over their variances (formulas 8 and 9)."""
    x, y, growth = effect
    left = (columns[6] - columns[4] * x - columns[5] * y - growth) * sharpness
    scale = max(MAD_TO_SD * np.median(np.abs(left)), 0.3)
    for i in range(len(left)):
        t = left[i] / (scale * TUKEY_SIGMAS)
        robust = (1 - t * t) * (1 - t * t) if t * t < 1 else 1e-6
        left[i] = robust * (sharpness[i] / scale) ** 2
    return left


@inlined
def _fill_arms(turn: Floats, arm: Floats, arms: Floats) -> None:
    """Derivatives (3, 6) of a ball's centre in the camera frame by the pose.

    A turn about the body's origin moves it by its cross product with the arm.
    """
    for a in range(3):
        x, y, z = turn[a]
        arms[a, 0], arms[a, 1], arms[a, 2] = x, y, z
        arms[a, 3] = arm[1] * z - arm[2] * y
        arms[a, 4] = arm[2] * x - arm[0] * z
        arms[a, 5] = arm[0] * y - arm[1] * x


@inlined
def _by_pose(sums: Floats, arms: Floats, out: Floats) -> None:
    """Sums (7, 7) about a ball's centre as sums (10, 10) about the pose."""
    for i in range(6):
        x, y, z = arms[0, i], arms[1, i], arms[2, i]
        for j in range(_LOCAL):
            out[i, 3 + j] = x * sums[0, j] + y * sums[1, j] + z * sums[2, j]
        p, q, r = out[i, 3], out[i, 4], out[i, 5]
        for j in range(6):
            out[i, j] = p * arms[0, j] + q * arms[1, j] + r * arms[2, j]
        for j in range(6, COLUMNS):
            out[j, i] = out[i, j]
    for i in range(6, COLUMNS):
        for j in range(6, COLUMNS):
            out[i, j] = sums[i - 3, j - 3]
