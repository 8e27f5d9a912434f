"""Normal equations of the joint contour fit, one ball in one camera at a time, compiled.

The residual of an outline point with bearing v, about a ball seen along the unit vector u with the
half angle a, is r = g (acos(v.u) - a), in px: g is the picture's scale along the outline's normal.
A step dc of the ball's centre, at the distance D, changes it by -(g / D)(e - tan(a) u).dc, where e
is the unit vector perpendicular to u towards v.

Each ball-view has three nuisances of its own: its whole outline may sit off by (bx, by) in the
picture and be larger by br. They are random with the variances `scatter`, and are eliminated here.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints
from measure_plugins._edges.jit import compiled
from measure_plugins._edges.lens import to_bearing, to_pixel

_TILT = 1e-5


@compiled
def bearings_of(points: Floats, lens: Floats, lens_of: Ints) -> Floats:
    """Unit bearings (n, 3) of pixels (n, 2), each through its own row of `lens` (c, 13)."""
    out = np.empty((len(points), 3))
    for i in range(len(points)):
        x, y, z = to_bearing(points[i, 0], points[i, 1], lens[lens_of[i]])
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
    return out


@compiled
def point_rows(
    center: Floats,
    radius: float,
    bearings: Floats,
    lens: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Residuals and their derivatives for one ball-view.

    Args:
        center: (3,) of the ball in the camera frame, mm.
        radius: mm.
        bearings: (n, 3) unit.
        lens: (13,) lens row.

    Returns:
        Residuals (n,) px, outward; the outline's shift by the centre (n, 3) px/mm in the camera
        frame; the outline's unit normals in the picture (n, 2).
    """
    n = len(bearings)
    distance = np.sqrt(np.sum(center * center))
    u = center / distance
    sine = radius / distance
    half_angle = np.arcsin(sine)
    tangent = sine / np.sqrt(1 - sine * sine)
    residuals, by_center, normals = np.empty(n), np.empty((n, 3)), np.empty((n, 2))
    for i in range(n):
        v = bearings[i]
        cosine = np.sum(v * u)
        side = v - cosine * u
        length = np.sqrt(np.sum(side * side))
        e = side / length
        outward = cosine * e - length * u
        x0, y0 = to_pixel(v[0], v[1], v[2], lens)
        w = v + _TILT * outward
        x1, y1 = to_pixel(w[0], w[1], w[2], lens)
        px = np.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2)
        scale = px / _TILT
        normals[i, 0], normals[i, 1] = (x1 - x0) / px, (y1 - y0) / px
        residuals[i] = scale * (np.arctan2(length, cosine) - half_angle)
        by_center[i] = scale / distance * (e - tangent * u)
    return residuals, by_center, normals


@compiled
def eliminate(
    residuals: Floats,
    rows: Floats,
    nuisances: Floats,
    weights: Floats,
    scatter: Floats,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Normal equations of one ball-view with its own nuisances eliminated.

    Args:
        residuals: (n,).
        rows: (n, k) derivatives of the outline by the shared unknowns.
        nuisances: (n, 3) derivatives by the ball-view's own.
        weights: (n,) inverse variances.
        scatter: (3,) variances of the ball-view's own unknowns.

    Returns:
        Reduced normal matrix (k, k), right side (k,); and to recover the nuisances from the shared
        unknowns x: b = offset - gain @ x, as offset (3,) and gain (3, k).
    """
    k = rows.shape[1]
    weighted = rows * weights.reshape(-1, 1)
    normal = weighted.T @ rows
    right = weighted.T @ residuals
    cross = nuisances.T @ weighted
    own = nuisances.T @ (nuisances * weights.reshape(-1, 1))
    own_right = nuisances.T @ (weights * residuals)
    for j in range(3):
        own[j, j] += 1.0 / scatter[j]
    inverse = np.linalg.inv(own)
    gain = inverse @ cross
    offset = inverse @ own_right
    return normal - cross.T @ gain, right - cross.T @ offset, offset, gain.reshape(3, k)
