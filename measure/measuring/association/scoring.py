"""Which candidates agree with a pose, and which possible centres with a body, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.compiling import compiled
from measure.model.rig_kernels import RigRows, project_one


class CandidateRows(NamedTuple):
    """The candidates of all balls as arrays of n rows, one ball's after the other's.

    Attributes:
        starts: (balls + 1,) first row of each ball's.
        cameras: (n,) index of the camera.
        pixels: (n, 2).
        limit_px: (n,) the furthest that a candidate may be from where a pose puts its ball.
        range_mm: (n,) distance that the outline's radius tells.
    """

    starts: Ints
    cameras: Ints
    pixels: Floats
    limit_px: Floats
    range_mm: Floats


@compiled
def agreeing(
    rotations: Floats,
    translations: Floats,
    centers_body: Floats,
    rig: RigRows,
    corners: Floats,
    candidates: CandidateRows,
    range_ratio: float,
) -> tuple[Ints, Ints, Floats]:
    """Compare the balls of m poses, projected, with the candidates: in place and in size.

    Args:
        rotations: (m, 3, 3) of world_from_body.
        translations: (m, 3).
        centers_body: (balls, 3).
        rig: all cameras.
        corners: (cameras, 2) last pixel of each picture.
        candidates: n of them.
        range_ratio: how far the outline's size may mislead about the distance, as a factor.

    Returns:
        Row of the agreeing candidate among those of its ball, or -1 (m, balls, cameras); number of
        balls in view, over all cameras (m,); score (m,), see `hypotheses.Support`.
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
                    told = range_mm[k]
                    if cameras[k] != camera:
                        continue
                    if away > told * range_ratio or told > away * range_ratio:
                        continue
                    share = np.hypot(u - pixels[k, 0], v - pixels[k, 1]) / limit_px[k]
                    if share < least:
                        least = share
                        chosen[row, ball, camera] = k - starts[ball]
                if least < 1:
                    score[row] += 1 - least**2
    return chosen, expected, score


@compiled
def on_balls(
    centers: Floats,
    radii: Floats,
    rig: RigRows,
    cameras: Ints,
    pixels: Floats,
    share: float,
) -> Bools:
    """Which of n candidates (n,) lie on some ball.

    Args:
        centers: (balls, 3) in the world.
        radii: (balls,) mm.
        rig: all cameras.
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
            away = _apart(centers[ball], rig.centers[k])
            if off < share * focal * radii[ball] / away:
                out[i] = True
    return out


@compiled
def fitting_pairs(
    a: Floats,
    sd_a: Floats,
    b: Floats,
    sd_b: Floats,
    distance_mm: float,
    sigmas: float,
    slack: float,
) -> Floats:
    """How badly points (n, 3) and (m, 3) are `distance_mm` apart: (n, m), 1 at the limit."""
    out = np.empty((len(a), len(b)))
    for i in range(len(a)):
        for j in range(len(b)):
            x, y, z = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], a[i, 2] - b[j, 2]
            off = abs(np.sqrt(x * x + y * y + z * z) - distance_mm)
            out[i, j] = off / (sigmas * np.hypot(sd_a[i], sd_b[j]) + slack)
    return out


@compiled
def fitting_ranges(a: Floats, b: Floats, distance_mm: float, slack_mm: float) -> Bools:
    """Which of n and m things may be `distance_mm` apart, if each is at one of s places.

    Args:
        a: (n, s, 3) places, mm.
        b: (m, s, 3) the same.
        distance_mm: between the two.
        slack_mm: how much nearer or further than all places they may be.

    Returns:
        (n, m).
    """
    out = np.zeros((len(a), len(b)), np.bool_)
    wide_a, wide_b = _widths(a), _widths(b)
    for i in range(len(a)):
        for j in range(len(b)):
            apart, wide = _apart(a[i, 0], b[j, 0]), wide_a[i] + wide_b[j] + slack_mm
            if apart - wide > distance_mm or apart + wide < distance_mm:
                continue
            near, far = np.inf, 0.0
            for one in a[i]:
                for other in b[j]:
                    apart = _apart(one, other)
                    near, far = min(near, apart), max(far, apart)
            out[i, j] = near < distance_mm + slack_mm and distance_mm < far + slack_mm
    return out


@compiled
def _widths(places: Floats) -> Floats:
    """How far (n,) the first of places (n, s, 3) is from the furthest of them."""
    out = np.zeros(len(places))
    for i in range(len(places)):
        for one in places[i]:
            out[i] = max(out[i], _apart(places[i, 0], one))
    return out


@compiled
def _apart(a: Floats, b: Floats) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return float(np.sqrt(x * x + y * y + z * z))


@compiled
def fitting_triples(one: Floats, two: Floats, three: Floats) -> tuple[Ints, Floats]:
    """Triples of points of which every two fit.

    Args:
        one: (n, m) misfits of the first and second points, see `fitting_pairs`.
        two: (n, k) of the first and third.
        three: (m, k) of the second and third.

    Returns:
        Rows (t, 3) of the points, and each triple's greatest misfit (t,), less than 1.
    """
    most = one.size * two.shape[1]
    rows, misfits = np.empty((most, 3), np.int64), np.empty(most)
    count = 0
    for i in range(one.shape[0]):
        for j in range(one.shape[1]):
            if not one[i, j] < 1:
                continue
            for k in range(two.shape[1]):
                worst = max(one[i, j], two[i, k], three[j, k])
                if worst < 1:
                    rows[count, 0], rows[count, 1], rows[count, 2] = i, j, k
                    misfits[count] = worst
                    count += 1
    return rows[:count], misfits[:count]
