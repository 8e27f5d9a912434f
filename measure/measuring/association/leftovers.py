"""Signs of a second body among the candidates that the body found does not explain.

A second body that is mostly hidden has no three located balls, so it never competes as a pose of
its own; and if it was the one to be measured, the pose found is of the wrong body. What gives it
away is balls of different kinds as far apart as in the body. A lone ball is no such sign: that
may be any ball of the colour.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, permutations

import numpy as np

from measure.arrays import Bools, Floats
from measure.geometry import RigidTransform
from measure.measuring.association.points import BallPoints, Candidates, by_ball, meeting_points
from measure.model import Body, Camera, Detection, Rig

_OWN_RADII = 0.8
"""Candidates within this many radii of the body's own ball belong to it: a reflection, a double."""
_SIZE_RATIO = 1.15
"""How far the outline of a ball that is really there misleads about its distance, as a factor."""
_RANGE_SD, _RANGE_SIGMAS = 0.03, 2.5
_HALF_SEEN_RATIO = 1.2
_SLACK_MM = 1.0
_HALF_SEEN_MM = 5.0
"""A mostly hidden ball's outline takes in the edge of what hides it, and leads this far astray."""
_MOST_POINTS = 12


def signs_of_another(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
    sigmas: float,
) -> tuple[str, ...]:
    """A line if some balls that are none of the body found are as far apart as in the body.

    Two will do if two cameras locate one of them; else three, whose sizes tell how far away they
    are.

    Args:
        world_from_body: the pose found.
        body: the body.
        cameras: all cameras.
        detections: candidates by camera name.
        sigmas: distances fit within this many standard deviations.
    """
    left = _unexplained(world_from_body, body, cameras, detections)
    if len({d.ball for some in left.values() for d in some}) < 2:
        return ()
    candidates = by_ball(left, body.balls, cameras)
    located = [meeting_points(c, sigmas, _SIZE_RATIO, _MOST_POINTS) for c in candidates]
    distances = np.linalg.norm(body.centers[:, None] - body.centers[None], axis=2)
    for balls, where in _signs(candidates, located, distances, sigmas):
        if where is not None:
            return (_said([body.names[k] for k in balls], where),)
    return ()


def _signs(
    candidates: Sequence[Candidates],
    located: Sequence[BallPoints],
    distances_mm: Floats,
    sigmas: float,
) -> Iterator[tuple[tuple[int, ...], Floats | None]]:
    """Which balls were looked at, and where they are (3,) if they fit; the surest sign first."""
    balls = range(len(candidates))
    for i, j in combinations(balls, 2):
        yield (i, j), _pair(located[i], located[j], float(distances_mm[i, j]), sigmas)
    for i, j in permutations(balls, 2):
        distance = float(distances_mm[i, j])
        yield (i, j), _with_one_view(located[i], candidates[j], distance, sigmas)
    for three in combinations(balls, 3):
        some = [candidates[k] for k in three]
        yield three, _by_sizes(some, distances_mm[np.ix_(three, three)])


def _unexplained(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
) -> dict[str, list[Detection]]:
    """Candidates that do not lie on a ball of the body found."""
    centers = world_from_body.apply(body.centers)
    alike = {a.name: np.array([a.color == b.color for b in body.balls]) for a in body.balls}
    rig, balls = Rig.of(cameras), len(body.balls)
    everywhere = rig.take(np.repeat(np.arange(len(rig)), balls))
    pixels = everywhere.project(np.tile(centers, (len(rig), 1)))[0].reshape(-1, balls, 2)
    away = np.linalg.norm(centers - rig.centers[:, None], axis=2)
    reach = _OWN_RADII * rig.focal_px[:, None] * body.radii / away
    out = {}
    for number, camera in enumerate(cameras):
        seen = detections.get(camera.name, ())
        places = np.array([d.center_px for d in seen]).reshape(-1, 1, 2)
        near = np.linalg.norm(places - pixels[number], axis=2) < reach[number]
        out[camera.name] = [
            d for d, close in zip(seen, near, strict=True) if not np.any(close & alike[d.ball])
        ]
    return out


def _pair(a: BallPoints, b: BallPoints, distance_mm: float, sigmas: float) -> Floats | None:
    """The middle (3,) of two located points that are `distance_mm` apart, if there are such."""
    apart = np.linalg.norm(a.points[:, None] - b.points[None], axis=2)
    limit = sigmas * np.hypot(a.sd_mm[:, None], b.sd_mm[None]) + _SLACK_MM
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
    to_point = a.points[:, None] - b.origins
    along = np.einsum("kni,ni->kn", to_point, b.directions)
    off = np.linalg.norm(to_point - along[:, :, None] * b.directions, axis=2)
    slack = sigmas * np.hypot(a.sd_mm[:, None], b.angle_sd * b.range_mm) + _HALF_SEEN_MM
    half = np.sqrt(np.maximum(distance_mm**2 - off**2, 0.0))
    fits = _as_far(along - half, b.range_mm) | _as_far(along + half, b.range_mm)
    rows, _ = np.nonzero((off < distance_mm + slack) & fits)
    return a.points[rows[0]] if len(rows) else None


def _by_sizes(three: Sequence[Candidates], distances_mm: Floats) -> Floats | None:
    """The middle (3,) of three candidates that may be three of the body's balls.

    Their sizes tell how far away they are, give or take a few percent.
    """
    along = [c.range_mm[:, None] * c.directions for c in three]
    points = [c.origins + a for c, a in zip(three, along, strict=True)]
    fits = np.ones(tuple(len(c) for c in three), np.bool_)
    for i, j in combinations(range(3), 2):
        between = points[i][:, None] - points[j][None]
        apart = np.linalg.norm(between, axis=2)
        by_range = np.hypot(
            np.sum(between * along[i][:, None], axis=2), np.sum(between * along[j][None], axis=2)
        )
        limit = _RANGE_SIGMAS * _RANGE_SD * by_range / np.maximum(apart, 1e-9) + _SLACK_MM
        shape = [1, 1, 1]
        shape[i], shape[j] = apart.shape
        fits &= (np.abs(apart - distances_mm[i, j]) < limit).reshape(shape)
    found = np.argwhere(fits)
    if not len(found):
        return None
    return np.mean([p[k] for p, k in zip(points, found[0], strict=True)], axis=0)


def _as_far(distance: Floats, told: Floats) -> Bools:
    return np.asarray((distance < told * _HALF_SEEN_RATIO) & (distance > told / _HALF_SEEN_RATIO))


def _said(names: Sequence[str], where: Floats) -> str:
    x, y, z = where
    return (
        f"there may be a second body near ({x:.0f}, {y:.0f}, {z:.0f}) mm, with balls like "
        f"{', '.join(names[:-1])} and {names[-1]}: take it out of view"
    )
