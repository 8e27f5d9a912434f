"""Where candidates of one ball in two or more cameras meet in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints
from measure.geometry import Rays
from measure.measuring.association.meeting import Sightlines, meeting_centers, meetings
from measure.model import Ball, Camera, Detection, Rig


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
        sd = np.sqrt([d.variance_px2 for d in detections]).reshape(-1)
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

    def rows(self, index: Ints) -> Candidates:
        """Some of them."""
        return Candidates(
            tuple(self.detections[k] for k in index),
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
    member = meetings(lines, sigmas, range_ratio)
    points, sd, support = meeting_centers(member, c.origins, c.directions, c.angle_sd * c.range_mm)
    order = np.argsort(-support, kind="stable")[:most]
    return BallPoints(points[order], sd[order], support[order])


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
