"""Where candidates of one ball in two or more cameras meet in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.compiling import compiled
from measure.model import Ball, Camera, Detection, Rig
from measure.model.rig_kernels import ray_rows


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates in all cameras, as arrays of n rows.

    Attributes:
        detections: the n candidates.
        cameras: (n,) index of the camera.
        pixels: (n, 2).
        sd_px: (n,) standard deviation of a coordinate.
        origins: (n, 3) and
        directions: (n, 3) of the rays in the world.
        range_mm: (n,) distance that the outline's radius tells.
        angle_sd: (n,) standard deviation of the ray's angle, rad.
    """

    detections: tuple[Detection, ...]
    cameras: Ints
    pixels: Floats
    sd_px: Floats
    origins: Floats
    directions: Floats
    range_mm: Floats
    angle_sd: Floats

    def __len__(self) -> int:
        return len(self.cameras)

    def rows(self, index: Ints) -> Candidates:
        """Some of them."""
        return Candidates(
            tuple([self.detections[k] for k in index.tolist()]),
            self.cameras[index],
            self.pixels[index],
            self.sd_px[index],
            self.origins[index],
            self.directions[index],
            self.range_mm[index],
            self.angle_sd[index],
        )


@dataclass(frozen=True, eq=False)
class BallPoints:
    """Possible centres of one ball, as arrays of k rows.

    Attributes:
        points: (k, 3) in the world, mm.
        sd_mm: (k,) standard deviation of a coordinate.
        support: (k,) number of cameras.
    """

    points: Floats
    sd_mm: Floats
    support: Ints


def meeting_points(
    candidates: Candidates, sigmas: float, range_ratio: float, most: int
) -> BallPoints:
    """Points where rays of two or more cameras meet, as far away as the outlines' sizes say.

    Args:
        candidates: of one ball.
        sigmas: rays meet if they pass within this many standard deviations.
        range_ratio: how far the outline's size may mislead about the distance, as a factor.
        most: keep this many, those that most cameras see.
    """
    c = candidates
    lines = Sightlines(c.cameras, c.origins, c.directions, c.range_mm, c.angle_sd)
    points, sd, support = meeting_centers(lines, sigmas, range_ratio)
    order = np.argsort(-support, kind="stable")[:most]
    return BallPoints(points[order], sd[order], support[order])


