"""Evidence of a second body among the candidates that the body found does not explain.

A mostly hidden second body has no three located balls and is never found as a rival pose; if it is
the one to be measured, the pose found is of the wrong body. Evidence is balls of different kinds as
far apart as in the body. A single ball is none: it may be any ball of that colour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.geometry import RigidTransform
from measure.measuring.pose_hypotheses import (
    RADIUS_SD,
    SLACK_MM,
    BallPoints,
    Candidates,
    intersect_rays,
    lie_on_body,
)
from measure.model import Body, Camera, Doubt

_RANGE_RATIO = 1.15
"""Largest error, as a factor, of the distance that the outline of a real ball implies."""
_RANGE_SIGMAS, _RANGE_STEPS = 2.5, 9
_RANGE_FACTORS = 1 + np.linspace(
    -_RANGE_SIGMAS * RADIUS_SD, _RANGE_SIGMAS * RADIUS_SD, _RANGE_STEPS
)
"""Relative distances at which a ball may be, given the error of its size."""
_OCCLUDED_SLACK_MM = 5.0
"""A partly hidden ball's outline includes an edge of its occluder, which displaces its centre."""
_MAX_POINTS_PER_BALL = 12


def second_body_flags(
    body: Body, candidates: Sequence[Candidates], sigmas: float
) -> tuple[str, ...]:
    """A flag if balls that do not belong to the body found are as far apart as in the body.

    Two suffice if two cameras locate one of them or one camera sees both well; otherwise three,
    whose sizes give their distances.

    Args:
        candidates: of every ball, those that do not lie on the body, nor on its mirror image.
        sigmas: distances fit within this many standard deviations.
    """
    if sum(len(some) > 0 for some in candidates) < 2:
        return ()
    located = [intersect_rays(c, sigmas, _RANGE_RATIO, _MAX_POINTS_PER_BALL) for c in candidates]
    distances = np.linalg.norm(body.centers[:, None] - body.centers[None], axis=2)
    for balls, where in _evidence(candidates, located, distances, sigmas):
        if where is not None:
            x, y, z = where
            names = [body.names[k] for k in balls]
            return (Doubt("second-body", x_mm=x, y_mm=y, z_mm=z, balls=names),)
    return ()


def _evidence(
    candidates: Sequence[Candidates],
    located: Sequence[BallPoints],
    distances_mm: Floats,
    sigmas: float,
) -> Iterator[tuple[tuple[int, ...], Floats | None]]:
    """Combinations of balls and their place (3,), or None; the strongest evidence first."""
    balls = range(len(candidates))
    for i, j in combinations(balls, 2):
        yield (i, j), _pair(located[i], located[j], float(distances_mm[i, j]), sigmas)
    for i, j in permutations(balls, 2):
        distance = float(distances_mm[i, j])
        yield (i, j), _with_one_view(located[i], candidates[j], distance, sigmas)
    lone = [_seen_once(c, p, sigmas) for c, p in zip(candidates, located, strict=True)]
    places = [_possible_places(c) for c in lone]
    fits = {
        (i, j): possible_distances(places[i], places[j], float(distances_mm[i, j]), SLACK_MM)
        for i, j in combinations(balls, 2)
    }
    for three in combinations(balls, 3):
        one, two, other = (fits[pair] for pair in combinations(three, 2))
        yield three, _by_sizes([lone[k] for k in three], one, two, other)
    for i, j in combinations(balls, 2):
        yield (i, j), _side_by_side(lone[i], lone[j], fits[i, j])


def possible_distances(a: Floats, b: Floats, distance_mm: float, slack_mm: float) -> Bools:
    """Whether (n, m) points, each at one of s places (n, s, 3), (m, s, 3), may be so far apart."""
    apart = np.linalg.norm(a[:, None, :, None] - b[None, :, None], axis=-1)
    near, far = apart.min(axis=(2, 3)), apart.max(axis=(2, 3))
    return np.asarray((near < distance_mm + slack_mm) & (distance_mm < far + slack_mm))


def _seen_once(candidates: Candidates, located: BallPoints, sigmas: float) -> Candidates:
    """Candidates that no located point explains: their distances are known from sizes only."""
    if not len(candidates) or not len(located.points):
        return candidates
    to_point = located.points[:, None] - candidates.rays.origins
    depth = np.einsum("kni,ni->kn", to_point, candidates.rays.directions)
    off = np.linalg.norm(to_point - depth[:, :, None] * candidates.rays.directions, axis=2)
    limit = sigmas * np.hypot(located.sd_mm[:, None], candidates.rays.angle_sd * depth) + SLACK_MM
    shared = np.any((off < limit) & _size_agrees(depth, candidates.rays.range_mm), axis=0)
    return candidates.rows(np.nonzero(~shared)[0])


