"""Derivatives of the jointly fitted pose by what it was fitted to, compiled.

See docs/explanation/joint_fit.md, formulas 17 and 19.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.rotation_kernels import apply_matrix
from measure_plugins._joint_fit.elimination import EFFECTS, SHARED, ReducedEquations
from measure_plugins._joint_fit.problem import PackedOutlines


@compiled
def by_ball(outlines: PackedOutlines, equations: ReducedEquations, inverse: Floats) -> Floats:
    """Derivatives (k, 6, 3) of the pose by where single ball-views show their balls, world, per mm.

    A step of the ball changes the residuals of its ball-view as the same step of the body does.
    """
    out = np.empty((len(outlines.view_of), 6, 3))
    for k in range(len(out)):
        _fill_solution(inverse, 6 + outlines.view_of[k], equations.normal[k, :, :3], out[k])
    return out


@compiled
def _fill_solution(inverse: Floats, offset: int, right: Floats, out: Floats) -> None:
    """Fill the pose (6, 3) that solves for a ball-view's right sides (7, 3)."""
    for i in range(6):
        for j in range(3):
            total = inverse[i, offset] * right[6, j]
            for b in range(6):
                total += inverse[i, b] * right[b, j]
            out[i, j] = total


@compiled
def by_camera(
    outlines: PackedOutlines, steps: Floats, rotation: Floats, translation: Floats
) -> Floats:
    """Derivatives (c, 6, 6) of the pose by the cameras' poses, in their `perturb` charts.

    Moving a camera by (dt, w) moves every ball, as the camera sees it, by -dt - w x (X - t).
    """
    out = np.zeros((len(outlines.rotations), 6, 6))
    for k in range(len(outlines.view_of)):
        view = outlines.view_of[k]
        outward = outlines.rotations[view].T
        # From the camera's centre to the ball's.
        x, y, z = (
            apply_matrix(rotation, outlines.centers_body[k])
            + translation
            + apply_matrix(outward, outlines.translations[view])
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
def by_effect(
    outlines: PackedOutlines, equations: ReducedEquations, variances: Floats, inverse: Floats
) -> Floats:
    """Derivatives (k, 6, 3) of the pose by shifts (x, y, radius) of single outlines, per px.

    A shift s leaves, the ball-view's random effects eliminated, the right side B^T (s / variance)
    with B = `back_substitution`.
    """
    out = np.empty((len(outlines.view_of), 6, EFFECTS))
    right = np.empty((SHARED, EFFECTS))
    for k in range(len(out)):
        for a in range(SHARED):
            for j in range(EFFECTS):
                right[a, j] = equations.back_substitution[k, j, a] / variances[k, j]
        _fill_solution(inverse, 6 + outlines.view_of[k], right, out[k])
    return out