def by_ball(
    detections: Mapping[str, Sequence[Detection]],
    balls: Sequence[Ball],
    cameras: Sequence[Camera],
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
    """Stack detections, the cameras (n,) of which stand in the rig."""
    sizes = {ball.name: ball.radius_mm for ball in balls}
    radius_mm = np.array([sizes.get(d.ball, np.nan) for d in detections])
    radius_px = np.array([d.radius_px for d in detections])
    sd = np.sqrt(np.array([d.variance_px2 for d in detections]))
    pixels = np.array([d.center_px for d in detections]).reshape(-1, 2)
    views = rig.take(cameras)
    focal = views.focal_px
    return Candidates(
        detections,
        cameras,
        pixels,
        sd,
        views.centers,
        ray_rows(pixels, views.rows),
        radius_mm * np.sqrt(1 + (focal / radius_px) ** 2),
        sd / focal,
    )


_FLOOR_MM = 1.0
"""Rays that pass this close always meet: cameras are not quite simultaneous."""
_LEAST_SINE2 = 1e-3


class Sightlines(NamedTuple):
    """What n candidates say about where their balls are.

    Attributes:
        cameras: (n,) index of the camera.
        origins: (n, 3) of the rays, mm.
        directions: (n, 3) of the rays.
        range_mm: (n,) distance that the outline's radius tells.
        angle_sd: (n,) standard deviation of the ray's angle, rad.
    """

    cameras: Ints
    origins: Floats
    directions: Floats
    range_mm: Floats
    angle_sd: Floats


@compiled
def meetings(lines: Sightlines, sigmas: float, range_ratio: float) -> Bools:
    """Which of n candidates see a common point, for every two whose rays meet.

    Args:
        lines: the candidates.
        sigmas: rays meet if they pass within this many standard deviations.
        range_ratio: how far the outline's size may mislead about the distance, as a factor.

    Returns:
        (k, n), each row different from the others, at most one candidate of a camera in each.
    """
    cameras, origins, directions, range_mm, angle_sd = lines
    n = len(cameras)
    member, count = np.zeros((n * n, n), np.bool_), 0
    point = np.empty(3)
    for i in range(n):
        for j in range(n):
            if cameras[i] >= cameras[j]:
                continue
            s, t, sine2 = _feet(origins[i], directions[i], origins[j], directions[j])
            if not (sine2 > _LEAST_SINE2 and s > 0 and t > 0):
                continue
            gap = 0.0
            for a in range(3):
                one = origins[i, a] + s * directions[i, a]
                other = origins[j, a] + t * directions[j, a]
                gap += (one - other) ** 2
                point[a] = (one + other) / 2
            limit = sigmas * np.hypot(s * angle_sd[i], t * angle_sd[j]) + _FLOOR_MM
            fits = _in_range(s, range_mm[i], range_ratio) and _in_range(t, range_mm[j], range_ratio)
            if not (np.sqrt(gap) < limit and fits):
                continue
            row = member[count]
            row[:] = False
            _witnesses(point, lines, sigmas, range_ratio, row)
            row[i] = row[j] = True
            count += _is_new(member, count)
    return member[:count]


@compiled
def _feet(o1: Floats, d1: Floats, o2: Floats, d2: Floats) -> tuple[float, float, float]:
    """How far along two rays their common perpendicular stands; squared sine of their angle."""
    cosine, along1, along2 = 0.0, 0.0, 0.0
    for a in range(3):
        cosine += d1[a] * d2[a]
        along1 += (o2[a] - o1[a]) * d1[a]
        along2 += (o2[a] - o1[a]) * d2[a]
    sine2 = max(1 - cosine**2, 1e-12)
    return (along1 - cosine * along2) / sine2, (cosine * along1 - along2) / sine2, sine2


@compiled
def _in_range(distance: float, told: float, ratio: float) -> bool:
    return distance < told * ratio and distance * ratio > told


@compiled
def _witnesses(
    point: Floats, lines: Sightlines, sigmas: float, range_ratio: float, row: Bools
) -> None:
    """Mark in `row` (n,) who sees a point (3,): at most one per camera, the nearest."""
    cameras, origins, directions, range_mm, angle_sd = lines
    n = len(cameras)
    nearest = np.full(np.max(cameras) + 1, 1.0)
    best = np.full(len(nearest), -1)
    for k in range(n):
        x, y, z = point[0] - origins[k, 0], point[1] - origins[k, 1], point[2] - origins[k, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        if not _in_range(distance, range_mm[k], range_ratio):
            continue
        dx, dy, dz = directions[k]
        off = np.sqrt((y * dz - z * dy) ** 2 + (z * dx - x * dz) ** 2 + (x * dy - y * dx) ** 2)
        scaled = off / (sigmas * distance * angle_sd[k] + _FLOOR_MM)
        if scaled < nearest[cameras[k]]:
            nearest[cameras[k]] = scaled
            best[cameras[k]] = k
    for k in best:
        if k >= 0:
            row[k] = True


@compiled
def _is_new(member: Bools, count: int) -> bool:
    """Whether row `count` differs from all rows above it."""
    alike = 0
    for k in range(count):
        alike += int(np.all(member[k] == member[count]))
    return alike == 0


@compiled
def meeting_centers(
    lines: Sightlines, sigmas: float, range_ratio: float
) -> tuple[Floats, Floats, Ints]:
    """Least squares on the rays of each set of candidates that see a common point.

    Args:
        lines: the candidates.
        sigmas: see `meetings`.
        range_ratio: see `meetings`.

    Returns:
        Points (k, 3), their standard deviations (k,) in mm, and how many rays (k,).
    """
    member = meetings(lines, sigmas, range_ratio)
    origins, directions = lines.origins, lines.directions
    sd_mm = lines.angle_sd * lines.range_mm  # at the distance where a ray meets others
    m, n = member.shape
    points, sd, support = np.empty((m, 3)), np.empty(m), np.zeros(m, np.int64)
    normal, right = np.empty((3, 3)), np.empty(3)
    for k in range(m):
        normal[:], right[:] = 0.0, 0.0
        for i in range(n):
            if not member[k, i]:
                continue
            support[k] += 1
            weight = 1 / sd_mm[i] ** 2
            for a in range(3):
                for b in range(3):
                    across = (a == b) - directions[i, a] * directions[i, b]
                    normal[a, b] += weight * across
                    right[a] += weight * across * origins[i, b]
        covariance = np.linalg.inv(normal)
        points[k] = covariance @ right
        sd[k] = np.sqrt((covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / 3)
    return points, sd, support
