"""Agreement of candidates with poses and with distances between balls, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.compiling import compiled
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


@compiled
def lie_on_balls(
    centers: Floats, radii: Floats, rig: RigRows, cameras: Ints, pixels: Floats, share: float
) -> Bools:
    """Whether each of n candidates (n,) lies on some ball.

    Args:
        centers: (balls, 3) in the world.
        radii: (balls,) mm.
        cameras: (n,) index of the candidates' cameras.
        pixels: (n, 2).
        share: of a ball's radius, how far from its centre.
    """
    out = np.zeros(len(cameras), np.bool_)
    pixel, by_point = np.empty(2), np.empty((2, 3))
    for i in range(len(cameras)):
        k = cameras[i]
        focal = (rig.lenses[k, 0] + rig.lenses[k, 3]) / 2
        for ball in range(len(centers)):
            project_one(rig, k, centers[ball], pixel, by_point)
            off = np.hypot(pixels[i, 0] - pixel[0], pixels[i, 1] - pixel[1])
            away = _distance(centers[ball], rig.centers[k])
            if off < share * focal * radii[ball] / away:
                out[i] = True
    return out


@compiled
def possible_distances(a: Floats, b: Floats, distance_mm: float, slack_mm: float) -> Bools:
    """Whether n and m points may be `distance_mm` apart, each at one of s places.

    Args:
        a: (n, s, 3) places, mm.
        b: (m, s, 3) the same.
        slack_mm: tolerance of the least and the largest distance.

    Returns:
        (n, m).
    """
    out = np.zeros((len(a), len(b)), np.bool_)
    wide_a, wide_b = _widths(a), _widths(b)
    for i in range(len(a)):
        for j in range(len(b)):
            apart, wide = _distance(a[i, 0], b[j, 0]), wide_a[i] + wide_b[j] + slack_mm
            if apart - wide > distance_mm or apart + wide < distance_mm:
                continue
            near, far = np.inf, 0.0
            for one in a[i]:
                for other in b[j]:
                    apart = _distance(one, other)
                    near, far = min(near, apart), max(far, apart)
            out[i, j] = near < distance_mm + slack_mm and distance_mm < far + slack_mm
    return out


@compiled
def _widths(places: Floats) -> Floats:
    """Largest distance (n,) of the first of places (n, s, 3) from the others."""
    out = np.zeros(len(places))
    for i in range(len(places)):
        for one in places[i]:
            out[i] = max(out[i], _distance(places[i, 0], one))
    return out


@compiled
def _distance(a: Floats, b: Floats) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return float(np.sqrt(x * x + y * y + z * z))
