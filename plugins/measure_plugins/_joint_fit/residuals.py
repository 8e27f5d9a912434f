"""What outline points say about the pose, summed up one ball in one camera at a time, compiled.

The residual of an outline point with bearing v, about a ball seen along the unit vector u with the
half angle a, is r = g (acos(v.u) - a), in px: g is the picture's scale along the outline's normal.
A step dc of the ball's centre, at the distance D, changes it by -(g / D)(e - tan(a) u).dc, where e
is the unit vector perpendicular to u towards v.

No pixel changes when its bearing only grows. With J, the pixel's derivatives by v, a step along e
therefore moves it by -J u / s, where s = |v x u|: that is the normal, and g = |J u| / s.

Sums of products of those slopes are all that a fit needs to know of the points, as long as its pose
stays about where they were formed.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined
from measure.geometry.rotation_kernels import turned
from measure_plugins._joint_fit.problem import Contours
from measure_plugins._kernels.selection import median

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

    The parts are made of many short loops that each write a row or two, and count unsigned: those
    the compiler turns into vectors.

    Args:
        contours: k ball-views in c views.
        rotation: (3, 3) of world_from_body.
        translation: (3,) of world_from_body.
        offsets: (c,) outward edge offset of every view, px.
        shifts: (k, 3) of the ball-views (x, y and radius), for the robust weights, px.
        moments: (k, 10, 10) filled.
    """
    count, arms, sums = len(contours.view_of), np.empty((3, 6)), np.empty((_SEEN, _SEEN))
    own_arms, centers = np.empty((count, 3)), np.empty((count, 3))
    for k in range(count):
        _place(contours, k, rotation, translation, own_arms[k], centers[k])
    columns = _columns(contours, centers, offsets)
    room = np.empty(2 * columns.size)
    for k in range(count):
        weights = _weights(columns, contours, k, shifts[k])
        _fill_sums(columns, weights, contours.start[k], room, sums)
        _fill_arms(contours.rotations[contours.view_of[k]], own_arms[k], arms)
        _by_pose(sums, arms, moments[k])


@inlined
def _place(
    contours: Contours, k: int, rotation: Floats, translation: Floats, arm: Floats, center: Floats
) -> None:
    """Fill where ball-view k's ball is: from the body's origin, and in the camera frame."""
    body, moved, view = contours.centers_body[k], contours.motion[k], contours.view_of[k]
    for a in range(3):
        arm[a] = rotation[a, 0] * body[0] + rotation[a, 1] * body[1] + rotation[a, 2] * body[2]
    place, inward = turned(moved[3], moved[4], moved[5], arm), contours.rotations[view]
    x = place[0] + translation[0] + moved[0]
    y = place[1] + translation[1] + moved[1]
    z = place[2] + translation[2] + moved[2]
    for a in range(3):
        center[a] = inward[a, 0] * x + inward[a, 1] * y + inward[a, 2] * z
        center[a] += contours.translations[view, a]


@inlined
def _columns(contours: Contours, centers: Floats, offsets: Floats) -> Floats:
    """What n points say of what they depend on, and their residuals, (7, n).

    Rows: derivatives by the centre's x, y, z (camera frame, px/mm) and by the offset (1), the
    outline's unit normals in the picture, and the residuals in px, outward.
    """
    n = len(contours.sharpness)
    out, along, aside = np.empty((_SEEN, n)), np.empty(n), np.empty(n)
    scale, slope = np.empty(n), np.empty(n)
    for k in range(len(centers)):
        _face(contours, k, centers[k], along, out)
    for i in range(n):
        aside[i] = np.sqrt((1 - along[i]) * (1 + along[i]))
        slope[i] = 1 / (aside[i] * np.sqrt(out[4, i] * out[4, i] + out[5, i] * out[5, i]))
    for i in range(n):
        scale[i] = slope[i] * (out[4, i] * out[4, i] + out[5, i] * out[5, i])
    for i in range(n):
        out[4, i] *= aside[i] * slope[i]
        out[5, i] *= aside[i] * slope[i]
    for i in range(n):
        slope[i] *= scale[i] * scale[i] * aside[i]
    for k in range(len(centers)):
        offset = offsets[contours.view_of[k]]
        _derive(contours, k, centers[k], offset, along, aside, scale, slope, out)
    out[3] = 1.0
    return out


