"""How the body moves at a pose: a cubic spline through the poses before and after it.

The slopes of a cubic spline are the compact differences of Lele (1992, J. Comput. Phys. 103,
section 2): at ten pictures a period of a shaking body they are 0.1 % off, where the difference of
the two neighbours is 7 % off. The spline runs through the poses' coordinates in the chart of the
one it is asked about, so nothing is lost where it is evaluated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.measuring.measurement import Draft, Measurement, Status
from measure.model import Motion, Pose

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

REACH = 3
"""Poses on either side: the fourth would change a slope by 2 % of its own noise."""
_PLAIN_KNOTS = 5
_LONGEST_PAUSE_S = 0.5
"""What lies beyond a pause says nothing about the motion."""


@dataclass(frozen=True, eq=False)
class SplineMotion(Motion):
    """The motion round one knot of a spline through poses.

    Attributes:
        path: the pose's chart (6,) by the time after it.
        own_bend: the spline's second derivative where its own knot is one off, and no other, 1/s^2.
    """

    path: PPoly = field(kw_only=True)
    own_bend: float = field(kw_only=True)

    def moved(self, time_s: float) -> Floats:
        """How far (6,) the body has moved at another time, in the chart of the pose."""
        return np.asarray(self.path(time_s - self.time_s))

    def gain(self, times_s: Iterable[float]) -> float:
        """By how much an error of the pose grows in pictures of these times.

        A pose that is off bends the spline, which then carries the pictures off as well.
        """
        lead_s = np.array(list(times_s)) - self.time_s
        return 1.0 + abs(self.own_bend) / 2 * float(np.var(lead_s))


def motion_at(pose: Pose, before: Sequence[Pose], after: Sequence[Pose]) -> SplineMotion | None:
    """The motion at `pose` by the spline through it and the poses round it; None if it is alone.

    Args:
        pose: where the motion is wanted.
        before: earlier poses, in order of time.
        after: later poses, in order of time.
    """
    knots = [*before, pose, *after]
    if len(knots) < 2:
        return None
    from scipy.interpolate import CubicSpline, PPoly

    times = np.array([knot.time_s for knot in knots]) - pose.time_s
    places = np.stack([knot.world_from_body.difference(pose.world_from_body) for knot in knots])
    # One spline for the path and for what every knot does to it: they share the costly part.
    curves = np.hstack([places, np.eye(len(knots))])
    spline, size = CubicSpline(times, curves, bc_type="not-a-knot"), places.shape[1]
    slope, bend = spline(0.0, 1)[size:], spline(0.0, 2)[size:]
    noise = np.einsum("k,kij->ij", slope**2, np.stack([knot.covariance for knot in knots]))
    # Where a plainer curve through the nearest poses goes another way, neither is to be trusted.
    other = (slope - _plainer_slope(times)) @ places
    return SplineMotion(
        pose.world_from_body,
        pose.time_s,
        slope @ places,
        velocity_covariance=noise + np.outer(other, other),
        path=PPoly.construct_fast(spline.c[..., :size], spline.x),
        own_bend=float(bend[len(before)]),
    )


def _plainer_slope(times_s: Floats) -> Floats:
    """Weights (n,) of the knots in the slope at 0: a polynomial through some of the nearest."""
    near = np.argsort(np.abs(times_s))[: min(_PLAIN_KNOTS, len(times_s) - 1)]
    scale = np.ptp(times_s)
    powers = np.vander(times_s[near] / scale, max(len(near), 2), increasing=True)
    weights = np.zeros(len(times_s))
    weights[near] = np.linalg.pinv(powers)[1] / scale
    return weights


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
    """The believed poses before and after one of `held`, as far as they hang together."""
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
