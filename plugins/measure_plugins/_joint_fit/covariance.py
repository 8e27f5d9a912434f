"""The pose fitted to outlines, with what is uncertain about all of them together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.estimation.pixel_sensitivity import by_lens
from measure.geometry.rotation_kernels import times
from measure.model.lens import bend
from measure.model.rig_kernels import RigRows
from measure_plugins._joint_fit.elimination import unseen
from measure_plugins._joint_fit.problem import Contours
from measure_plugins._joint_fit.solve import ContourFit, fit_contours

_LEAST_COMMON_PX = 0.06
"""What light shifts a ball by alike in all cameras, however well these agree: chosen on rendered
recordings, dim rooms and large lamps among them, so that 95 % regions hold the truth in 95 %."""
_PART = 0.4
"""Share of that shift's square that is each ball's own; as much again is the same for all balls,
and moves the body without turning it. Were all of it each ball's own, positions would be told twice
as surely as rotations, and the more so the more balls there are."""


class Solution(NamedTuple):
    """A pose fitted to outlines.

    Attributes:
        rotation: (3, 3) of world_from_body.
        translation: (3,) of world_from_body, mm.
        covariance: (6, 6) of what differs from ball-view to ball-view, and of what light and
            uncertain cameras add to it.
        shifts_px: (k, 3) see `ContourFit`.
        offsets_px: (c,) see `ContourFit`.
        rms_px: of the shifts of the centres.
        solved: whether the outlines determine the pose.
        converged: whether the steps died out.
    """

    rotation: Floats
    translation: Floats
    covariance: Floats
    shifts_px: Floats
    offsets_px: Floats
    rms_px: float
    solved: bool
    converged: bool


@compiled
def solve_contours(
    contours: Contours,
    rotation: Floats,
    translation: Floats,
    prior_information: Floats,
    ball_of: Ints,
    balls: int,
    rig: RigRows,
    aside_px2: Floats,
    widening: float,
) -> Solution:
    """Fit the pose, see `fit_contours`, and say what is uncertain about it; see below.

    Args:
        contours: k ball-views in c views.
        rotation: (3, 3) of the world_from_body to start from.
        translation: (3,) of the same.
        prior_information: (6, 6) see `fit_contours`.
        ball_of: (k,) index of the ball.
        balls: how many there are.
        rig: the c cameras.
        aside_px2: (c, 2, 2) covariances of what cameras that are off by that shift alike; likewise.
        widening: of the covariance, for a scatter that is itself estimated.
    """
    fit = fit_contours(contours, rotation, translation, prior_information, unseen(aside_px2))
    known = fit.covariance * widening
    if fit.solved:
        known += of_light(contours, fit, ball_of, balls, rig.lenses)
        known += of_cameras(contours, fit, rig)
    off = fit.shifts_px[:, :2]
    return Solution(
        fit.rotation,
        fit.translation,
        (known + known.T) / 2,
        fit.shifts_px,
        fit.offsets_px,
        np.sqrt(np.sum(off * off) / len(off)),
        fit.solved,
        fit.converged,
    )


@compiled
def rms_distance(fit: Solution, points_body: Floats, centers: Floats) -> float:
    """RMS distance in mm of centres (f, 3) in the world from the body's (f, 3); NaN for f = 0."""
    total = 0.0
    for i in range(len(centers)):
        off = centers[i] - times(fit.rotation, points_body[i]) - fit.translation
        total += np.sum(off * off)
    return float(np.sqrt(total / len(centers)))


@compiled
def of_cameras(contours: Contours, fit: ContourFit, rig: RigRows) -> Floats:
    """What the cameras' uncertain poses and lenses add to the pose's covariance (6, 6).

    Args:
        contours: k ball-views in c views.
        fit: the pose fitted to them.
        rig: the c cameras.
    """
    out, lever = np.zeros((6, 6)), np.zeros((6, 18))
    shifts = np.empty((3, 12))
    for view in range(len(rig.lenses)):
        if not np.any(rig.covariances[view]):
            continue
        lever[:, :6], lever[:, 6:] = fit.by_camera[view], 0.0
        for k in range(len(contours.view_of)):
            if contours.view_of[k] == view:
                _shifts_by_lens(contours, fit, k, rig.lenses[view], shifts)
                lever[:, 6:] -= fit.by_shift[k] @ shifts
        out += lever @ rig.covariances[view] @ lever.T
    return out


@compiled
def _shifts_by_lens(
    contours: Contours, fit: ContourFit, k: int, lens: Floats, shifts: Floats
) -> None:
    """Fill how ball-view k's outline moves and grows (x, y, radius) by the intrinsics: (3, 12)."""
    view, radius = contours.view_of[k], contours.radii[k]
    place = times(fit.rotation, contours.centers_body[k]) + fit.translation
    center = times(contours.rotations[view], place) + contours.translations[view]
    moved, middle = _seen(center, lens)
    shifts[:2], shifts[2] = moved, 0.0
    for axis in range(2):
        for side in (-1.0, 1.0):
            edge = center.copy()
            edge[axis] += side * radius
            edge_moved, at = _seen(edge, lens)
            outward = (at - middle) / np.sqrt(np.sum((at - middle) ** 2))
            for j in range(12):
                growth = edge_moved[:, j] - moved[:, j]
                shifts[2, j] += (outward[0] * growth[0] + outward[1] * growth[1]) / 4


@compiled
def _seen(point: Floats, lens: Floats) -> tuple[Floats, Floats]:
    """A camera-frame point's pixel by the intrinsics (2, 12), and the pixel (2,)."""
    x, y = point[0] / point[2], point[1] / point[2]
    moved, pixel = np.zeros((2, 12)), np.empty(2)
    by_lens(x, y, lens, moved)
    u, v = bend(x, y, lens)
    pixel[0], pixel[1] = lens[0] * u + lens[1] * v + lens[2], lens[3] * v + lens[4]
    return moved, pixel


@compiled
def of_light(
    contours: Contours, fit: ContourFit, ball_of: Ints, balls: int, lenses: Floats
) -> Floats:
    """What shifts a ball alike in all cameras adds to the pose's covariance (6, 6).

    Light falls on a ball from the same side whoever looks, and shifts its outlines by its colour:
    the part that all cameras share moves the ball and leaves little residual. It is taken from how
    large the part is that differs and is seen, though from no less than `_LEAST_COMMON_PX`; partly
    it is each ball's own, and partly the same for all balls, as what a wrong tone curve does to
    balls under the same light.

    Args:
        contours: k ball-views in c views.
        fit: the pose fitted to them.
        ball_of: (k,) index of the ball.
        balls: how many there are.
        lenses: (c, 13) lens rows.
    """
    levers, mm_per_px = np.zeros((balls, 6, 3)), 0.0
    for k in range(len(contours.view_of)):
        view = contours.view_of[k]
        levers[ball_of[k]] += fit.by_step[k]
        place = times(fit.rotation, contours.centers_body[k]) + fit.translation
        center = times(contours.rotations[view], place) + contours.translations[view]
        focal = (lenses[view, 0] + lenses[view, 3]) / 2
        mm_per_px += np.sqrt(np.sum(center * center)) / focal / len(contours.view_of)
    out, together = np.zeros((6, 6)), np.zeros((6, 3))
    for ball in range(balls):
        out += levers[ball] @ levers[ball].T
        together += levers[ball]
    out += together @ together.T
    common_px = max(fit.shift_sd_px[0], _LEAST_COMMON_PX)
    return out * (_PART * (common_px * mm_per_px) ** 2)
