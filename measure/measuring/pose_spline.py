"""The body's motion at a pose by a cubic spline through the poses before and after it.

The slopes of a cubic spline are the compact differences of Lele (1992, J. Comput. Phys. 103,
section 2): with ten images per period of a shaking body their error is 0.1 %, that of a central
difference 7 %. The spline interpolates the poses' coordinates in the chart of the pose at which it
is evaluated, where the chart is exact.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, stacked
from measure.compiling import compiled
from measure.geometry import RigidTransform
from measure.geometry.rotation_kernels import rotvec_of
from measure.measuring.measurement import Draft, Measurement, Status
from measure.model import Motion, Pose

REACH = 3
"""Poses on either side: the fourth would change a slope by 2 % of its own noise."""
_MAX_PAUSE_S = 0.5  # Longest time between two poses of one spline
_POLYNOMIAL_KNOTS = 5  # Nearest knots of the polynomial whose slope is compared with the spline's


@dataclass(frozen=True, eq=False)
class SplineMotion(Motion):
    """The motion around one knot of a spline through poses."""

    knots_s: Floats = field(kw_only=True)  # (n,) times of the knots after the pose's
    spline: Spline = field(kw_only=True)  # the pose's chart by that time

    @property
    def acceleration(self) -> Floats:
        """(6,) at the pose, mm/s^2 and rad/s^2."""
        return self.spline.acceleration

    def moved(self, time_s: ArrayLike) -> Floats:
        """How far (..., 6) the body has moved at other times (...), in the chart of the pose."""
        lead_s = np.asarray(time_s, dtype=np.float64) - self.time_s
        path = evaluated(self.knots_s, self.spline.places, self.spline.slopes, lead_s.reshape(-1))
        return path.reshape(*lead_s.shape, 6)

    def error_growth(self, times_s: Collection[float]) -> float:
        """Factor on an error of the pose after solving it again with images of these times.

        An error of the pose curves the spline, which then moves the detections the same way.
        """
        mean_s = sum(times_s) / len(times_s)
        variance = sum((time_s - mean_s) ** 2 for time_s in times_s) / len(times_s)
        return 1.0 + abs(self.spline.own_acceleration) / 2 * variance


def motion_at(pose: Pose, before: Sequence[Pose], after: Sequence[Pose]) -> SplineMotion | None:
    """The motion at `pose` by the spline through it and the poses around it; None if it is alone.

    Args:
        pose: where the motion is wanted.
        before: earlier poses, in order of time.
        after: later poses, in order of time.
    """
    knots, own = [*before, pose, *after], len(before)
    if len(knots) < 2:
        return None
    knots_s = np.array([knot.time_s - pose.time_s for knot in knots])
    spline = spline_through(
        knots_s,
        stacked([knot.world_from_body.rotation for knot in knots]),
        stacked([knot.world_from_body.translation for knot in knots]),
        stacked([knot.covariance for knot in knots]),
        own,
    )
    return SplineMotion(
        pose.world_from_body,
        pose.time_s,
        spline.slopes[own],
        velocity_covariance=spline.slope_covariance,
        knots_s=knots_s,
        spline=spline,
    )


def with_surrounding_poses(
    drafts: Iterable[Draft],
) -> Iterator[tuple[list[Pose], Draft, list[Pose]]]:
    """Every draft with up to `REACH` accepted poses before and after it, in order."""
    held: deque[Draft] = deque()
    at = 0
    for draft in drafts:
        held.append(draft)
        if len(held) > at + REACH:
            yield _surrounding_poses(held, at)
            at = min(at + 1, REACH)
            if len(held) > 2 * REACH:
                held.popleft()
    for rest in range(at, len(held)):
        yield _surrounding_poses(held, rest)


def _surrounding_poses(held: Sequence[Draft], at: int) -> tuple[list[Pose], Draft, list[Pose]]:
    """The accepted poses around one of `held`, without a long pause; None for one instant."""
    seen = held[at].seen
    if seen is not None and seen.simultaneous:
        return [], held[at], []
    measured = [draft.measurement for draft in held]
    time_s = measured[at].time_s
    before = _without_pause(time_s, measured[max(at - REACH, 0) : at][::-1])
    after = _without_pause(time_s, measured[at + 1 : at + 1 + REACH])
    return before[::-1], held[at], after


def _without_pause(time_s: float, others: Sequence[Measurement]) -> list[Pose]:
    """The accepted poses of `others`, nearest first, up to a pause longer than allowed."""
    found: list[Pose] = []
    for other in others:
        if other.pose is None or other.status is not Status.OK:
            continue
        if not 0 < abs(other.time_s - time_s) <= _MAX_PAUSE_S:
            break
        found.append(other.pose)
        time_s = other.time_s
    return found


def warm_up() -> None:
    """Compile or load the loops of a spline through two poses in one place."""
    still = RigidTransform.identity()
    one, two = (Pose(time_s, still, np.eye(6), 0.0, 0.0, (), ()) for time_s in (0.0, 1.0))
    motion = motion_at(one, [], [two])
    assert motion is not None
    motion.moved(0.5)


class Spline(NamedTuple):
    """A cubic spline through n poses in the chart of one of them, and its derivatives there."""

    places: Floats  # (n, 6) of the poses
    slopes: Floats  # (n, 6) of the curve at each, per second
    # (6, 6) at the own pose, from the poses' covariances and from the difference to the slope of a
    # polynomial through the nearest poses.
    slope_covariance: Floats
    acceleration: Floats  # (6,) second derivative there, per s^2
    own_acceleration: float  # its derivative by the own pose's coordinate, per s^2


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
        own: index of the pose in whose chart the spline lies.
    """
    n = len(times_s)
    # The seventh curve is the response to a unit displacement of the own knot.
    curves = np.zeros((n, 7))
    curves[own, 6] = 1.0
    for k in range(n):
        curves[k, :3] = translations[k] - translations[own]
        curves[k, 3:6] = rotvec_of(rotations[k] @ rotations[own].T)
    weights = slope_weights(times_s)
    slopes, acceleration = weights @ curves, np.empty(7)
    places, noise = curves[:, :6].copy(), np.zeros((6, 6))
    for k in range(n):
        noise += weights[own, k] ** 2 * covariances[k]
    # The difference of the two slopes bounds the error of interpolation.
    difference = (weights[own] - polynomial_weights(times_s, own)) @ places
    noise += np.outer(difference, difference)
    k = min(own, n - 2)
    for a in range(7):
        square, cubic = _piece(times_s, curves[:, a], slopes[:, a], k)
        acceleration[a] = 2 * square + 6 * cubic * (times_s[own] - times_s[k])
    return Spline(places, slopes[:, :6].copy(), noise, acceleration[:6], acceleration[6])


