"""Where candidates of one ball in two or more cameras meet in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.geometry import Rays
from measure.model import Ball, Camera, Detection, Rig

_FLOOR_MM = 1.0
"""Rays that pass this close always meet: cameras are not quite simultaneous."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates of one ball in all cameras, as arrays of n rows.

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

    @classmethod
    def of(
        cls, detections: Sequence[Detection], cameras: Ints, ball: Ball, rig: Rig, rays: Rays
    ) -> Candidates:
        """Stack the candidates of `ball`; `rig` and `rays` have a row for each."""
        sd = np.sqrt([np.trace(d.covariance_px) / 2 for d in detections]).reshape(-1)
        focal = rig.focal_px
        radius = np.array([d.radius_px for d in detections])
        return cls(
            tuple(detections),
            cameras,
            np.array([d.center_px for d in detections]).reshape(-1, 2),
            sd,
            rays.origins,
            rays.directions,
            ball.radius_mm * np.sqrt(1 + (focal / radius) ** 2),
            sd / focal,
        )

    def __len__(self) -> int:
        return len(self.cameras)


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
    first, second = np.nonzero(candidates.cameras[:, None] < candidates.cameras[None, :])
    points, ok = _midpoints(candidates, first, second, sigmas, range_ratio)
    points = points[ok]
    if not len(points):
        return BallPoints(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    member = _members(candidates, points, sigmas, range_ratio)
    member[np.arange(len(points)), first[ok]] = True
    member[np.arange(len(points)), second[ok]] = True
    member = np.unique(member, axis=0)
    return _refined(candidates, member, most)


def _midpoints(
    c: Candidates, first: Ints, second: Ints, sigmas: float, range_ratio: float
) -> tuple[Floats, Bools]:
    """Midpoints (m, 3) of the common perpendiculars of pairs of rays, and which pairs meet."""
    o1, o2, d1, d2 = c.origins[first], c.origins[second], c.directions[first], c.directions[second]
    between = o2 - o1
    cosine = np.einsum("ni,ni->n", d1, d2)
    along1, along2 = np.einsum("ni,ni->n", between, d1), np.einsum("ni,ni->n", between, d2)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    s, t = (along1 - cosine * along2) / sine2, (cosine * along1 - along2) / sine2
    foot1, foot2 = o1 + s[:, None] * d1, o2 + t[:, None] * d2
    gap = np.linalg.norm(foot1 - foot2, axis=1)
    limit = sigmas * np.hypot(s * c.angle_sd[first], t * c.angle_sd[second]) + _FLOOR_MM
    with np.errstate(invalid="ignore"):
        ok = (gap < limit) & (sine2 > 1e-3) & (s > 0) & (t > 0)
        ok &= _in_range(s, c.range_mm[first], range_ratio)
        ok &= _in_range(t, c.range_mm[second], range_ratio)
    return (foot1 + foot2) / 2, ok


def _in_range(distance: Floats, told: Floats, ratio: float) -> Bools:
    return (distance < told * ratio) & (distance * ratio > told)


def _members(c: Candidates, points: Floats, sigmas: float, range_ratio: float) -> Bools:
    """Which candidates (k, n) see the points (k, 3): at most one per camera, the nearest."""
    away = points[:, None, :] - c.origins
    distance = np.linalg.norm(away, axis=2)
    off = np.linalg.norm(np.cross(away, c.directions), axis=2)
    scaled = off / (sigmas * distance * c.angle_sd + _FLOOR_MM)
    near = (scaled < 1) & _in_range(distance, c.range_mm, range_ratio)
    scaled = np.where(near, scaled, np.inf)
    member = np.zeros(near.shape, np.bool_)
    rows = np.arange(len(points))
    for camera in np.unique(c.cameras):
        columns = np.nonzero(c.cameras == camera)[0]
        best = columns[np.argmin(scaled[:, columns], axis=1)]
        member[rows, best] = np.isfinite(scaled[rows, best])
    return member


def _refined(c: Candidates, member: Bools, most: int) -> BallPoints:
    """Least squares on the rays of each set of members (k, n)."""
    across = np.eye(3) - c.directions[:, :, None] * c.directions[:, None, :]
    weight = member / (c.angle_sd * c.range_mm) ** 2
    normal = np.einsum("kn,nij->kij", weight, across)
    right = np.einsum("kn,nij,nj->ki", weight, across, c.origins)
    covariance = np.linalg.inv(normal)
    points = np.einsum("kij,kj->ki", covariance, right)
    support = member.sum(axis=1)
    order = np.argsort(-support, kind="stable")[:most]
    sd = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3)
    return BallPoints(points[order], sd[order], support[order].astype(np.int64))


def by_ball(
    detections: Mapping[str, Sequence[Detection]],
    balls: Sequence[Ball],
    cameras: Sequence[Camera],
) -> list[Candidates]:
    """The candidates of every ball, from detections by camera name."""
    rig = Rig.of(cameras)
    seen = [(i, d) for i, c in enumerate(cameras) for d in detections.get(c.name, ())]
    numbers = np.array([i for i, _ in seen], dtype=np.int64)
    rows = rig.take(numbers)
    rays = rows.rays(np.array([d.center_px for _, d in seen]).reshape(-1, 2))
    out = []
    for ball in balls:
        mine = np.array([k for k, (_, d) in enumerate(seen) if d.ball == ball.name], dtype=np.int64)
        some = Rays(rays.origins[mine], rays.directions[mine])
        out.append(
            Candidates.of([seen[k][1] for k in mine], numbers[mine], ball, rows.take(mine), some)
        )
    return out