def unexplained(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    candidates: Sequence[Candidates],
) -> list[Candidates]:
    """Candidates of every ball that do not lie on a ball of the body found."""
    own = lie_on_body(
        world_from_body,
        body,
        cameras,
        np.concatenate([some.rays.cameras for some in candidates]),
        np.concatenate([some.pixels for some in candidates]),
    )
    ends = np.cumsum([len(some) for some in candidates]).tolist()
    return [
        some.rows(np.nonzero(~own[end - len(some) : end])[0])
        for some, end in zip(candidates, ends, strict=True)
    ]


def _pair(a: BallPoints, b: BallPoints, distance_mm: float, sigmas: float) -> Floats | None:
    """The midpoint (3,) of two located points that are `distance_mm` apart; None without such."""
    if not len(a.points) or not len(b.points):
        return None
    apart = np.linalg.norm(a.points[:, None] - b.points[None], axis=2)
    limit = sigmas * np.hypot(a.sd_mm[:, None], b.sd_mm[None]) + SLACK_MM
    rows, columns = np.nonzero(np.abs(apart - distance_mm) < limit)
    if not len(rows):
        return None
    return np.asarray(a.points[rows[0]] + b.points[columns[0]], dtype=np.float64) / 2


def _with_one_view(
    a: BallPoints, b: Candidates, distance_mm: float, sigmas: float
) -> Floats | None:
    """A located point (3,) from which the ball of some candidate may be `distance_mm` away."""
    if not len(a.points) or not len(b):
        return None
    to_point = a.points[:, None] - b.rays.origins
    depth = np.einsum("kni,ni->kn", to_point, b.rays.directions)
    off = np.linalg.norm(to_point - depth[:, :, None] * b.rays.directions, axis=2)
    slack = (
        sigmas * np.hypot(a.sd_mm[:, None], b.rays.angle_sd * b.rays.range_mm) + _OCCLUDED_SLACK_MM
    )
    half = np.sqrt(np.maximum(distance_mm**2 - off**2, 0.0))
    fits = _size_agrees(depth - half, b.rays.range_mm) | _size_agrees(depth + half, b.rays.range_mm)
    rows, _ = np.nonzero((off < distance_mm + slack) & fits)
    return a.points[rows[0]] if len(rows) else None


def _by_sizes(
    some: Sequence[Candidates], first_two: Bools, outer_two: Bools, last_two: Bools
) -> Floats | None:
    """The mean (3,) of three candidates, one of each kind, as far apart as in the body.

    Their distances from the cameras come from their sizes, to a few percent.

    Args:
        some: candidates of three kinds: n, m and k.
        first_two: (n, m) which of them may be as far apart as in the body.
        outer_two: (n, k) the same.
        last_two: (m, k) the same.
    """
    if not (first_two.any() and outer_two.any() and last_two.any()):
        return None
    found = np.argwhere(first_two[:, :, None] & outer_two[:, None, :] & last_two[None])
    return _middle(some, found[0]) if len(found) else None


def _side_by_side(first: Candidates, second: Candidates, fits: Bools) -> Floats | None:
    """The same for two candidates that one camera sees well: their separation is well known."""
    if not fits.any():
        return None
    same_camera = fits & (first.rays.cameras[:, None] == second.rays.cameras)
    if not same_camera.any():
        return None
    found = np.argwhere(same_camera & _well_seen(first)[:, None] & _well_seen(second))
    return _middle([first, second], found[0]) if len(found) else None


def _well_seen(candidates: Candidates) -> Bools:
    """Candidates (n,) whose relative radius error is below `RADIUS_SD`."""
    radius = [d.radius_px for d in candidates.detections]
    return np.asarray(candidates.sd_px < RADIUS_SD * np.array(radius))


def _middle(some: Sequence[Candidates], rows: Ints) -> Floats:
    """The mean (3,) of the places of candidates, one of each kind, by their sizes."""
    points = [
        c.rays.origins[k] + c.rays.range_mm[k] * c.rays.directions[k]
        for c, k in zip(some, rows, strict=True)
    ]
    return np.asarray(np.mean(points, axis=0))


def _possible_places(candidates: Candidates) -> Floats:
    """Places (n, steps, 3) where the balls may be, given the errors of their sizes."""
    lengths = candidates.rays.range_mm[:, None] * _RANGE_FACTORS
    return (
        candidates.rays.origins[:, None] + lengths[:, :, None] * candidates.rays.directions[:, None]
    )


def _size_agrees(distance: Floats, range_mm: Floats) -> Bools:
    return np.asarray((distance < range_mm * _RANGE_RATIO) & (distance > range_mm / _RANGE_RATIO))
