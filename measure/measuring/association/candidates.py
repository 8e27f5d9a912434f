"""Candidates of all cameras as rays, and the points where those of one ball intersect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.compiling import compiled
from measure.model import Ball, Camera, Detection, Rig
from measure.model.rig_kernels import ray_rows

_MIN_GATE_MM = 1.0  # Rays that pass this close always intersect: cameras are not quite simultaneous
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
    points, sd, support = intersections(candidates.rays, sigmas, range_ratio)
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
    """Stack detections, the cameras (n,) of which stand in the rig."""
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


@compiled
def consistent_sets(rays: CandidateRays, sigmas: float, range_ratio: float) -> Bools:
    """Sets of the n candidates that see a common point, from every two whose rays intersect.

    Args:
        sigmas: see `intersect_rays`.
        range_ratio: see `intersect_rays`.

    Returns:
        (k, n), each row different from the others, at most one candidate of a camera in each.
    """
    cameras, origins, directions, range_mm, angle_sd = rays
    n = len(cameras)
    member, count = np.zeros((n * n, n), np.bool_), 0
    point = np.empty(3)
    for i in range(n):
        for j in range(n):
            if cameras[i] >= cameras[j]:
                continue
            s, t, sine2 = _feet(origins[i], directions[i], origins[j], directions[j])
            if not (sine2 > _MIN_SQUARED_SINE and s > 0 and t > 0):
                continue
            gap = 0.0
            for a in range(3):
                one = origins[i, a] + s * directions[i, a]
                other = origins[j, a] + t * directions[j, a]
                gap += (one - other) ** 2
                point[a] = (one + other) / 2
            limit = sigmas * np.hypot(s * angle_sd[i], t * angle_sd[j]) + _MIN_GATE_MM
            fits = _in_range(s, range_mm[i], range_ratio) and _in_range(t, range_mm[j], range_ratio)
            if not (np.sqrt(gap) < limit and fits):
                continue
            row = member[count]
            row[:] = False
            _mark_consistent(point, rays, sigmas, range_ratio, row)
            row[i] = row[j] = True
            count += _is_new(member, count)
    return member[:count]


@compiled
def _feet(o1: Floats, d1: Floats, o2: Floats, d2: Floats) -> tuple[float, float, float]:
    """Distances along two rays to their common perpendicular; squared sine of their angle."""
    cosine, depth1, depth2 = 0.0, 0.0, 0.0
    for a in range(3):
        cosine += d1[a] * d2[a]
        depth1 += (o2[a] - o1[a]) * d1[a]
        depth2 += (o2[a] - o1[a]) * d2[a]
    sine2 = max(1 - cosine**2, 1e-12)
    return (depth1 - cosine * depth2) / sine2, (cosine * depth1 - depth2) / sine2, sine2


@compiled
def _in_range(distance: float, expected: float, ratio: float) -> bool:
    return distance < expected * ratio and distance * ratio > expected


@compiled
def _mark_consistent(
    point: Floats, rays: CandidateRays, sigmas: float, range_ratio: float, row: Bools
) -> None:
    """Mark in `row` (n,) the rays that pass a point (3,): of each camera at most the nearest."""
    cameras, origins, directions, range_mm, angle_sd = rays
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
        scaled = off / (sigmas * distance * angle_sd[k] + _MIN_GATE_MM)
        if scaled < nearest[cameras[k]]:
            nearest[cameras[k]] = scaled
            best[cameras[k]] = k
    for k in best:
        if k >= 0:
            row[k] = True


@compiled
def _is_new(member: Bools, count: int) -> bool:
    """Whether row `count` differs from all rows above it."""
    equal = 0
    for k in range(count):
        equal += int(np.all(member[k] == member[count]))
    return equal == 0


@compiled
def intersections(
    rays: CandidateRays, sigmas: float, range_ratio: float
) -> tuple[Floats, Floats, Ints]:
    """Least-squares points of each set of candidates whose rays intersect.

    Args:
        sigmas: see `intersect_rays`.
        range_ratio: see `intersect_rays`.

    Returns:
        Points (k, 3), their standard deviations (k,) in mm, and how many rays (k,).
    """
    member = consistent_sets(rays, sigmas, range_ratio)
    origins, directions = rays.origins, rays.directions
    sd_mm = rays.angle_sd * rays.range_mm
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
