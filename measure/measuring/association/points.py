"""Where candidates of one ball in two or more cameras meet in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints
from measure.measuring.association.meeting import Sightlines, meeting_centers
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
    focal, lenses = rig.focal_px[cameras], rig.lenses[cameras]
    return Candidates(
        detections,
        cameras,
        pixels,
        sd,
        rig.centers[cameras],
        ray_rows(pixels, lenses, rig.reach[cameras], rig.rotation[cameras]),
        radius_mm * np.sqrt(1 + (focal / radius_px) ** 2),
        sd / focal,
    )
