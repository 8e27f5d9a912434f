"""What outline points say about the pose, summed up one ball in one camera at a time, compiled.

The residual of an outline point with bearing v, about a ball seen along the unit vector u with the
half angle a, is r = g (acos(v.u) - a), in px: g is the picture's scale along the outline's normal.
A step dc of the ball's centre, at the distance D, changes it by -(g / D)(e - tan(a) u).dc, where e
is the unit vector perpendicular to u towards v.

Sums of products of those slopes are all that a fit needs to know of the points, as long as its pose
stays about where they were formed.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.rotation_kernels import rotation_of, times
from measure_plugins._edges.contours import Contours
from measure_plugins._edges.selection import median

COLUMNS = 10
"""The pose's six, the view's offset, the outline's normal along x and y, and the residual."""
_SEEN = 7
"""The same with the ball's centre (in the camera frame) for the pose."""
_TUKEY = 4.685


@compiled
def collect(
    contours: Contours,
    rotation: Floats,
    translation: Floats,
    offsets: Floats,
    shifts: Floats,
    moments: Floats,
) -> None:
    """Fill the sums of all ball-views.

    Args:
        contours: k ball-views in c views.
        rotation: (3, 3) of world_from_body.
        translation: (3,) of world_from_body.
        offsets: (c,) outward edge offset of every view, px.
        shifts: (k, 3) of the ball-views (x, y and radius), for the robust weights, px.
        moments: (k, 10, 10) filled.
    """
    sums, arms = np.empty((_SEEN, _SEEN)), np.empty((3, 6))
    for k in range(len(contours.view_of)):
        first, last = contours.start[k], contours.start[k + 1]
        turn, here = contours.rotations[contours.view_of[k]], contours.motion[k]
        arm = times(rotation, contours.centers_body[k])
        place = translation + arm
        if here[3] != 0 or here[4] != 0 or here[5] != 0:
            place += here[:3] + (times(rotation_of(here[3:]), arm) - arm)
        else:
            place += here[:3]
        center = times(turn, place)
        center += contours.translations[contours.view_of[k]]
        columns = _columns(center, contours.radii[k], contours, first, last)
        columns[6] -= offsets[contours.view_of[k]]
        weights = _weights(columns, shifts[k], contours.sd_px[first:last])
        _fill_sums(columns, weights, sums)
        _fill_arms(turn, arm, arms)
        _by_pose(sums, arms, moments[k])


@compiled
def _fill_arms(turn: Floats, arm: Floats, arms: Floats) -> None:
    """How a ball's centre in the camera frame moves with the pose: (3, 6).

    A turn about the body's origin moves it by its cross product with the arm.
    """
    for a in range(3):
        x, y, z = turn[a]
        arms[a, 0], arms[a, 1], arms[a, 2] = x, y, z
        arms[a, 3] = arm[1] * z - arm[2] * y
        arms[a, 4] = arm[2] * x - arm[0] * z
        arms[a, 5] = arm[0] * y - arm[1] * x


@compiled
def _by_pose(sums: Floats, arms: Floats, out: Floats) -> None:
    """Sums (7, 7) about a ball's centre as sums (10, 10) about the pose."""
    for i in range(6):
        x, y, z = arms[0, i], arms[1, i], arms[2, i]
        for j in range(_SEEN):
            out[i, 3 + j] = x * sums[0, j] + y * sums[1, j] + z * sums[2, j]
        p, q, r = out[i, 3], out[i, 4], out[i, 5]
        for j in range(6):
            out[i, j] = p * arms[0, j] + q * arms[1, j] + r * arms[2, j]
        for j in range(6, COLUMNS):
            out[j, i] = out[i, j]
    for i in range(6, COLUMNS):
        for j in range(6, COLUMNS):
            out[i, j] = sums[i - 3, j - 3]


@compiled
def _columns(center: Floats, radius: float, contours: Contours, first: int, last: int) -> Floats:
    """Derivatives of a ball-view's outline by what it depends on, and its residuals, (7, n).

    Rows: by the centre's x, y, z (camera frame, px/mm), by the offset (1), the outline's unit
    normals in the picture, and the residuals in px, outward.
    """
    distance = np.sqrt(np.sum(center * center))
    ux, uy, uz = center[0] / distance, center[1] / distance, center[2] / distance
    sine = radius / distance
    cosine = np.sqrt(1 - sine * sine)
    tangent = sine / cosine
    out, per_mm = np.ones((_SEEN, last - first)), 1 / distance
    bearings, slopes = contours.bearings[:, first:last], contours.slopes[:, first:last]
    for i in range(last - first):
        x, y, z = bearings[0, i], bearings[1, i], bearings[2, i]
        along = x * ux + y * uy + z * uz
        ex, ey, ez = x - along * ux, y - along * uy, z - along * uz
        aside = np.sqrt(ex * ex + ey * ey + ez * ez)
        unit = 1 / aside  # divisions are what this loop waits for
        ex, ey, ez = unit * ex, unit * ey, unit * ez
        ox, oy, oz = along * ex - aside * ux, along * ey - aside * uy, along * ez - aside * uz
        du = slopes[0, i] * ox + slopes[1, i] * oy + slopes[2, i] * oz
        dv = slopes[3, i] * ox + slopes[4, i] * oy + slopes[5, i] * oz
        scale = np.sqrt(du * du + dv * dv)
        per, unit = scale * per_mm, 1 / scale
        out[0, i] = per * (ex - tangent * ux)
        out[1, i] = per * (ey - tangent * uy)
        out[2, i] = per * (ez - tangent * uz)
        out[4, i], out[5, i] = unit * du, unit * dv
        # The angle beyond the cone, by its sine; the next term is below 1e-9 rad at 10 px.
        beyond = aside * cosine - along * sine
        out[6, i] = scale * (beyond + beyond * beyond * beyond / 6)
    return out


@compiled
def _weights(columns: Floats, shift: Floats, sd: Floats) -> Floats:
    """Tukey's weights (n,) of one ball-view's points over their variances, in px^-2."""
    n = len(sd)
    standard, sizes = np.empty(n), np.empty(n)
    for i in range(n):
        left = columns[6, i] - columns[4, i] * shift[0] - columns[5, i] * shift[1] - shift[2]
        standard[i] = left / sd[i]
        sizes[i] = abs(standard[i])
    scale = max(1.4826 * median(sizes, n), 0.3)
    for i in range(n):
        t = standard[i] / (_TUKEY * scale)
        robust = (1 - t * t) ** 2 if abs(t) < 1 else 1e-6
        standard[i] = robust / (sd[i] * scale) ** 2
    return standard


@compiled
def _fill_sums(columns: Floats, weights: Floats, out: Floats) -> None:
    """Weighted sums of products of the columns, (7, 7).

    All sums grow together, point by point: none has to wait for its own last addition.
    """
    out[:] = 0.0
    for i in range(len(weights)):
        for a in range(_SEEN):
            weighted = weights[i] * columns[a, i]
            for b in range(a + 1):
                out[a, b] += weighted * columns[b, i]
    for a in range(_SEEN):
        for b in range(a):
            out[b, a] = out[a, b]
