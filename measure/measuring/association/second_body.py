"""Signs of a second body among the candidates that the body found does not explain.

A second body that is mostly hidden has no three located balls, so it never competes as a pose of
its own; and if it was the one to be measured, the pose found is of the wrong body. What gives it
away is balls of different kinds as far apart as in the body. A lone ball is no such sign: that
may be any ball of the colour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.geometry import RigidTransform
from measure.measuring.association.candidates import BallPoints, Candidates, meeting_points
from measure.measuring.association.hypotheses import explained
from measure.measuring.association.scoring import fitting_ranges
from measure.model import Body, Camera

_SIZE_RATIO = 1.15
"""How far the outline of a ball that is really there misleads about its distance, as a factor."""
_RANGE_SD, _RANGE_SIGMAS, _STEPS = 0.03, 2.5, 9
_MISLED = 1 + np.linspace(-_RANGE_SIGMAS * _RANGE_SD, _RANGE_SIGMAS * _RANGE_SD, _STEPS)
_HALF_SEEN_RATIO = 1.2
_SLACK_MM = 1.0
_HALF_SEEN_MM = 5.0
"""A mostly hidden ball's outline takes in the edge of what hides it, and leads this far astray."""
_MOST_POINTS = 12


def signs_of_another(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    candidates: Sequence[Candidates],
    sigmas: float,
) -> tuple[str, ...]:
    """A line if some balls that are none of the body found are as far apart as in the body.

    Two will do if two cameras locate one of them, or one camera sees both well; else three, whose
    sizes tell how far away they are.

    Args:
        world_from_body: the pose found.
        body: the body.
        cameras: all cameras.
        candidates: of every ball.
        sigmas: distances fit within this many standard deviations.
    """
    left = _unexplained(world_from_body, body, cameras, candidates)
    if sum(len(some) > 0 for some in left) < 2:
        return ()
    located = [meeting_points(some, sigmas, _SIZE_RATIO, _MOST_POINTS) for some in left]
    distances = np.linalg.norm(body.centers[:, None] - body.centers[None], axis=2)
    for balls, where in _signs(left, located, distances, sigmas):
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
    lone = [_lone(c, p, sigmas) for c, p in zip(candidates, located, strict=True)]
    places = [_along(c) for c in lone]
    fits = {
        (i, j): fitting_ranges(places[i], places[j], float(distances_mm[i, j]), _SLACK_MM)
        for i, j in combinations(balls, 2)
    }
    for three in combinations(balls, 3):
        one, two, other = (fits[pair] for pair in combinations(three, 2))
        yield three, _by_sizes([lone[k] for k in three], one, two, other)
    for i, j in combinations(balls, 2):
        yield (i, j), _side_by_side(lone[i], lone[j], fits[i, j])


def _lone(candidates: Candidates, located: BallPoints, sigmas: float) -> Candidates:
    """Those that no other camera sees: where the others are is known better than by their size."""
    if not len(candidates) or not len(located.points):
        return candidates
    to_point = located.points[:, None] - candidates.origins
    along = np.einsum("kni,ni->kn", to_point, candidates.directions)
    off = np.linalg.norm(to_point - along[:, :, None] * candidates.directions, axis=2)
    limit = sigmas * np.hypot(located.sd_mm[:, None], candidates.angle_sd * along) + _SLACK_MM
    shared = np.any((off < limit) & _as_far(along, candidates.range_mm), axis=0)
    return candidates.rows(np.nonzero(~shared)[0])


def _unexplained(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    candidates: Sequence[Candidates],
) -> list[Candidates]:
    """Candidates of every ball that do not lie on a ball of the body found."""
    own = explained(
        world_from_body,
        body,
        cameras,
        np.concatenate([some.cameras for some in candidates]),
        np.concatenate([some.pixels for some in candidates]),
    )
    ends = np.cumsum([len(some) for some in candidates]).tolist()
    return [
        some.rows(np.nonzero(~own[end - len(some) : end])[0])
        for some, end in zip(candidates, ends, strict=True)
    ]


def _pair(a: BallPoints, b: BallPoints, distance_mm: float, sigmas: float) -> Floats | None:
    """The middle (3,) of two located points that are `distance_mm` apart, if there are such."""
    if not len(a.points) or not len(b.points):
        return None
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


def _by_sizes(
    some: Sequence[Candidates], first_two: Bools, outer_two: Bools, last_two: Bools
) -> Floats | None:
    """The middle (3,) of three candidates, one of each kind, that may be as many of the balls.

    Their sizes tell how far away they are, give or take a few percent.

    Args:
        some: candidates of three kinds: n, m and k.
        first_two: (n, m) which of them may be as far apart as the balls.
        outer_two: (n, k) the same.
        last_two: (m, k) the same.
    """
    if not (first_two.any() and outer_two.any() and last_two.any()):
        return None
    found = np.argwhere(first_two[:, :, None] & outer_two[:, None, :] & last_two[None])
    return _middle(some, found[0]) if len(found) else None


def _side_by_side(first: Candidates, second: Candidates, fits: Bools) -> Floats | None:
    """The same for two that one camera sees, and sees well: of their distance little is open."""
    if not fits.any():
        return None
    alike = fits & (first.cameras[:, None] == second.cameras)
    if not alike.any():
        return None
    found = np.argwhere(alike & _well_seen(first)[:, None] & _well_seen(second))
    return _middle([first, second], found[0]) if len(found) else None


def _well_seen(candidates: Candidates) -> Bools:
    """Whose sizes (n,) are known to `_RANGE_SD`; a half-hidden one takes a third to tell."""
    radius = [d.radius_px for d in candidates.detections]
    return np.asarray(candidates.sd_px < _RANGE_SD * np.array(radius))


def _middle(some: Sequence[Candidates], rows: Ints) -> Floats:
    """The mean (3,) of where candidates, one of each kind, are if their sizes tell the truth."""
    points = [
        c.origins[k] + c.range_mm[k] * c.directions[k] for c, k in zip(some, rows, strict=True)
    ]
    return np.asarray(np.mean(points, axis=0))


def _along(candidates: Candidates) -> Floats:
    """Places (n, steps, 3) where the balls may be, given how far sizes mislead."""
    lengths = candidates.range_mm[:, None] * _MISLED
    return candidates.origins[:, None] + lengths[:, :, None] * candidates.directions[:, None]


def _as_far(distance: Floats, told: Floats) -> Bools:
    return np.asarray((distance < told * _HALF_SEEN_RATIO) & (distance > told / _HALF_SEEN_RATIO))


def _said(names: Sequence[str], where: Floats) -> str:
    x, y, z = where
    return (
        f"there may be a second body near ({x:.0f}, {y:.0f}, {z:.0f}) mm, with balls like "
        f"{', '.join(names[:-1])} and {names[-1]}: take it out of view"
    )
