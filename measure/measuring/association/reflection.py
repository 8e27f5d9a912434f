"""The body's mirror image in a plane, as a glossy table or a pane shows it.

Of balls at p a mirror with unit normal n shows images at q = p - 2 ((p - c) . n) n, with c in the
plane. So all p - q are parallel to n and all middles of p and q lie in the plane. Body and cameras
are in front of the mirror and the images behind it, which tells the body from its image.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from measure.arrays import Bools, Floats
from measure.geometry import RigidTransform
from measure.measuring.association.candidates import (
    SLACK_MM,
    BallPoints,
    Candidates,
    intersect_rays,
)
from measure.measuring.association.hypotheses import lie_on_balls
from measure.model import Body, Camera, Detection

_RANGE_RATIO = 1.15  # Largest error, as a factor, of the distance that an outline's size implies
_MAX_POINTS_PER_BALL = 12
_SURE_BALLS = 3  # Images of so many balls must be where the mirror shows them, if as many are seen


@dataclass(frozen=True, eq=False)
class Reflection:
    """A mirror image of the body."""

    normal: Floats  # (3,) of the plane, unit length, towards the body
    distance_mm: float  # of the middle of the balls from the plane
    detections: tuple[Detection, ...]  # candidates that lie on the images of balls
    others: tuple[Candidates, ...]  # of every ball, the candidates that do not

    def left_out_of(
        self, detections: Mapping[str, Sequence[Detection]]
    ) -> dict[str, list[Detection]]:
        """All detections but those of the image, by camera name."""
        own = {id(d) for d in self.detections}
        return {name: [d for d in some if id(d) not in own] for name, some in detections.items()}

    def __str__(self) -> str:
        """What is in view, with the plane, and what to do."""
        x, y, z = np.round(self.normal, 2) + 0.0
        return (
            f"a mirror image of the body is in view, in a plane {self.distance_mm:.0f} mm from it "
            f"with the normal ({x:g}, {y:g}, {z:g}): a glossy table, or a pane? cover it"
        )


def find_reflection(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    candidates: Sequence[Candidates],
    sigmas: float,
) -> Reflection | None:
    """The mirror image of the body found, if some plane shows it there; else None.

    Two balls that are located where a mirror shows them suffice, and three if three are located.

    Args:
        candidates: of every ball, those that do not lie on the body.
        sigmas: points fit within this many standard deviations.
    """
    centers = world_from_body.apply(body.centers)
    located = [intersect_rays(c, sigmas, _RANGE_RATIO, _MAX_POINTS_PER_BALL) for c in candidates]
    seen = sum(len(points.points) > 0 for points in located)
    if seen < 2:
        return None
    best, most = None, 0
    for normal, offset_mm in _planes(centers, located):
        heights = centers @ normal - offset_mm
        images = centers - 2 * heights[:, None] * normal
        near = sum(_is_located(i, p, sigmas) for i, p in zip(images, located, strict=True))
        if near < min(seen, _SURE_BALLS) or np.any(heights <= 0):
            continue
        front = np.array([camera.center @ normal > offset_mm for camera in cameras])
        shown = [_shown(images, body, cameras, front, some) for some in candidates]
        views = [some.rays.cameras[own] for some, own in zip(candidates, shown, strict=True)]
        count = sum(len(own) for own in views)
        if count > most and sum(len(set(own.tolist())) >= 2 for own in views) >= 2:
            both = list(zip(candidates, shown, strict=True))
            on = (d for some, own in both for d in some.rows(np.flatnonzero(own)).detections)
            rest = tuple(some.rows(np.flatnonzero(~own)) for some, own in both)
            best, most = Reflection(normal, float(np.mean(heights)), tuple(on), rest), count
    return best


def _planes(centers: Floats, located: Sequence[BallPoints]) -> Iterator[tuple[Floats, float]]:
    """Normals (3,) and offsets in mm of the planes between two balls and points of their kinds."""
    for i, j in combinations(range(len(centers)), 2):
        for one in located[i].points:
            for other in located[j].points:
                across = centers[i] - one + centers[j] - other
                length = float(np.linalg.norm(across))
                if length > 0:
                    normal = across / length
                    middle = (centers[i] + one + centers[j] + other) / 4
                    yield normal, float(middle @ normal)


def _is_located(image: Floats, points: BallPoints, sigmas: float) -> bool:
    off = np.linalg.norm(points.points - image, axis=1)
    return bool(np.any(off < sigmas * points.sd_mm + SLACK_MM))


def _shown(
    images: Floats, body: Body, cameras: Sequence[Camera], front: Bools, some: Candidates
) -> Bools:
    """Which candidates (n,) of cameras in front of the mirror lie on the images of balls."""
    own = lie_on_balls(images, body.radii, cameras, some.rays.cameras, some.pixels)
    return np.asarray(own & front[some.rays.cameras])
