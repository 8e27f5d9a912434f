"""Residuals and derivatives of outline points, summed over one ball in one camera, compiled.

The residual of an outline point with bearing v, about a ball seen axial the unit vector u with the
half angle a, is r = g (acos(v.u) - a), in px: g is the picture's scale axial the outline's normal.
A step dc of the ball's centre, at the distance D, changes it by -(g / D)(e - tan(a) u).dc, where e
is the unit vector perpendicular to u towards v.

No pixel changes when its bearing only grows. With J, the pixel's derivatives by v, a step axial e
therefore moves it by -J u / s, where s = |v x u|: that is the normal, and g = |J u| / s.

The weighted sums of products of those derivatives, the moments, are all that the fit needs of the
points, as long as its pose stays about where they were formed. See docs/explanation/joint_fit.md,
formulas 1 to 4.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined
from measure.geometry.covariance import MAD_TO_SD, TUKEY_SIGMAS
from measure.geometry.rotation_kernels import turned
from measure_plugins._joint_fit.problem import PackedOutlines

COLUMNS = 10
"""The pose's six, the view's offset, the outline's normal axial x and y, and the residual."""
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

    The loops are short, write one or two rows each and count unsigned: those the compiler turns
    into vector instructions.

    Args:
        outlines: k ball-views in c views.
        rotation: (3, 3) of world_from_body.
        translation: (3,) of world_from_body.
        offsets: (c,) outward edge offset of every view, px.
        effects: (k, 3) random effects of the ball-views, for the robust weights, px.
        moments: (k, 10, 10) filled.
    """
    count, arms, sums = len(outlines.view_of), np.empty((3, 6)), np.empty((_LOCAL, _LOCAL))
    body_arms, centers = np.empty((count, 3)), np.empty((count, 3))
    for k in range(count):
        _place(outlines, k, rotation, translation, body_arms[k], centers[k])
    columns = _columns(outlines, centers, offsets)
    buffer = np.empty(2 * columns.size)
    for k in range(count):
        weights = _weights(columns, outlines, k, effects[k])
        _fill_sums(columns, weights, outlines.start[k], buffer, sums)
        _fill_arms(outlines.rotations[outlines.view_of[k]], body_arms[k], arms)
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
def _columns(outlines: PackedOutlines, centers: Floats, offsets: Floats) -> Floats:
    """Derivatives of n points' residuals, and the residuals, (7, n).

    Rows: derivatives by the centre's x, y, z (camera frame, px/mm) and by the offset (1), the
    outline's unit normals in the picture, and the residuals in px, outward.
    """
    n = len(outlines.sharpness)
    out, axial, radial = np.empty((_LOCAL, n)), np.empty(n), np.empty(n)
    scale, slope = np.empty(n), np.empty(n)
    for k in range(len(centers)):
        _fill_axial(outlines, k, centers[k], axial, out)
    for i in range(n):
        radial[i] = np.sqrt((1 - axial[i]) * (1 + axial[i]))
        slope[i] = 1 / (radial[i] * np.sqrt(out[4, i] * out[4, i] + out[5, i] * out[5, i]))
    for i in range(n):
        scale[i] = slope[i] * (out[4, i] * out[4, i] + out[5, i] * out[5, i])
    for i in range(n):
        out[4, i] *= radial[i] * slope[i]
        out[5, i] *= radial[i] * slope[i]
    for i in range(n):
        slope[i] *= scale[i] * scale[i] * radial[i]
    for k in range(len(centers)):
        offset = offsets[outlines.view_of[k]]
        _fill_residuals(outlines, k, centers[k], offset, axial, radial, scale, slope, out)
    out[3] = 1.0
    return out


@inlined
def _points(outlines: PackedOutlines, k: int) -> tuple[np.uint64, np.uint64]:
    """The first of ball-view k's points and the one after its last."""
    return np.uint64(outlines.start[k]), np.uint64(outlines.start[k + 1])


