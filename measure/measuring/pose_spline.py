"""How the body moves at a pose: a cubic spline through the poses before and after it.

The slopes of a cubic spline are the compact differences of Lele (1992, J. Comput. Phys. 103,
section 2): at ten pictures a period of a shaking body they are 0.1 % off, where the difference of
the two neighbours is 7 % off. The spline runs through the poses' coordinates in the chart of the
one it is asked about, so nothing is lost where it is evaluated.
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
_LONGEST_PAUSE_S = 0.5
"""What lies beyond a pause says nothing about the motion."""


@dataclass(frozen=True, eq=False)
class SplineMotion(Motion):
    """The motion round one knot of a spline through poses.

    Attributes:
        knots_s: (n,) times of the knots after the pose's.
        spline: the pose's chart by that time.
    """

    knots_s: Floats = field(kw_only=True)
    spline: Spline = field(kw_only=True)

    @property
    def acceleration(self) -> Floats:
        """(6,) at the pose, mm/s^2 and rad/s^2."""
        return self.spline.bend

    def moved(self, time_s: ArrayLike) -> Floats:
        """How far (..., 6) the body has moved at other times (...), in the chart of the pose."""
        from measure.measuring.pose_spline import along

        lead_s = np.asarray(time_s, dtype=np.float64) - self.time_s
        path = along(self.knots_s, self.spline.places, self.spline.slopes, lead_s.reshape(-1))
        return path.reshape(*lead_s.shape, 6)

    def gain(self, times_s: Collection[float]) -> float:
        """By how much an error of the pose grows in pictures of these times.

        A pose that is off bends the spline, which then carries the pictures off as well.
        """
        mean_s = sum(times_s) / len(times_s)
        variance = sum((time_s - mean_s) ** 2 for time_s in times_s) / len(times_s)
        return 1.0 + abs(self.spline.own_bend) / 2 * variance


def motion_at(pose: Pose, before: Sequence[Pose], after: Sequence[Pose]) -> SplineMotion | None:
    """The motion at `pose` by the spline through it and the poses round it; None if it is alone.

    Args:
        pose: where the motion is wanted.
        before: earlier poses, in order of time.
        after: later poses, in order of time.
    """
    from measure.measuring.pose_spline import spline_through

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


def with_neighbours(drafts: Iterable[Draft]) -> Iterator[tuple[list[Pose], Draft, list[Pose]]]:
    """Every draft with the believed poses up to `REACH` before and after it, in order."""
    held: deque[Draft] = deque()
    at = 0
    for draft in drafts:
        held.append(draft)
        if len(held) > at + REACH:
            yield _neighbours(held, at)
            at = min(at + 1, REACH)
            if len(held) > 2 * REACH:
                held.popleft()
    for rest in range(at, len(held)):
        yield _neighbours(held, rest)


def _neighbours(held: Sequence[Draft], at: int) -> tuple[list[Pose], Draft, list[Pose]]:
    """The believed poses before and after one of `held`, as far as they hang together.

    None for pictures of one instant.
    """
    seen = held[at].seen
    if seen is not None and seen.at_once:
        return [], held[at], []
    measured = [draft.measurement for draft in held]
    time_s = measured[at].time_s
    before = _unbroken(time_s, measured[max(at - REACH, 0) : at][::-1])
    after = _unbroken(time_s, measured[at + 1 : at + 1 + REACH])
    return before[::-1], held[at], after


def _unbroken(time_s: float, others: Sequence[Measurement]) -> list[Pose]:
    """The believed poses of `others`, the nearest first, until one is too far from the last."""
    found: list[Pose] = []
    for other in others:
        if other.pose is None or other.status is not Status.OK:
            continue
        if not 0 < abs(other.time_s - time_s) <= _LONGEST_PAUSE_S:
            break
        found.append(other.pose)
        time_s = other.time_s
    return found


def warm_up() -> None:
    """Compile the spline, or load it, by laying one through two poses in one place."""
    still = RigidTransform.identity()
    one, two = (Pose(time_s, still, np.eye(6), 0.0, 0.0, (), ()) for time_s in (0.0, 1.0))
    motion = motion_at(one, [], [two])
    assert motion is not None
    motion.moved(0.5)


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
