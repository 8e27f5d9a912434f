"""Pose hypotheses from points where candidates' rays intersect, and their scores by agreement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.geometry import RigidTransform
from measure.model import Ball, Body, Camera, Detection, Rig
from measure.model.body import MIN_BREADTH_RATIO
from measure.model.projection import ray_rows

RADIUS_SD = 0.03  # Of an outline, as a share of it: light and paint move edges
SLACK_MM = 1.0  # Rays that pass this close always intersect: cameras are not quite simultaneous
_MIN_SQUARED_SINE = 1e-3  # Of the angle between two rays


class CandidateRays(NamedTuple):
    """Rays of n candidates."""

    cameras: Ints  # (n,) index of the camera
    origins: Floats  # (n, 3) in the world, mm
    directions: Floats  # (n, 3) in the world
    range_mm: Floats  # (n,) distance that the outline's radius implies
    angle_sd: Floats  # (n,) standard deviation of the ray's angle, rad


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates in all cameras, as arrays of n rows."""

    detections: tuple[Detection, ...]  # the n candidates
    pixels: Floats  # (n, 2)
    sd_px: Floats  # (n,) standard deviation of a coordinate
    rays: CandidateRays

    def __len__(self) -> int:
        return len(self.detections)

    def rows(self, index: Ints) -> Candidates:
        """Some of them."""
        return Candidates(
            tuple([self.detections[k] for k in index.tolist()]),
            self.pixels[index],
            self.sd_px[index],
            CandidateRays._make(column[index] for column in self.rays),
        )


@dataclass(frozen=True, eq=False)
class BallPoints:
    """Possible centres of one ball, as arrays of k rows."""

    points: Floats  # (k, 3) in the world, mm
    sd_mm: Floats  # (k,) standard deviation of a coordinate
    support: Ints  # (k,) number of cameras


def intersect_rays(
    candidates: Candidates, sigmas: float, range_ratio: float, max_points: int
) -> BallPoints:
    """Points where rays of two or more cameras intersect, at distances that fit outlines' sizes.

    Args:
        sigmas: rays intersect if they pass within this many standard deviations.
        range_ratio: largest error, as a factor, of the distance that an outline's size implies.
        max_points: keep this many, those that most cameras see.
    """
    rays = candidates.rays
    member = consistent_sets(rays, sigmas, range_ratio)
    weights = np.where(member, 1 / (rays.angle_sd * rays.range_mm) ** 2, 0.0)
    toward = np.nan_to_num(rays.directions)
    across = np.eye(3) - toward[:, :, None] * toward[:, None]
    covariance = np.linalg.inv(np.tensordot(weights, across, 1))
    right = weights @ np.einsum("nij,nj->ni", across, rays.origins)
    points = np.einsum("kij,kj->ki", covariance, right)
    sd, support = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3), member.sum(axis=1)
    order = np.argsort(-support, kind="stable")[:max_points]
    return BallPoints(points[order], sd[order], support[order])


def by_ball(
    detections: Mapping[str, Sequence[Detection]], balls: Sequence[Ball], cameras: Sequence[Camera]
) -> list[Candidates]:
    """The candidates of every ball, from detections by camera name."""
    seen = [(i, d) for i, c in enumerate(cameras) for d in detections.get(c.name, ())]
    numbers = np.array([i for i, _ in seen], dtype=np.int64)
    of_all = _candidates(tuple(d for _, d in seen), numbers, balls, Rig.of(cameras))
    names = [d.ball for d in of_all.detections]
    return [
        of_all.rows(np.array([k for k, name in enumerate(names) if name == ball.name], np.int64))
        for ball in balls
    ]


def _candidates(
    detections: tuple[Detection, ...], cameras: Ints, balls: Sequence[Ball], rig: Rig
) -> Candidates:
    """Stack detections whose cameras (n,) stand in the rig."""
    sizes = {ball.name: ball.radius_mm for ball in balls}
    radius_mm = np.array([sizes.get(d.ball, np.nan) for d in detections])
    radius_px = np.array([d.radius_px for d in detections])
    sd = np.sqrt(np.array([d.variance_px2 for d in detections]))
    pixels = np.array([d.center_px for d in detections]).reshape(-1, 2)
    views = rig.take(cameras)
    focal = views.focal_px
    rays = CandidateRays(
        cameras,
        views.centers,
        ray_rows(pixels, views.rows),
        radius_mm * np.sqrt(1 + (focal / radius_px) ** 2),
        sd / focal,
    )
    return Candidates(detections, pixels, sd, rays)


def consistent_sets(rays: CandidateRays, sigmas: float, range_ratio: float) -> Bools:
    """Sets of the n candidates that see a common point, from every two whose rays intersect.

    Returns:
        (k, n), each row different from the others: the two, and of each camera the nearest ray.
    """
    i, j = np.nonzero(rays.cameras[:, None] < rays.cameras)
    o1, d1, o2, d2 = rays.origins[i], rays.directions[i], rays.origins[j], rays.directions[j]
    cosine, depth1, depth2 = (
        np.einsum("pa,pa->p", a, b) for a, b in ((d1, d2), (o2 - o1, d1), (o2 - o1, d2))
    )
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    s, t = (depth1 - cosine * depth2) / sine2, (cosine * depth1 - depth2) / sine2
    one, other = o1 + s[:, None] * d1, o2 + t[:, None] * d2
    limit = sigmas * np.hypot(s * rays.angle_sd[i], t * rays.angle_sd[j]) + SLACK_MM
    meet = (sine2 > _MIN_SQUARED_SINE) & (s > 0) & (t > 0)
    meet &= np.linalg.norm(one - other, axis=1) < limit
    meet &= _in_range(s, rays.range_mm[i], range_ratio)
    meet &= _in_range(t, rays.range_mm[j], range_ratio)
    member = _nearest_of_each(((one + other) / 2)[meet], rays, sigmas, range_ratio)
    member[np.arange(len(member)), i[meet]] = member[np.arange(len(member)), j[meet]] = True
    _, first = np.unique(member, axis=0, return_index=True)
    return member[np.sort(first)]


def _in_range(distance: Floats, expected: Floats, ratio: float) -> Bools:
    return np.asarray((distance < expected * ratio) & (distance * ratio > expected))


def _nearest_of_each(
    points: Floats, rays: CandidateRays, sigmas: float, range_ratio: float
) -> Bools:
    """Which rays (k, n) pass points (k, 3): of each camera at most the nearest."""
    away, each = points[:, None] - rays.origins, np.arange(len(points))
    distance = np.linalg.norm(away, axis=2)
    off = np.linalg.norm(np.cross(away, rays.directions), axis=2)
    share = off / (sigmas * distance * rays.angle_sd + SLACK_MM)
    passes = (share < 1) & _in_range(distance, rays.range_mm, range_ratio)
    share, out = np.where(passes, share, np.inf), np.zeros(share.shape, np.bool_)
    for camera in np.unique(rays.cameras):
        own = np.flatnonzero(rays.cameras == camera)
        best = own[np.argmin(share[:, own], axis=1)]
        out[each, best] = passes[each, best]
    return out


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
