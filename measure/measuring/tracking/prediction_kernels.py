"""Prediction of the motion and of the balls in the pictures, compiled: see `motion_filter`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.linear_kernels import inverse
from measure.geometry.rotation_kernels import rotation_of, rotvec_of, times
from measure.model.rig_kernels import project_one

_OUT_OF_SIGHT_PX = -1e4
_BEFOREHAND = 0.5
"""That accelerations last counts so much beforehand, in those seen: few of them tell little."""
_LEAST_USUAL = 1 / 64
"""A body that rested may accelerate at an eighth of what is set, lest its start be missed."""


class Predicted(NamedTuple):
    """n predicted ball-views, all balls of the first camera, then of the second, and so on.

    Attributes:
        centers_px: (n, 2).
        radii_px: (n,).
        centers_camera: (n, 3) in mm.
        covariances_px: (n, 2, 2) from the predicted pose's covariance.
        jacobians: (n, 2, 6) by the pose's `perturb` chart.
        spread_px: (n,) standard deviations of the centres where they are widest.
    """

    centers_px: Floats
    radii_px: Floats
    centers_camera: Floats
    covariances_px: Floats
    jacobians: Floats
    spread_px: Floats


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
def predict_balls(
    rotation: Floats,
    translation: Floats,
    course: Course,
    covariance: Floats,
    variance: Floats,
    leads_s: Floats,
    balls: Floats,
    radii: Floats,
    lenses: Floats,
    reach: Floats,
    rig_rotation: Floats,
    rig_centers: Floats,
    readouts: Floats,
    min_depth: float,
) -> Predicted:
    """Every ball of a moving body in every camera, at its picture's time.

    Args:
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        course: how it moves.
        covariance: (12, 12) of pose and velocity.
        variance: (6,) of the acceleration.
        leads_s: (c,) times of the pictures after the pose's.
        balls: (k, 3) centres in the body.
        radii: (k,) mm.
        lenses: (c, 13).
        reach: (c,) of the lens models.
        rig_rotation: (c, 3, 3) of world_from_camera.
        rig_centers: (c, 3).
        readouts: (c, 2) time in s from one row to the next, and the middle row.
        min_depth: see `rig_kernels.project_one`.
    """
    count = len(balls)
    out = _room(len(lenses) * count)
    by_point, toward = np.empty((2, 3)), np.empty(3)
    for camera in range(len(lenses)):
        dt = leads_s[camera]
        known = carried(covariance, dt, variance)
        gone, velocity = way(course, dt)
        turned = rotation_of(gone[3:]) @ rotation
        for ball in range(count):
            row = camera * count + ball
            arm = times(turned, balls[ball])
            center = arm + translation + gone[:3]
            pixel = out.centers_px[row]
            project_one(
                lenses[camera], reach[camera], rig_rotation[camera], rig_centers[camera], center,
                min_depth, pixel, by_point,
            )  # fmt: skip
            toward[:] = center - rig_centers[camera]
            out.centers_camera[row] = times(rig_rotation[camera].T, toward)
            out.radii_px[row] = _apparent(lenses[camera], toward, radii[ball])
            if np.isfinite(pixel[0]) and np.isfinite(pixel[1]):
                _fill_slopes(by_point, arm, out.jacobians[row])
                _roll(readouts[camera], velocity, out.jacobians[row], pixel)
            else:
                pixel[:] = _OUT_OF_SIGHT_PX
            _fill_spread(row, known, out)
    return out


@compiled
def _room(n: int) -> Predicted:
    return Predicted(
        np.zeros((n, 2)),
        np.zeros(n),
        np.zeros((n, 3)),
        np.zeros((n, 2, 2)),
        np.zeros((n, 2, 6)),
        np.zeros(n),
    )


@compiled
def _apparent(lens: Floats, toward: Floats, radius: float) -> float:
    """The radius in px that the cone's half-angle has across the line of sight."""
    square = toward[0] ** 2 + toward[1] ** 2 + toward[2] ** 2
    return (lens[0] + lens[3]) / 2 * radius / np.sqrt(max(square - radius**2, 1.0))


