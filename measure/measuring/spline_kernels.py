"""Cubic splines through a handful of poses, compiled: see `pose_spline`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.rotation_kernels import rotvec_of

_PLAIN_KNOTS = 5


class Spline(NamedTuple):
    """A curve through n poses, in the chart of one of them, and what it says at that one.

    Attributes:
        places: (n, 6) of the poses.
        slopes: (n, 6) of the curve at each, per second.
        slope_covariance: (6, 6) at its own pose, from the poses' and from where plainer curves go.
        bend: (6,) the second derivative there, per s^2.
        own_bend: the same where the own knot is one off, and no other.
    """

    places: Floats
    slopes: Floats
    slope_covariance: Floats
    bend: Floats
    own_bend: float


@compiled
def spline_through(
    times_s: Floats, rotations: Floats, translations: Floats, covariances: Floats, own: int
) -> Spline:
    """The spline through n >= 2 poses.

    Args:
        times_s: (n,) rising, after the own pose's.
        rotations: (n, 3, 3) of world_from_body.
        translations: (n, 3) the same.
        covariances: (n, 6, 6) of the poses.
        own: which of them is asked about.
    """
    n = len(times_s)
    # With the places goes what the own knot alone does to the curve.
    curves = np.zeros((n, 7))
    curves[own, 6] = 1.0
    for k in range(n):
        curves[k, :3] = translations[k] - translations[own]
        curves[k, 3:6] = rotvec_of(rotations[k] @ rotations[own].T)
    weights = slope_weights(times_s)
    slopes, bend = weights @ curves, np.empty(7)
    places, noise = curves[:, :6].copy(), np.zeros((6, 6))
    for k in range(n):
        noise += weights[own, k] ** 2 * covariances[k]
    # Where a plainer curve through the nearest poses goes another way, neither is to be trusted.
    astray = (weights[own] - plainer_weights(times_s, own)) @ places
    noise += np.outer(astray, astray)
    k = min(own, n - 2)
    for a in range(7):
        square, cubic = _bends(times_s, curves[:, a], slopes[:, a], k)
        bend[a] = 2 * square + 6 * cubic * (times_s[own] - times_s[k])
    return Spline(places, slopes[:, :6].copy(), noise, bend[:6], bend[6])


@compiled
def slope_weights(times_s: Floats) -> Floats:
    """How much each knot counts in the slope at each: (n, n), not-a-knot at both ends.

    Three knots lie on one parabola, two on a line.
    """
    n, width = len(times_s), np.diff(times_s)
    out = np.empty((n, n))
    rise = np.zeros((n - 1, n))
    for k in range(n - 1):
        rise[k, k], rise[k, k + 1] = -1 / width[k], 1 / width[k]
    if n == 2:
        out[:] = rise[0]
        return out
    system, right = np.zeros((n, n)), np.empty((n, n))
    for k in range(1, n - 1):
        system[k, k - 1], system[k, k + 1] = width[k], width[k - 1]
        system[k, k] = 2 * (width[k - 1] + width[k])
        right[k] = 3 * (width[k] * rise[k - 1] + width[k - 1] * rise[k])
    if n == 3:
        system[0, :2], system[2, 1:] = 1.0, 1.0
        right[0], right[2] = 2 * rise[0], 2 * rise[1]
    else:
        _fill_end(width, rise, system[0], right[0])
        _fill_end(width[::-1], rise[::-1], system[n - 1, ::-1], right[n - 1])
    out[:] = np.linalg.solve(system, right)
    return out


@compiled
def _fill_end(width: Floats, rise: Floats, system: Floats, right: Floats) -> None:
    """The first knot's equation: the curve's third derivative does not change at the next one."""
    both = width[0] + width[1]
    system[0], system[1] = width[1], both
    right[:] = (width[0] + 2 * both) * width[1] * rise[0] + width[0] ** 2 * rise[1]
    right /= both


@compiled
def plainer_weights(times_s: Floats, own: int) -> Floats:
    """Weights (n,) of the knots in the slope at one: a polynomial through some of the nearest."""
    away = times_s - times_s[own]
    near = np.argsort(np.abs(away), kind="mergesort")[: min(_PLAIN_KNOTS, len(away) - 1)]
    out = np.zeros(len(away))
    for j in near:
        if j == own:
            continue
        out[j] = 1 / away[j]
        for m in near:
            if m not in (own, j):
                out[j] *= away[m] / (away[m] - away[j])
    out[own] = -np.sum(out)
    return out


@compiled
def along(knots_s: Floats, places: Floats, slopes: Floats, times_s: Floats) -> Floats:
    """Points (m, 6) at other times of the curve with these places and slopes (n, 6) at its knots.

    Beyond the knots its first and last piece go on.
    """
    out = np.empty((len(times_s), 6))
    for i in range(len(times_s)):
        k = 0
        while k + 2 < len(knots_s) and times_s[i] >= knots_s[k + 1]:
            k += 1
        t = times_s[i] - knots_s[k]
        for a in range(6):
            square, cubic = _bends(knots_s, places[:, a], slopes[:, a], k)
            out[i, a] = places[k, a] + t * (slopes[k, a] + t * (square + t * cubic))
    return out


@compiled
def _bends(knots_s: Floats, places: Floats, slopes: Floats, k: int) -> tuple[float, float]:
    """The square and the cubic coefficient of one coordinate's piece from knot k on."""
    width = knots_s[k + 1] - knots_s[k]
    rise = (places[k + 1] - places[k]) / width
    cubic = (slopes[k] + slopes[k + 1] - 2 * rise) / width
    return (rise - slopes[k]) / width - cubic, cubic / width