@compiled
def slope_weights(times_s: Floats) -> Floats:
    """Weights (n, n) of the knots in the slope at each knot; not-a-knot at both ends.

    Three knots give one parabola, two a line.
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
    """The first knot's equation: the third derivative is continuous at the second knot."""
    both = width[0] + width[1]
    system[0], system[1] = width[1], both
    right[:] = (width[0] + 2 * both) * width[1] * rise[0] + width[0] ** 2 * rise[1]
    right /= both


@compiled
def polynomial_weights(times_s: Floats, own: int) -> Floats:
    """Weights (n,) of the knots in the slope at one, by a polynomial through the nearest."""
    away = times_s - times_s[own]
    near = np.argsort(np.abs(away), kind="mergesort")[: min(_POLYNOMIAL_KNOTS, len(away) - 1)]
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
def evaluated(knots_s: Floats, places: Floats, slopes: Floats, times_s: Floats) -> Floats:
    """Points (m, 6) at other times of the curve with places and slopes (n, 6) at its knots.

    Beyond the knots its first and last piece are extrapolated.
    """
    out = np.empty((len(times_s), 6))
    for i in range(len(times_s)):
        k = 0
        while k + 2 < len(knots_s) and times_s[i] >= knots_s[k + 1]:
            k += 1
        t = times_s[i] - knots_s[k]
        for a in range(6):
            square, cubic = _piece(knots_s, places[:, a], slopes[:, a], k)
            out[i, a] = places[k, a] + t * (slopes[k, a] + t * (square + t * cubic))
    return out


@compiled
def _piece(knots_s: Floats, places: Floats, slopes: Floats, k: int) -> tuple[float, float]:
    """The quadratic and cubic coefficients of one coordinate's piece from knot k on."""
    width = knots_s[k + 1] - knots_s[k]
    rise = (places[k + 1] - places[k]) / width
    cubic = (slopes[k] + slopes[k + 1] - 2 * rise) / width
    return (rise - slopes[k]) / width - cubic, cubic / width