@compiled
def _fill_slopes(by_point: Floats, arm: Floats, slopes: Floats) -> None:
    """A ball's pixel by the pose (2, 6): a turn moves it by its cross product with the arm."""
    for u in range(2):
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            slopes[u, a] = by_point[u, a]
            slopes[u, 3 + a] = arm[b] * by_point[u, c] - arm[c] * by_point[u, b]


@compiled
def _roll(readout: Floats, velocity: Floats, slopes: Floats, pixel: Floats) -> None:
    """Move a pixel on to the time when a rolling shutter exposes its row."""
    delay = readout[0] * (pixel[1] - readout[1])
    for u in range(2):
        for a in range(6):
            pixel[u] += delay * slopes[u, a] * velocity[a]


@compiled
def _fill_spread(row: int, known: Floats, out: Predicted) -> None:
    """A pixel's covariance from the pose's, and its standard deviation where it is widest."""
    slopes, spread = out.jacobians[row], out.covariances_px[row]
    for u in range(2):
        for v in range(2):
            total = 0.0
            for i in range(6):
                for j in range(6):
                    total += slopes[u, i] * known[i, j] * slopes[v, j]
            spread[u, v] = total
    half = (spread[0, 0] - spread[1, 1]) / 2
    widest = (spread[0, 0] + spread[1, 1]) / 2 + np.sqrt(half**2 + spread[0, 1] * spread[1, 0])
    out.spread_px[row] = np.sqrt(max(widest, 0.0))


@compiled
def search_sizes(
    balls: Predicted, sigmas: float, floor_px: float, slack: float, decimals: int
) -> Floats:
    """How to search for n balls, see `Windows.expectations`; rounded.

    Returns:
        (n, 9) the centre in px and in the camera frame, least and most radius, least distance of
        two circles, reach.
    """
    out, unit = np.empty((len(balls.radii_px), 9)), 10.0**decimals
    for i in range(len(out)):
        reach, size = sigmas * balls.spread_px[i] + floor_px, balls.radii_px[i]
        center = balls.centers_camera[i]
        loose = slack + reach / max(np.sqrt(np.sum(center * center)), 1e-9)
        out[i, :2], out[i, 2:5] = balls.centers_px[i], center
        out[i, 5], out[i, 6] = size * (1 - loose), size * (1 + loose)
        out[i, 7], out[i, 8] = 0.5 * size, reach
    return np.rint(out * unit) / unit


@compiled
def updated(
    rotation: Floats,
    translation: Floats,
    course: Course,
    covariance: Floats,
    dt: float,
    variance: Floats,
    measured_rotation: Floats,
    measured_translation: Floats,
    noise: Floats,
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
        measured_rotation: (3, 3) of the measured world_from_body.
        measured_translation: (3,) the same.
        noise: (6, 6) covariance of the measured pose.
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
    off[:3] = measured_translation - translation
    off[3:] = rotvec_of(measured_rotation @ rotation.T)
    step, covariance = corrected(known, noise + np.diag(extra), off)
    if share > 0:
        accelerations = _with(course.acceleration + step[6:] / dt, accelerations, share)
    return (
        rotation_of(step[3:6]) @ rotation,
        translation + step[:3],
        Course(velocity + step[6:], _going_on(accelerations), abs(dt)),
        covariance,
        accelerations,
    )


@compiled
def _with(seen: Floats, before: Accelerations, share: float) -> Accelerations:
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
    """Variances (6,) of the acceleration that a body has shown, within what is set."""
    out = variance.copy()
    for i in range(6):
        if square[i, i] > 0:
            out[i] = min(variance[i], max(square[i, i], _LEAST_USUAL * variance[i]))
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
