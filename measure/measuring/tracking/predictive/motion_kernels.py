"""A body's motion, carried on and corrected, compiled: see `motion_filter`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.linear_kernels import inverse
from measure.geometry.rotation_kernels import rotation_of, rotvec_of

_BEFOREHAND = 0.5
"""That accelerations last counts so much beforehand, in those seen: few of them tell little."""
_LEAST_USUAL = 1 / 64
"""A body that rested may accelerate at an eighth of what is set, lest its start be missed."""
_MOST = 16
"""A body that is shaken may accelerate at four times what is set: more is a mistake."""


class Course(NamedTuple):
    """How a body moves at an instant, in the world.

    Attributes:
        velocity: (6,) mm/s and rad/s.
        acceleration: (6,) as it is expected to go on, mm/s^2 and rad/s^2.
        during_s: for how long.
    """

    velocity: Floats
    acceleration: Floats
    during_s: float


class Accelerations(NamedTuple):
    """How a body has accelerated so far, in mm/s^2 and rad/s^2.

    Attributes:
        last: (6,) seen.
        square: (6, 6) mean square; zero if none was seen.
        product: (6,) mean product of each with the one before.
    """

    last: Floats
    square: Floats
    product: Floats


class MeasuredPose(NamedTuple):
    """A measured world_from_body.

    Attributes:
        rotation: (3, 3).
        translation: (3,) mm.
        covariance: (6, 6) in its `perturb` chart.
    """

    rotation: Floats
    translation: Floats
    covariance: Floats


@compiled
def carried(covariance: Floats, dt: float, variance: Floats) -> Floats:
    """The covariance (12, 12) of pose and velocity `dt` seconds on: see `MotionState.at`.

    Args:
        covariance: (12, 12).
        dt: s, of either sign.
        variance: (6,) of the acceleration.
    """
    out = covariance.copy()
    for i in range(6):
        for j in range(12):
            out[i, j] += dt * covariance[6 + i, j]
    for j in range(6):
        for i in range(12):
            out[i, j] += dt * out[i, 6 + j]
    for i in range(6):
        out[i, i] += variance[i] * dt**4 / 4
        out[6 + i, 6 + i] += variance[i] * dt**2
        out[i, 6 + i] += variance[i] * dt**3 / 2
        out[6 + i, i] += variance[i] * dt**3 / 2
    return out


@compiled
def way(course: Course, dt: float) -> tuple[Floats, Floats]:
    """How far (6,) a body goes within `dt` seconds, of either sign, and its velocity (6,) then.

    An acceleration is not expected to go on for longer than it has been seen.
    """
    during = min(max(dt, -course.during_s), course.during_s)
    gone = course.velocity * dt + course.acceleration * (during * (dt - during / 2))
    return gone, course.velocity + course.acceleration * during


@compiled
def moved_on(
    rotation: Floats,
    translation: Floats,
    course: Course,
    covariance: Floats,
    dt: float,
    variance: Floats,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Rotation, translation, velocity and covariance `dt` seconds on: see `MotionState.at`."""
    gone, velocity = way(course, dt)
    return (
        rotation_of(gone[3:]) @ rotation,
        translation + gone[:3],
        velocity,
        carried(covariance, dt, variance),
    )


@compiled
def updated(
    rotation: Floats,
    translation: Floats,
    course: Course,
    covariance: Floats,
    dt: float,
    variance: Floats,
    measured: MeasuredPose,
    extra: Floats,
    accelerations: Accelerations,
    share: float,
) -> tuple[Floats, Floats, Course, Floats, Accelerations]:
    """A motion, carried on to the time of a measured pose, after that.

    Args:
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        course: how it moves.
        covariance: (12, 12) of pose and velocity.
        dt: s until the measured pose.
        variance: (6,) of the acceleration.
        measured: the pose then.
        extra: (6,) variances added to that.
        accelerations: so far.
        share: of one more in their means; 0 to leave them as they are.

    Returns:
        Rotation, translation, course, covariance and accelerations after.
    """
    usual = _usual(accelerations.square, variance)
    rotation, translation, velocity, known = moved_on(
        rotation, translation, course, covariance, dt, usual
    )
    off = np.empty(6)
    off[:3] = measured.translation - translation
    off[3:] = rotvec_of(measured.rotation @ rotation.T)
    step, covariance = corrected(known, measured.covariance + np.diag(extra), off)
    if share > 0:
        accelerations = _one_more(course.acceleration + step[6:] / dt, accelerations, share)
    return (
        rotation_of(step[3:6]) @ rotation,
        translation + step[:3],
        Course(velocity + step[6:], _going_on(accelerations), abs(dt)),
        covariance,
        accelerations,
    )


@compiled
def _one_more(seen: Floats, before: Accelerations, share: float) -> Accelerations:
    """One more acceleration (6,), and its share in the means."""
    square = before.square + share * (np.outer(seen, seen) - before.square)
    return Accelerations(
        seen, square, before.product + share * (seen * before.last - before.product)
    )


@compiled
def _going_on(so_far: Accelerations) -> Floats:
    """The acceleration (6,) to expect: as much of the last one as each told of the next so far."""
    out = np.zeros(6)
    for i in range(6):
        if so_far.square[i, i] > 0:
            told = so_far.product[i] / so_far.square[i, i]
            share = (told + _BEFOREHAND) / (1 + _BEFOREHAND)
            out[i] = min(max(share, 0.0), 1.0) * so_far.last[i]
    return out


@compiled
def _usual(square: Floats, variance: Floats) -> Floats:
    """Variances (6,) of the acceleration that a body has shown."""
    out = variance.copy()
    for i in range(6):
        if square[i, i] > 0:
            out[i] = min(max(square[i, i], _LEAST_USUAL * variance[i]), _MOST * variance[i])
    return out


@compiled
def possible(square: Floats, sd: Floats) -> Floats:
    """Standard deviations (6,) of the acceleration to reckon with: see `MotionState.possible`."""
    out = np.empty(6)
    for i in range(6):
        out[i] = np.sqrt(min(max(square[i, i], sd[i] * sd[i]), _MOST * sd[i] * sd[i]))
    return out


@compiled
def corrected(known: Floats, noise: Floats, off: Floats) -> tuple[Floats, Floats]:
    """The Kalman filter's change (12,) of pose and velocity, and the covariance (12, 12) after.

    Args:
        known: (12, 12) covariance of the prediction.
        noise: (6, 6) covariance of the measured pose.
        off: (6,) measured minus predicted pose, in the prediction's chart.
    """
    gain = known[:, :6].copy() @ inverse(known[:6, :6] + noise)
    keep = np.eye(12)
    keep[:, :6] -= gain
    return gain @ off, keep @ known @ keep.T + gain @ noise @ gain.T