@inlined
def _fill_axial(
    outlines: PackedOutlines, k: int, center: Floats, axial: Floats, out: Floats
) -> None:
    """Fill the cosines v.u between ball-view k's bearings and its line of sight, and -J u."""
    (first, last), rays = _points(outlines, k), outlines.rays
    x, y, z = center
    per_mm = 1 / np.sqrt(x * x + y * y + z * z)
    x, y, z = x * per_mm, y * per_mm, z * per_mm
    for i in range(first, last):
        axial[i] = x * rays[0, i] + y * rays[1, i] + z * rays[2, i]
    for i in range(first, last):
        out[4, i] = -(x * rays[3, i] + y * rays[4, i] + z * rays[5, i])
    for i in range(first, last):
        out[5, i] = -(x * rays[6, i] + y * rays[7, i] + z * rays[8, i])


@inlined
def _fill_residuals(
    outlines: PackedOutlines,
    k: int,
    center: Floats,
    offset: float,
    axial: Floats,
    radial: Floats,
    scale: Floats,
    slope: Floats,
    out: Floats,
) -> None:
    """Fill ball-view k's residuals, and their derivatives by its centre."""
    (first, last), rays = _points(outlines, k), outlines.rays
    x, y, z = center
    per_mm = 1 / np.sqrt(x * x + y * y + z * z)
    sine = outlines.radii[k] * per_mm
    cosine = np.sqrt(1 - sine * sine)
    tangent = sine / cosine
    x, y, z = x * per_mm, y * per_mm, z * per_mm
    for i in range(first, last):
        # The angle beyond the cone, by its sine; the next term is below 1e-9 rad at 10 px.
        beyond = radial[i] * cosine - axial[i] * sine
        out[6, i] = scale[i] * (beyond + beyond * beyond * beyond / 6) - offset
    for i in range(first, last):
        axial[i] += radial[i] * tangent
    for i in range(first, last):
        out[0, i] = per_mm * slope[i] * (rays[0, i] - axial[i] * x)
    for i in range(first, last):
        out[1, i] = per_mm * slope[i] * (rays[1, i] - axial[i] * y)
    for i in range(first, last):
        out[2, i] = per_mm * slope[i] * (rays[2, i] - axial[i] * z)


@inlined
def _weights(columns: Floats, outlines: PackedOutlines, k: int, effect: Floats) -> Floats:
    """Tukey's weights (n,) of ball-view k's points over their variances (formulas 8 and 9)."""
    first, n = np.uint64(outlines.start[k]), np.uint64(outlines.start[k + 1] - outlines.start[k])
    x, y, growth = effect
    out, size, sharpness = np.empty(n), np.empty(n), outlines.sharpness
    for i in range(n):
        left = (
            columns[6, first + i] - columns[4, first + i] * x - columns[5, first + i] * y - growth
        )
        out[i] = left * sharpness[first + i]
    for i in range(n):
        size[i] = abs(out[i])
    unit = 1 / max(MAD_TO_SD * np.median(size), 0.3)
    for i in range(n):
        t, sharp = out[i] * (unit / TUKEY_SIGMAS), sharpness[first + i] * unit
        robust = (1 - t * t) * (1 - t * t) if t * t < 1 else 1e-6
        out[i] = robust * sharp * sharp
    return out


@inlined
def _fill_sums(columns: Floats, weights: Floats, start: int, buffer: Floats, out: Floats) -> None:
    """Weighted sums of products of the columns of a ball-view's n points, (7, 7).

    Args:
        columns: (7, all points).
        weights: (n,).
        start: where the ball-view's points begin.
        buffer: (14 n,) scratch: a matrix product is quickest of contiguous rows.
        out: (7, 7) filled.
    """
    first, n, size = np.uint64(start), np.uint64(len(weights)), _LOCAL * len(weights)
    block = buffer[:size].reshape(_LOCAL, len(weights))
    weighted = buffer[size : 2 * size].reshape(_LOCAL, len(weights))
    for a in range(_LOCAL):
        for i in range(n):
            block[a, i] = columns[a, first + i]
        for i in range(n):
            weighted[a, i] = weights[i] * block[a, i]
    np.dot(weighted, block.T, out)


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
