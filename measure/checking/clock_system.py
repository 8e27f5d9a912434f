"""The normal equations of cameras' clocks, with the pose of every instant eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.estimation.pose_fit import Sightings
from measure.geometry import RigidTransform, skew

_HUBER = 3.0
_STILL_PX_S = 1e-3
_BLOCKS = 8


@dataclass(frozen=True, eq=False)
class Instant:
    """One instant's sightings, and the motion around it.

    Attributes:
        sightings: n balls seen.
        cameras: (n,) index of the camera.
        rows: (n,) the ball's image row, from -0.5 at the top to 0.5 at the bottom.
        pose: at the instant.
        velocity: (6,) and
        acceleration: (6,) in the pose's `perturb` chart, per second and second squared.
    """

    sightings: Sightings
    cameras: Ints
    rows: Floats
    pose: RigidTransform
    velocity: Floats
    acceleration: Floats


def _linearise(instant: Instant, clocks: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals (n, 2), Jacobian by the pose (n, 2, 6), and image velocity (n, 2) in px/s."""
    s = instant.sightings
    lead = s.lead_s + clocks[instant.cameras, 0] + clocks[instant.cameras, 1] * instant.rows
    moved = lead[:, None] * instant.velocity + lead[:, None] ** 2 / 2 * instant.acceleration
    speed = instant.velocity + lead[:, None] * instant.acceleration
    arms = instant.pose.rotate(s.points_body)
    by_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(s), 3, 3)), -skew(arms)], axis=2)
    shift = np.einsum("nij,nj->ni", by_pose, moved)
    pixels, by_point = s.rig.project(arms + instant.pose.translation + shift)
    jacobian = by_point @ by_pose
    return s.pixels - pixels, jacobian, np.einsum("nij,nj->ni", jacobian, speed)


def bias_deviations(instants: Sequence[Instant], clocks: Floats, bias_px: float) -> Floats:
    """What a constant error of a camera's detections does to its clock (c, 2), in s.

    A ball's edge that is seen `bias_px` off all the time looks like a late stamp while the body
    moves one way, and like an early one on the way back: it cancels as far as the motion does.
    """
    count = len(clocks)
    totals, squares = np.zeros((count, 2, 2)), np.full((count, 2), 1e-30)
    for instant in instants:
        _, _, flow = _linearise(instant, clocks)
        for k, by in enumerate((flow, flow * instant.rows[:, None])):
            np.add.at(totals[:, k], instant.cameras, by)
            np.add.at(squares[:, k], instant.cameras, np.sum(by**2, axis=1))
    return np.asarray(bias_px * np.linalg.norm(totals, axis=2) / squares)


