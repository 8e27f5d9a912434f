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
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, stacked
from measure.geometry import RigidTransform
from measure.limits import MAX_PAUSE_S
from measure.measuring.measurement import Draft, Measurement, Status
from measure.model import Motion, Pose

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

REACH = 3
"""Poses on either side: the fourth would change a slope by 2 % of its own noise."""
_POLYNOMIAL_KNOTS = 5  # Nearest knots of the polynomial whose slope is compared with the spline's


@dataclass(frozen=True, eq=False)
class SplineMotion(Motion):
    """The motion around one knot of a spline through poses."""

    # from seconds after the pose to its chart (6,), and behind these to how the curve answers a
    # unit displacement of each knot (n,).
    curve: CubicSpline = field(kw_only=True)
    own: int = field(kw_only=True)  # the knot at the pose

    @property
    def acceleration(self) -> Floats:
        """(6,) at the pose, mm/s^2 and rad/s^2."""
        return np.asarray(self.curve(0.0, 2)[:6])

    def moved(self, time_s: ArrayLike) -> Floats:
        """How far (..., 6) the body has moved at other times (...), in the chart of the pose."""
        lead_s = np.asarray(time_s, dtype=np.float64) - self.time_s
        return np.asarray(self.curve(lead_s)[..., :6])

    def error_growth(self, times_s: Collection[float]) -> float:
        """Factor on an error of the pose after solving it again with images of these times.

        An error of the pose curves the spline, which then moves the detections the same way.
        """
        own_acceleration = float(self.curve(0.0, 2)[6 + self.own])
        return 1.0 + abs(own_acceleration) / 2 * float(np.var(list(times_s)))


def motion_at(pose: Pose, before: Sequence[Pose], after: Sequence[Pose]) -> SplineMotion | None:
    """The motion at `pose` by the spline through it and the poses around it; None if it is alone.

    The covariance of its velocity holds those of the poses, and the difference to the slope of a
    polynomial through the nearest poses, which bounds the error of interpolation.

    Args:
        pose: where the motion is wanted.
        before: earlier poses, in order of time.
        after: later poses, in order of time.
    """
    knots, own = [*before, pose, *after], len(before)
    if len(knots) < 2:
        return None
    from scipy.interpolate import CubicSpline  # slow to load; images of one instant need none

    lead_s = np.array([knot.time_s - pose.time_s for knot in knots])
    rotations, translations = zip(
        *((knot.world_from_body.rotation, knot.world_from_body.translation) for knot in knots),
        strict=True,
    )
    here = RigidTransform(stacked(rotations), stacked(translations))
    places = here.difference(pose.world_from_body)
    curve = CubicSpline(lead_s, np.hstack([places, np.eye(len(knots))]))
    slope = curve(0.0, 1)
    weights = slope[6:]
    noise = np.einsum("k,kab->ab", weights**2, stacked([knot.covariance for knot in knots]))
    difference = (weights - _polynomial_weights(lead_s)) @ places
    return SplineMotion(
        pose.world_from_body,
        pose.time_s,
        slope[:6],
        velocity_covariance=noise + np.outer(difference, difference),
        curve=curve,
        own=own,
    )


def _polynomial_weights(lead_s: Floats) -> Floats:
    """Weights (n,) of knots in the slope at zero of a polynomial through the nearest."""
    near = np.argsort(np.abs(lead_s), kind="stable")[: min(_POLYNOMIAL_KNOTS, len(lead_s) - 1)]
    out, scale = np.zeros(len(lead_s)), float(np.abs(lead_s).max())
    if len(near) > 1:
        powers = np.vander(lead_s[near] / scale, increasing=True)
        out[near] = np.linalg.solve(powers.T, np.eye(len(near))[1]) / scale
    return out


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
        if not 0 < abs(other.time_s - time_s) <= MAX_PAUSE_S:
            break
        found.append(other.pose)
        time_s = other.time_s
    return found
