"""How the jointly fitted pose reacts to what it was fitted to, compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.rotation_kernels import times
from measure_plugins._joint_fit.elimination import OWN, SHARED, Terms
from measure_plugins._joint_fit.problem import Contours


@compiled
def by_step(contours: Contours, terms: Terms, inverse: Floats) -> Floats:
    """How the fitted pose reacts to steps of single ball-views' balls in the world: (k, 6, 3).

    To a ball-view, its ball's step is the body's.
    """
    out = np.empty((len(contours.view_of), 6, 3))
    for k in range(len(out)):
        _react(inverse, 6 + contours.view_of[k], terms.normal[k, :, :3], out[k])
    return out


@compiled
def _react(inverse: Floats, offset: int, right: Floats, out: Floats) -> None:
    """The pose's reaction (6, 3) to right sides (7, 3) of a ball-view's shared unknowns."""
    for i in range(6):
        for j in range(3):
            total = inverse[i, offset] * right[6, j]
            for b in range(6):
                total += inverse[i, b] * right[b, j]
            out[i, j] = total


@compiled
def by_camera(contours: Contours, steps: Floats, rotation: Floats, translation: Floats) -> Floats:
    """How the fitted pose (6,) reacts to the cameras' poses: (c, 6, 6), in their `perturb` charts.

    Moving a camera by (dt, w) moves every ball, as the camera sees it, by -dt - w x (X - t).
    """
    out = np.zeros((len(contours.rotations), 6, 6))
    for k in range(len(contours.view_of)):
        view = contours.view_of[k]
        outward = contours.rotations[view].T
        # From the camera's centre to the ball's.
        x, y, z = (
            times(rotation, contours.centers_body[k])
            + translation
            + times(outward, contours.translations[view])
        )
        for i in range(6):
            p, q, r = steps[k, i]
            out[view, i, 0] += p
            out[view, i, 1] += q
            out[view, i, 2] += r
            out[view, i, 3] -= q * z - r * y
            out[view, i, 4] -= r * x - p * z
            out[view, i, 5] -= p * y - q * x
    return out


@compiled
def by_shift(contours: Contours, terms: Terms, variances: Floats, inverse: Floats) -> Floats:
    """How the fitted pose reacts to shifts (x, y, radius, in px) of single outlines: (k, 6, 3).

    A shift s leaves, its ball-view's own unknowns eliminated, the right side gain^T (s / variance).
    """
    out = np.empty((len(contours.view_of), 6, OWN))
    right = np.empty((SHARED, OWN))
    for k in range(len(out)):
        for a in range(SHARED):
            for j in range(OWN):
                right[a, j] = terms.gain[k, j, a] / variances[k, j]
        _react(inverse, 6 + contours.view_of[k], right, out[k])
    return out