def from_the_middle(offsets_s: Floats, told: Bools) -> Floats:
    """The matrix (c, c) that gives offsets (c,) relative to their median.

    Motion shows differences only. Most often it is one clock that is wrong: measured from the
    median, that one has the whole offset and the others have none.

    Args:
        offsets_s: (c,).
        told: (c,) which of them the motion tells; the others are left alone.
    """
    matrix, index = np.eye(len(offsets_s)), np.nonzero(told)[0]
    if len(index):
        order = index[np.argsort(offsets_s[index])]
        middle = order[[(len(order) - 1) // 2, len(order) // 2]]
        for one in middle:
            matrix[index, one] -= 0.5
    return matrix


@dataclass(frozen=True, eq=False)
class Reduced:
    """One instant's say about the clocks, its pose eliminated."""

    normal: Floats
    right: Floats
    chi_square: float
    degrees: int
    pose_pose: Floats
    pose_clock: Floats
    pose_right: Floats

    def move(self, step: Floats) -> Floats:
        """The pose's own step (6,) that goes with the clocks' (c, 2)."""
        return np.asarray(self.pose_pose @ (self.pose_right - self.pose_clock @ step.reshape(-1)))


def reduce_instant(instant: Instant, clocks: Floats, readout: Bools) -> Reduced:
    """Linearise one instant about the clocks (c, 2); only cameras in `readout` (c,) roll."""
    residuals, by_pose, flow = _linearise(instant, clocks)
    by_clock = np.zeros((len(residuals), 2, clocks.size))
    rows = np.arange(len(residuals))
    by_clock[rows, :, 2 * instant.cameras] = flow
    rolling = readout[instant.cameras] * instant.rows
    by_clock[rows, :, 2 * instant.cameras + 1] = flow * rolling[:, None]
    weight = _weights(residuals, instant.sightings.noise)
    gain_pose = np.swapaxes(by_pose, 1, 2) @ weight
    gain_clock = np.swapaxes(by_clock, 1, 2) @ weight
    pose_pose = np.linalg.inv((gain_pose @ by_pose).sum(axis=0) + 1e-12 * np.eye(6))
    pose_clock = (gain_pose @ by_clock).sum(axis=0)
    pose_right = np.einsum("nij,nj->i", gain_pose, residuals)
    back = pose_clock.T @ pose_pose
    return Reduced(
        (gain_clock @ by_clock).sum(axis=0) - back @ pose_clock,
        np.einsum("nij,nj->i", gain_clock, residuals) - back @ pose_right,
        float(np.einsum("ni,nij,nj->", residuals, weight, residuals)),
        2 * len(residuals) - 6,
        pose_pose,
        pose_clock,
        pose_right,
    )


def solve_clocks(
    parts: Sequence[Reduced], clocks: Floats, readout: Bools, bias: Floats
) -> tuple[Floats, Floats]:
    """One Gauss-Newton step (c, 2) for the clocks, and their standard deviations (c, 2).

    Errors of neighbouring frames are alike (the light, the edges), so what the residuals say is
    compared with a jackknife over stretches of the recording; the larger one counts.

    Args:
        parts: of all instants, linearised about `clocks`.
        clocks: (c, 2) offsets and readout times.
        readout: (c,) which cameras' shutters may roll.
        bias: (c, 2) standard deviations from constant errors of the detections.
    """
    normal = sum((p.normal for p in parts), np.zeros_like(parts[0].normal))
    right = sum((p.right for p in parts), np.zeros_like(parts[0].right))
    told = np.diag(normal) > _STILL_PX_S**2
    told = told & np.stack([np.ones_like(readout), readout], axis=1).reshape(-1)
    scale = sum(p.chi_square for p in parts) / max(sum(p.degrees for p in parts), 1)
    step, covariance = _constrained(normal, right, told)
    gauge = np.eye(len(step))
    gauge[::2, ::2] = from_the_middle((clocks.reshape(-1) + step)[::2], told[::2])
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    variance = np.diag(gauge @ finite @ gauge.T)
    # Rounding leaves less than nothing where the motion says next to nothing.
    formal = np.sqrt(np.where(variance >= 0, variance, np.inf) * max(1.0, scale))
    off = _left_out(parts, normal, right, told) - step
    blocks = len(off)
    spread = np.sqrt((blocks - 1) * np.mean((off @ gauge.T) ** 2, axis=0))
    sd = np.hypot(np.maximum(formal, spread), np.sqrt(gauge**2 @ bias.reshape(-1) ** 2))
    sd[~told] = np.inf
    step = gauge @ (clocks.reshape(-1) + step) - clocks.reshape(-1)
    return step.reshape(-1, 2), sd.reshape(-1, 2)


def _left_out(parts: Sequence[Reduced], normal: Floats, right: Floats, told: Bools) -> Floats:
    """The steps (b, 2 c) without one of b stretches of the recording each."""
    blocks = np.array_split(np.arange(len(parts)), min(_BLOCKS, len(parts)))
    steps = []
    for block in blocks:
        less = normal - sum(parts[i].normal for i in block)
        steps.append(_constrained(less, right - sum(parts[i].right for i in block), told)[0])
    return np.stack(steps)


def _weights(residuals: Floats, noise: Floats) -> Floats:
    inverse = np.linalg.inv(noise)
    distance = np.sqrt(np.einsum("ni,nij,nj->n", residuals, inverse, residuals))
    return np.asarray(inverse * np.minimum(1.0, _HUBER / np.maximum(distance, 1e-9))[:, None, None])


def _constrained(normal: Floats, right: Floats, told: Bools) -> tuple[Floats, Floats]:
    """Solve for the parameters that are told, with offsets of zero mean (bordered system)."""
    size = len(right)
    step, covariance = np.zeros(size), np.diag(np.where(told, 0.0, np.inf))
    index = np.nonzero(told)[0]
    if not len(index):
        return step, covariance
    level = float(np.max(np.diag(normal)))
    border = np.where(index % 2 == 0, 1.0, 0.0)
    system = np.zeros((len(index) + 1, len(index) + 1))
    system[:-1, :-1] = normal[np.ix_(index, index)] / level
    # A weak prior (10 s) keeps a parameter that is all but invisible from exploding.
    system[:-1, :-1] += np.eye(len(index)) / (level * 100.0)
    system[-1, :-1] = system[:-1, -1] = border
    inverse = np.linalg.inv(system)
    step[index] = (inverse @ np.append(right[index] / level, 0.0))[:-1]
    covariance[np.ix_(index, index)] = inverse[:-1, :-1] / level
    return step, covariance
