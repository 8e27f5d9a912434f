"""Pose hypotheses from possible ball centres, and their scores by the candidates that agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.geometry import RigidTransform
from measure.measuring.association.candidates import SLACK_MM, BallPoints, Candidates
from measure.model import Body, Camera, Rig
from measure.model.body import MIN_BREADTH_RATIO

_MAX_TRIPLES = 400
_MAX_PAIRS = 20
_ANGLES = 90
_INSIDE_RADII = 0.8
"""Candidates within this many radii of a ball of the body belong to it, whatever their colour: a
reflection, a duplicate, the pink side of a magenta ball. Where a ball hides another one, other
cameras see both."""


def poses_from_triples(body: Body, points: Sequence[BallPoints], sigmas: float) -> RigidTransform:
    """Poses (m) of every three balls whose possible centres are as far apart as in the body."""
    found = []
    for triple in _triples(body):
        rows = _consistent_triples(body, points, triple, sigmas)
        found.append(
            align_triangles(_chosen_points(points, triple, rows), body.centers[list(triple)])
        )
    return _joined(found)


def poses_from_pairs(body: Body, points: Sequence[BallPoints], sigmas: float) -> RigidTransform:
    """Poses (m) of every two balls at the right distance, rotated about their line in steps.

    For a body whose third ball no two cameras see: one camera's view of it decides.
    """
    found = []
    for pair in combinations(range(len(body.balls)), 2):
        rows = _consistent_pairs(body, points, pair, sigmas)
        found.append(
            _rotated_about_line(_chosen_points(points, pair, rows), body.centers[list(pair)])
        )
    return _joined(found)


@dataclass(frozen=True, eq=False)
class PoseScores:
    """Agreement of candidates with m poses."""

    chosen: Ints  # (m, balls, cameras) row of the agreeing candidate of that ball, or -1
    expected: Ints  # (m,) number of balls in view, over all cameras
    score: Floats  # (m,) sum over agreeing candidates of 1 - (distance / gate)^2

    @property
    def count(self) -> Ints:
        """Number of agreeing candidates (m,)."""
        return np.asarray(np.sum(self.chosen >= 0, axis=(1, 2)), dtype=np.int64)


def score_poses(
    poses: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    candidates: Sequence[Candidates],
    limits_px: Sequence[Floats],
    range_ratio: float,
) -> PoseScores:
    """Compare the balls of m poses, projected, with the candidates by place and size.

    Args:
        candidates: of every ball.
        limits_px: (n,) of each ball's, how far one may be from where a pose puts the ball.
        range_ratio: largest error, as a factor, of the distance that an outline's size implies.
    """
    centers = centers_of(body, poses)
    m = len(centers)
    chosen, every = np.full((m, len(candidates), len(cameras)), -1), np.arange(m)
    expected, score = np.zeros(m, np.int64), np.zeros(m)
    for c, camera in enumerate(cameras):
        pixels = camera.project(centers.reshape(-1, 3)).reshape(m, -1, 2)
        expected += camera.intrinsics.contains(pixels).sum(axis=1)
        away = np.linalg.norm(centers - camera.center, axis=2)
        for ball, (some, limit_px) in enumerate(zip(candidates, limits_px, strict=True)):
            rows = np.flatnonzero(some.rays.cameras == c)
            if not len(rows):
                continue
            error = np.abs(np.log(some.rays.range_mm[rows] / away[:, ball, None]))
            off = np.linalg.norm(pixels[:, ball, None] - some.pixels[rows], axis=2)
            share = off / limit_px[rows]
            share = np.where((share < 1) & (error <= np.log(range_ratio)), share, 1.0)
            best = np.argmin(share, axis=1)
            least = share[every, best]
            chosen[least < 1, ball, c] = rows[best[least < 1]]
            score += 1 - least**2
    return PoseScores(chosen, expected, score)


def centers_of(body: Body, poses: RigidTransform) -> Floats:
    """The balls' centres (m, balls, 3) in the world, by m poses."""
    return body.centers @ np.swapaxes(poses.rotation, 1, 2) + poses.translation[:, None]


def lie_on_body(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    seen_by: Ints,
    pixels: Floats,
) -> Bools:
    """`lie_on_balls` for the balls of the body in its pose."""
    centers = world_from_body.apply(body.centers)
    return lie_on_balls(centers, body.radii, cameras, seen_by, pixels)


