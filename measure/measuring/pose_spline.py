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
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, stacked
from measure.geometry import RigidTransform
from measure.measuring.measurement import Draft, Measurement, Status
from measure.model import Motion, Pose

if TYPE_CHECKING:
    from measure.measuring.spline_kernels import Spline

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
        from measure.measuring.spline_kernels import along

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
    from measure.measuring.spline_kernels import spline_through

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
