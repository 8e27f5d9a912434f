"""Pose hypotheses from possible ball centres, and their scores by the candidates that agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.compiling import compiled
from measure.geometry import RigidTransform
from measure.measuring.association.candidates import BallPoints, Candidates
from measure.model import Body, Camera, Rig
from measure.model.rig import RigRows
from measure.model.rig_kernels import project_one


class CandidateRows(NamedTuple):
    """The candidates of all balls as arrays of n rows, one ball's after the other's."""

    starts: Ints  # (balls + 1,) first row of each ball's
    cameras: Ints  # (n,) index of the camera
    pixels: Floats  # (n, 2)
    limit_px: Floats  # (n,) the furthest that a candidate may be from where a pose puts its ball
    range_mm: Floats  # (n,) distance that the outline's radius implies


@compiled
def agreement(
    rotations: Floats,
    translations: Floats,
    centers_body: Floats,
    rig: RigRows,
    corners: Floats,
    candidates: CandidateRows,
    range_ratio: float,
) -> tuple[Ints, Ints, Floats]:
    """Compare the balls of m poses, projected, with the candidates by place and size.

    Args:
        rotations: (m, 3, 3) of world_from_body.
        translations: (m, 3).
        centers_body: (balls, 3).
        corners: (cameras, 2) last pixel of each picture.
        candidates: n of them.
        range_ratio: largest error, as a factor, of the distance that an outline's size implies.

    Returns:
        Row of the agreeing candidate among those of its ball, or -1 (m, balls, cameras); number of
        balls in view, over all cameras (m,); score (m,), see `hypotheses.PoseScores`.
    """
    m, balls, views = len(rotations), len(centers_body), len(rig.lenses)
    starts, cameras, pixels, limit_px, range_mm = candidates
    chosen = np.full((m, balls, views), -1)
    expected, score = np.zeros(m, np.int64), np.zeros(m)
    center, pixel, by_point = np.empty(3), np.empty(2), np.empty((2, 3))
    for row in range(m):
        for camera in range(views):
            for ball in range(balls):
                away2 = 0.0
                for a in range(3):
                    center[a] = translations[row, a]
                    for b in range(3):
                        center[a] += rotations[row, a, b] * centers_body[ball, b]
                    away2 += (center[a] - rig.centers[camera, a]) ** 2
                project_one(rig, camera, center, pixel, by_point)
                u, v = pixel[0], pixel[1]
                if u >= 0 and v >= 0 and u <= corners[camera, 0] and v <= corners[camera, 1]:
                    expected[row] += 1
                away, least = np.sqrt(away2), 1.0
                for k in range(starts[ball], starts[ball + 1]):
                    expected_mm = range_mm[k]
                    if cameras[k] != camera:
                        continue
                    if away > expected_mm * range_ratio or expected_mm > away * range_ratio:
                        continue
                    share = np.hypot(u - pixels[k, 0], v - pixels[k, 1]) / limit_px[k]
                    if share < least:
                        least = share
                        chosen[row, ball, camera] = k - starts[ball]
                if least < 1:
                    score[row] += 1 - least**2
    return chosen, expected, score


_MAX_TRIPLES = 400
_MAX_PAIRS = 20
_SLACK_MM = 1.0
_MIN_SPREAD_RATIO = 0.05  # Second to first singular value of three balls that are not on a line
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

    For a body of which no two cameras see a third ball: one camera's view of it decides.
    """
    found = []
    for pair in combinations(range(len(body.balls)), 2):
        rows = _consistent_pairs(body, points, pair, sigmas)
        found.append(
            _rotated_about_line(_chosen_points(points, pair, rows), body.centers[list(pair)])
        )
    return _joined(found)


def stack_candidates(
    candidates: Sequence[Candidates], sigmas: float, extra_px: float
) -> CandidateRows:
    """Stack the candidates of every ball, with gates of `sigmas` standard deviations."""
    sd_px = np.concatenate([c.sd_px for c in candidates])
    return CandidateRows(
        np.cumsum([0, *map(len, candidates)]),
        np.concatenate([c.rays.cameras for c in candidates]),
        np.concatenate([c.pixels for c in candidates]),
        sigmas * np.hypot(sd_px, extra_px),
        np.concatenate([c.rays.range_mm for c in candidates]),
    )


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
    candidates: CandidateRows,
    range_ratio: float,
) -> PoseScores:
    """Compare the balls of m poses, projected, with the candidates by place and size."""
    rig = Rig.of(cameras)
    return PoseScores(
        *agreement(
            np.ascontiguousarray(poses.rotation),
            np.ascontiguousarray(poses.translation),
            body.centers,
            rig.rows,
            np.array([c.intrinsics.size_wh for c in cameras]) - 1.0,
            candidates,
            range_ratio,
        )
    )


def lie_on_body(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    seen_by: Ints,
    pixels: Floats,
) -> Bools:
    """Whether each of n candidates (n,) lies on some ball of the body in its pose.

    Args:
        seen_by: (n,) index of the candidates' cameras.
        pixels: (n, 2).
    """
    views, out = Rig.of(cameras).take(seen_by), np.zeros(len(pixels), np.bool_)
    for center, radius in zip(world_from_body.apply(body.centers), body.radii, strict=True):
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
    limit = sigmas * np.hypot(a.sd_mm[:, None], b.sd_mm[None]) + _SLACK_MM
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
    return bool(spread[1] < _MIN_SPREAD_RATIO * spread[0])


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