def lie_on_balls(
    centers: Floats, radii: Floats, cameras: Sequence[Camera], seen_by: Ints, pixels: Floats
) -> Bools:
    """Whether each of n candidates (n,) lies on one of k balls.

    Args:
        centers: (k, 3) in the world, mm.
        radii: (k,) mm.
        seen_by: (n,) index of the candidates' cameras.
        pixels: (n, 2).
    """
    views, out = Rig.of(cameras).take(seen_by), np.zeros(len(pixels), np.bool_)
    for center, radius in zip(centers, radii, strict=True):
        off = np.linalg.norm(pixels - views.project(center)[0], axis=1)
        away = np.linalg.norm(views.centers - center, axis=1)
        out |= off < _INSIDE_RADII * views.focal_px * radius / away
    return out


def _chosen_points(points: Sequence[BallPoints], balls: Sequence[int], rows: Ints) -> Floats:
    """Possible centres (m, balls, 3) of some balls, from their rows (m, balls) of `points`."""
    out = np.empty((*rows.shape, 3))
    for k, ball in enumerate(balls):
        out[:, k] = points[ball].points[rows[:, k]]
    return out


def align_triangles(target: Floats, source: Floats) -> RigidTransform:
    """Least-squares poses (m) that put three source points (3, 3) on target points (m, 3, 3).

    In closed form (Umeyama 1991), as `geometry.align_points` for a single pose.
    """
    middle, origin = target.mean(axis=1), source.mean(axis=0)
    u, _, vt = np.linalg.svd(np.swapaxes(target - middle[:, None], 1, 2) @ (source - origin))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotation = u @ vt
    return RigidTransform(rotation, middle - rotation @ origin)


def _misfits(body: Body, points: Sequence[BallPoints], i: int, j: int, sigmas: float) -> Floats:
    """Deviation (n, m) of two balls' distances from the body's, as a multiple of its limit."""
    a, b = points[i], points[j]
    expected_mm = np.linalg.norm(body.centers[i] - body.centers[j])
    distances = np.linalg.norm(a.points[:, None] - b.points[None], axis=2)
    limit = sigmas * np.hypot(a.sd_mm[:, None], b.sd_mm[None]) + SLACK_MM
    return np.asarray(np.abs(distances - expected_mm) / limit, dtype=np.float64)


def _consistent_pairs(
    body: Body, points: Sequence[BallPoints], pair: tuple[int, int], sigmas: float
) -> Ints:
    """Rows of `points` (m, 2), one per ball, as far apart as in the body; best first."""
    misfit = _misfits(body, points, *pair, sigmas)
    rows = np.argwhere(misfit < 1)
    order = np.argsort(misfit[tuple(rows.T)], kind="stable")[:_MAX_PAIRS]
    return np.asarray(rows[order], dtype=np.int64)


def _consistent_triples(
    body: Body, points: Sequence[BallPoints], triple: tuple[int, int, int], sigmas: float
) -> Ints:
    """Rows of `points` (m, 3), one per ball, whose distances are the body's; best first."""
    first, outer, last = (_misfits(body, points, i, j, sigmas) for i, j in combinations(triple, 2))
    i, j = np.nonzero(first < 1)
    worst = np.maximum(np.maximum(first[i, j, None], outer[i]), last[j])
    row, k = np.nonzero(worst < 1)
    order = np.argsort(worst[row, k], kind="stable")[:_MAX_TRIPLES]
    return np.stack([i[row], j[row], k], axis=1)[order]


@lru_cache(maxsize=16)
def _triples(body: Body) -> tuple[tuple[int, int, int], ...]:
    """Every three balls that are not on a line; bodies compare by identity."""
    triples = combinations(range(len(body.balls)), 3)
    return tuple(three for three in triples if not _on_a_line(body.centers[list(three)]))


def _on_a_line(points: Floats) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < MIN_BREADTH_RATIO * spread[0])


def _rotated_about_line(target: Floats, source: Floats) -> RigidTransform:
    """Poses that bring the line of two source points (2, 3) onto (m, 2, 3), at every angle."""
    start = align_triangles(
        np.concatenate([target, _perpendicular_point(target)], axis=1),
        np.concatenate([source, _perpendicular_point(source[None])[0]], axis=0),
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


def _perpendicular_point(pair: Floats) -> Floats:
    """A point (m, 1, 3) at right angles from the midpoint of two points (m, 2, 3)."""
    line = pair[:, 1] - pair[:, 0]
    helper = np.eye(3)[np.argmin(np.abs(line), axis=1)]
    across = np.cross(line, helper)
    length = np.linalg.norm(line, axis=1, keepdims=True)
    across *= length / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    return (pair.mean(axis=1) + across)[:, None]


def _joined(poses: Sequence[RigidTransform]) -> RigidTransform:
    if len(poses) == 1:
        return poses[0]
    return RigidTransform(
        np.concatenate([np.zeros((0, 3, 3)), *(p.rotation for p in poses)]),
        np.concatenate([np.zeros((0, 3)), *(p.translation for p in poses)]),
    )
