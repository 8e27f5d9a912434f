"""Normal equations of the joint contour fit, one ball in one camera at a time, compiled.

The residual of an outline point with bearing v, about a ball seen along the unit vector u with the
half angle a, is r = g (acos(v.u) - a), in px: g is the picture's scale along the outline's normal.
A step dc of the ball's centre, at the distance D, changes it by -(g / D)(e - tan(a) u).dc, where e
is the unit vector perpendicular to u towards v.

Each ball-view has three nuisances of its own: its whole outline may sit off by (bx, by) in the
picture and be larger by br. They are random with the variances `scatter`, and are eliminated here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.rotation_kernels import rotation_of, times
from measure_plugins._edges.contours import Contours
from measure_plugins._edges.selection import median

OWN = 3
"""Number of a ball-view's own unknowns."""
_SHARED = 4
"""What a ball-view shares with others: its centre (in the camera frame) and its view's offset."""
_COLUMNS = 7
"""The shared four, the normal's x and y, and the residual; br goes as the view's offset does."""
_TUKEY = 4.685
_OWN_COLUMNS = (4, 5, 3)


class Terms(NamedTuple):
    """What k ball-views say about their shared unknowns, their own eliminated.

    Attributes:
        normal: (k, 4, 4) reduced normal matrices.
        right: (k, 4) reduced right sides.
        offset: (k, 3) the own unknowns are `offset - gain @ shared`.
        gain: (k, 3, 4).
        own_covariance: (k, 3, 3) of the own unknowns, given the shared ones.
        arms: (k, 3, 6) the centres' steps, in the camera frame, by the pose's.
    """

    normal: Floats
    right: Floats
    offset: Floats
    gain: Floats
    own_covariance: Floats
    arms: Floats


@compiled
def empty_terms(k: int) -> Terms:
    """Room for the terms of k ball-views."""
    return Terms(
        np.zeros((k, _SHARED, _SHARED)),
        np.zeros((k, _SHARED)),
        np.zeros((k, OWN)),
        np.zeros((k, OWN, _SHARED)),
        np.zeros((k, OWN, OWN)),
        np.zeros((k, 3, 6)),
    )


@compiled
def collect(
    contours: Contours,
    rotation: Floats,
    translation: Floats,
    offsets: Floats,
    shifts: Floats,
    variances: Floats,
    terms: Terms,
) -> None:
    """Fill the terms of all ball-views.

    Args:
        contours: k ball-views in c views.
        rotation: (3, 3) of world_from_body.
        translation: (3,) of world_from_body.
        offsets: (c,) outward edge offset of every view, px.
        shifts: (k, 3) of the ball-views, for the robust weights, px.
        variances: (k, 3) of those, px^2.
        terms: filled.
    """
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
        terms.arms[k, :, :3] = turn
        for a in range(3):
            # A turn about the body's origin moves the centre by its cross product with the arm.
            x, y, z = turn[a]
            terms.arms[k, a, 3] = arm[1] * z - arm[2] * y
            terms.arms[k, a, 4] = arm[2] * x - arm[0] * z
            terms.arms[k, a, 5] = arm[0] * y - arm[1] * x
        columns = _columns(center, contours.radii[k], contours, first, last)
        columns[6] -= offsets[contours.view_of[k]]
        weights = _weights(columns, shifts[k], contours.sd_px[first:last])
        _eliminate(_moments(columns, weights), variances[k], k, terms)


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
    out, per_mm = np.ones((_COLUMNS, last - first)), 1 / distance
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
def _moments(columns: Floats, weights: Floats) -> Floats:
    """Weighted sums of products of the columns, (7, 7).

    All sums grow together, point by point: none has to wait for its own last addition.
    """
    out = np.zeros((_COLUMNS, _COLUMNS))
    for i in range(len(weights)):
        for a in range(_COLUMNS):
            weighted = weights[i] * columns[a, i]
            for b in range(a + 1):
                out[a, b] += weighted * columns[b, i]
    for a in range(_COLUMNS):
        for b in range(a):
            out[b, a] = out[a, b]
    return out


@compiled
def _eliminate(moments: Floats, variances: Floats, k: int, terms: Terms) -> None:
    """Ball-view k's terms from its moments; not a number where a step led inside the ball."""
    own, inverse = np.empty((OWN, OWN)), np.empty((OWN, OWN))
    for a in range(OWN):
        for b in range(OWN):
            own[a, b] = moments[_OWN_COLUMNS[a], _OWN_COLUMNS[b]]
        own[a, a] += 1 / variances[a]
    _invert(own, inverse)
    p, q, r = _OWN_COLUMNS
    gain, offset = np.empty((OWN, _SHARED)), np.empty(OWN)
    for a in range(OWN):
        x, y, z = inverse[a, 0], inverse[a, 1], inverse[a, 2]
        offset[a] = x * moments[p, 6] + y * moments[q, 6] + z * moments[r, 6]
        for j in range(_SHARED):
            gain[a, j] = x * moments[p, j] + y * moments[q, j] + z * moments[r, j]
    for i in range(_SHARED):
        x, y, z = moments[p, i], moments[q, i], moments[r, i]
        terms.right[k, i] = moments[i, 6] - (x * offset[0] + y * offset[1] + z * offset[2])
        for j in range(_SHARED):
            taken = x * gain[0, j] + y * gain[1, j] + z * gain[2, j]
            terms.normal[k, i, j] = moments[i, j] - taken
    terms.own_covariance[k], terms.gain[k], terms.offset[k] = inverse, gain, offset


@compiled
def _invert(m: Floats, out: Floats) -> None:
    """The inverse of a matrix (3, 3) by its cofactors, into `out`."""
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            out[j, i] = m[a, c] * m[b, d] - m[a, d] * m[b, c]
    determinant = m[0, 0] * out[0, 0] + m[0, 1] * out[1, 0] + m[0, 2] * out[2, 0]
    for i in range(3):
        for j in range(3):
            out[i, j] /= determinant
