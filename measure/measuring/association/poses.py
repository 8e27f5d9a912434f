"""Poses that put the body's balls on possible ball centres, and how many candidates agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from measure.arrays import Floats, Ints
from measure.geometry import RigidTransform
from measure.measuring.association.points import BallPoints, Candidates
from measure.model import Body, Camera, Rig

_MOST_POSES = 400
_SLACK_MM = 1.0
_LINE_RATIO = 0.05
_ANGLES = 90


def poses_from_triples(body: Body, points: Sequence[BallPoints], sigmas: float) -> RigidTransform:
    """Poses (m) of every three balls whose possible centres are as far apart as in the body."""
    found = []
    for triple in combinations(range(len(body.balls)), 3):
        if _on_a_line(body.centers[list(triple)]):
            continue
        rows = _fitting_rows(body, points, triple, sigmas)
        target = np.stack([points[b].points[rows[:, k]] for k, b in enumerate(triple)], axis=1)
        found.append(align_batch(target, body.centers[list(triple)]))
    return _joined(found)


def poses_from_pairs(body: Body, points: Sequence[BallPoints], sigmas: float) -> RigidTransform:
    """Poses (m) of every two balls at the right distance, turned about their line in steps.

    For a body of which no third ball is seen by two cameras: one camera's view of it decides.
    """
    found = []
    for pair in combinations(range(len(body.balls)), 2):
        rows = _fitting_rows(body, points, pair, sigmas)[:20]
        target = np.stack([points[b].points[rows[:, k]] for k, b in enumerate(pair)], axis=1)
        found.append(_spun(target, body.centers[list(pair)]))
    return _joined(found)


def align_batch(target: Floats, source: Floats) -> RigidTransform:
    """Least-squares poses (m) of points (m, k, 3) on the same source points (k, 3)."""
    centre, origin = target.mean(axis=1), source.mean(axis=0)
    u, _, vt = np.linalg.svd(np.swapaxes(target - centre[:, None], 1, 2) @ (source - origin))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    rotation = u @ vt
    return RigidTransform(rotation, centre - rotation @ origin)


@dataclass(frozen=True, eq=False)
class Support:
    """Which candidates agree with m poses.

    Attributes:
        chosen: (m, balls, cameras) row of the agreeing candidate of that ball, or -1.
        expected: (m,) number of balls in view, over all cameras.
        score: (m,) sum over agreeing candidates of one minus the squared share of the gate.
    """

    chosen: Ints
    expected: Ints
    score: Floats

    @property
    def count(self) -> Ints:
        """Number of agreeing candidates (m,)."""
        return np.asarray(np.sum(self.chosen >= 0, axis=(1, 2)), dtype=np.int64)


def support(
    poses: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    candidates: Sequence[Candidates],
    sigmas: float,
    extra_px: float,
    range_ratio: float,
) -> Support:
    """Compare the balls of m poses, projected, with the candidates: in place and in size."""
    m = len(poses.translation)
    centers = np.einsum("mij,kj->mki", poses.rotation, body.centers) + poses.translation[:, None]
    everywhere = _projected(centers.reshape(-1, 3), cameras)
    chosen = np.full((m, len(body.balls), len(cameras)), -1, np.int64)
    expected, score = np.zeros(m, np.int64), np.zeros(m)
    for number, camera in enumerate(cameras):
        pixels = everywhere[number].reshape(m, len(body.balls), 2)
        distances = np.linalg.norm(centers - camera.center, axis=2)
        expected += camera.intrinsics.contains(pixels).sum(axis=1)
        for ball, candidate in enumerate(candidates):
            rows = np.nonzero(candidate.cameras == number)[0]
            if not len(rows):
                continue
            off = np.linalg.norm(pixels[:, ball, None] - candidate.pixels[rows], axis=2)
            share = np.nan_to_num(off, nan=1e9) / (
                sigmas * np.hypot(candidate.sd_px[rows], extra_px)
            )
            told = candidate.range_mm[rows]
            away = distances[:, ball, None]
            share[(away > told * range_ratio) | (told > away * range_ratio)] = np.inf
            best = np.argmin(share, axis=1)
            least = share[np.arange(m), best]
            agrees = least < 1
            chosen[agrees, ball, number] = rows[best[agrees]]
            score += np.where(agrees, 1 - least**2, 0.0)
    return Support(chosen, expected, score)


def _projected(points: Floats, cameras: Sequence[Camera]) -> Floats:
    """Pixels (cameras, n, 2) of points (n, 3), all cameras in one go."""
    rig = Rig.of(cameras).take(np.repeat(np.arange(len(cameras)), len(points)))
    pixels, _ = rig.project(np.tile(points, (len(cameras), 1)))
    return pixels.reshape(len(cameras), len(points), 2)


def _fitting_rows(
    body: Body, points: Sequence[BallPoints], balls: Sequence[int], sigmas: float
) -> Ints:
    """Rows of `points` (m, k), one per ball, whose mutual distances are the body's; best first."""
    misfit = np.zeros(tuple(len(points[b].points) for b in balls))
    for i, j in combinations(range(len(balls)), 2):
        a, b = points[balls[i]], points[balls[j]]
        apart = np.linalg.norm(a.points[:, None] - b.points[None], axis=2)
        expected = np.linalg.norm(body.centers[balls[i]] - body.centers[balls[j]])
        limit = sigmas * np.hypot(a.sd_mm[:, None], b.sd_mm[None]) + _SLACK_MM
        share = np.abs(apart - expected) / limit
        shape = [1] * len(balls)
        shape[i], shape[j] = share.shape
        misfit = np.maximum(misfit, share.reshape(shape))
    rows = np.argwhere(misfit < 1)
    order = np.argsort(misfit[tuple(rows.T)], kind="stable")[:_MOST_POSES]
    return np.asarray(rows[order], dtype=np.int64)


def _on_a_line(points: Floats) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < _LINE_RATIO * spread[0])


def _spun(target: Floats, source: Floats) -> RigidTransform:
    """Poses that bring the line of two source points (2, 3) onto (m, 2, 3), at every angle."""
    start = align_batch(
        np.concatenate([target, _third(target)], axis=1),
        np.concatenate([source, _third(source[None])[0]], axis=0),
    )
    axis = target[:, 1] - target[:, 0]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    angles = np.arange(_ANGLES) * (2 * np.pi / _ANGLES)
    turns = RigidTransform.from_rotvec(
        axis[:, None] * angles[:, None], np.zeros((len(axis), _ANGLES, 3))
    ).rotation
    rotation = turns @ start.rotation[:, None]
    middle_body = source.mean(axis=0)
    translation = target.mean(axis=1)[:, None] - rotation @ middle_body
    return RigidTransform(rotation.reshape(-1, 3, 3), translation.reshape(-1, 3))


def _third(pair: Floats) -> Floats:
    """A point (m, 1, 3) off the line of two points (m, 2, 3), at right angles from their middle."""
    along = pair[:, 1] - pair[:, 0]
    helper = np.eye(3)[np.argmin(np.abs(along), axis=1)]
    across = np.cross(along, helper)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    across *= length / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    return (pair.mean(axis=1) + across)[:, None]


def _joined(poses: Sequence[RigidTransform]) -> RigidTransform:
    return RigidTransform(
        np.concatenate([np.zeros((0, 3, 3)), *(p.rotation for p in poses)]),
        np.concatenate([np.zeros((0, 3)), *(p.translation for p in poses)]),
    )
