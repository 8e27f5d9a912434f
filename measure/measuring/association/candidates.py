"""Candidates of all cameras as rays, and the points where those of one ball intersect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.model import Ball, Camera, Detection, Rig
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