@inlined
def _points(contours: Contours, k: int) -> tuple[np.uint64, np.uint64]:
    """The first of ball-view k's points and the one after its last."""
    return np.uint64(contours.start[k]), np.uint64(contours.start[k + 1])


@inlined
def _face(contours: Contours, k: int, center: Floats, along: Floats, out: Floats) -> None:
    """Fill the cosines between ball-view k's bearings and its line of sight, and -J u."""
    (first, last), rays = _points(contours, k), contours.rays
    x, y, z = center
    per_mm = 1 / np.sqrt(x * x + y * y + z * z)
    x, y, z = x * per_mm, y * per_mm, z * per_mm
    for i in range(first, last):
        along[i] = x * rays[0, i] + y * rays[1, i] + z * rays[2, i]
    for i in range(first, last):
        out[4, i] = -(x * rays[3, i] + y * rays[4, i] + z * rays[5, i])
    for i in range(first, last):
        out[5, i] = -(x * rays[6, i] + y * rays[7, i] + z * rays[8, i])


@inlined
def _derive(
    contours: Contours,
    k: int,
    center: Floats,
    offset: float,
    along: Floats,
    aside: Floats,
    scale: Floats,
    slope: Floats,
    out: Floats,
) -> None:
    """Fill ball-view k's residuals, and their derivatives by its centre."""
    (first, last), rays = _points(contours, k), contours.rays
    x, y, z = center
    per_mm = 1 / np.sqrt(x * x + y * y + z * z)
    sine = contours.radii[k] * per_mm
    cosine = np.sqrt(1 - sine * sine)
    tangent = sine / cosine
    x, y, z = x * per_mm, y * per_mm, z * per_mm
    for i in range(first, last):
        # The angle beyond the cone, by its sine; the next term is below 1e-9 rad at 10 px.
        beyond = aside[i] * cosine - along[i] * sine
        out[6, i] = scale[i] * (beyond + beyond * beyond * beyond / 6) - offset
    for i in range(first, last):
        along[i] += aside[i] * tangent
    for i in range(first, last):
        out[0, i] = per_mm * slope[i] * (rays[0, i] - along[i] * x)
    for i in range(first, last):
        out[1, i] = per_mm * slope[i] * (rays[1, i] - along[i] * y)
    for i in range(first, last):
        out[2, i] = per_mm * slope[i] * (rays[2, i] - along[i] * z)


@inlined
def _weights(columns: Floats, contours: Contours, k: int, shift: Floats) -> Floats:
    """Tukey's weights (n,) of ball-view k's points over their variances, px^-2."""
    first, n = np.uint64(contours.start[k]), np.uint64(contours.start[k + 1] - contours.start[k])
    x, y, grown = shift
    out, size, sharpness = np.empty(n), np.empty(n), contours.sharpness
    for i in range(n):
        left = columns[6, first + i] - columns[4, first + i] * x - columns[5, first + i] * y - grown
        out[i] = left * sharpness[first + i]
    for i in range(n):
        size[i] = abs(out[i])
    unit = 1 / max(1.4826 * median(size, len(size)), 0.3)
    for i in range(n):
        t, sharp = out[i] * (unit / _TUKEY), sharpness[first + i] * unit
        robust = (1 - t * t) * (1 - t * t) if t * t < 1 else 1e-6
        out[i] = robust * sharp * sharp
    return out


@inlined
def _fill_sums(columns: Floats, weights: Floats, start: int, room: Floats, out: Floats) -> None:
    """Weighted sums of products of the columns of a ball-view's n points, (7, 7).

    Args:
        columns: (7, all points).
        weights: (n,).
        start: where the ball-view's points begin.
        room: for 14 n numbers: a matrix product is quickest of rows that follow each other.
        out: (7, 7) filled.
    """
    first, n, size = np.uint64(start), np.uint64(len(weights)), _SEEN * len(weights)
    own = room[:size].reshape(_SEEN, len(weights))
    weighted = room[size : 2 * size].reshape(_SEEN, len(weights))
    for a in range(_SEEN):
        for i in range(n):
            own[a, i] = columns[a, first + i]
        for i in range(n):
            weighted[a, i] = weights[i] * own[a, i]
    np.dot(weighted, own.T, out)


@inlined
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


@inlined
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
