"""The outlines of one frame set with their names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.model import Body, Camera, Detection, Motion

if TYPE_CHECKING:
    from measure_plugins._edges.contours import Contours


_MOST_SPREAD = 2.0
_LEAST_VARIANCE_PX2 = 5e-9
"""For detectors that claim no uncertainty at all."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """Packed outlines with the names that go with them.

    Attributes:
        contours: k ball-views in c views, of a body at rest.
        detections: (k,) which they are.
        ball_of: (k,) the balls' places in the body.
        cameras: (c,).
    """

    contours: Contours
    detections: tuple[Detection, ...]
    ball_of: Ints
    cameras: tuple[Camera, ...]

    @cached_property
    def balls(self) -> tuple[str, ...]:
        """(k,) names."""
        return tuple(d.ball for d in self.detections)

    @cached_property
    def seen_by(self) -> tuple[str, ...]:
        """Names of the cameras that have an outline in the fit."""
        return tuple(sorted({d.camera for d in self.detections}))

    def moved(self, motion: Motion, time_s: float) -> Floats:
        """How far (k, 6) the body has moved in each picture from where it is at `time_s`."""
        times = np.array([d.time_s for d in self.detections])
        return motion.moved(times) - motion.moved(time_s)

    def center_by_size(self, i: int) -> Floats | None:
        """World centre (3,) of a ball from the size and place of ball-view i."""
        from measure.geometry import fit_cone

        points = self.contours.points(i)
        try:
            cone = fit_cone(
                self.contours.bearings[:, points].T, 1 / self.contours.sd_px[points] ** 2
            )
        except DegenerateGeometryError:
            return None
        camera = self.cameras[self.contours.view_of[i]]
        return camera.world_from_camera.apply(cone.center(float(self.contours.radii[i])))


def outlines_of(
    detections: Sequence[Detection], body: Body, cameras: Mapping[str, Camera]
) -> Outlines | None:
    """The outlines of detections, ready for the fit; None if they have none."""
    seen = tuple(d for d in detections if d.outline_px is not None and d.outline_sd_px is not None)
    used = tuple(cameras[name] for name in sorted({d.camera for d in seen}))
    return _packed(seen, body, used) if seen else None


@lru_cache(maxsize=16)
def _packed(seen: tuple[Detection, ...], body: Body, cameras: tuple[Camera, ...]) -> Outlines:
    """Detections compare by identity, and are solved again when the motion is known better."""
    from measure_plugins._edges.contours import Balls, pack, views_of

    places = {camera.name: i for i, camera in enumerate(cameras)}
    ball_of = np.array([body.index(d.ball) for d in seen])
    balls = Balls(
        np.array([places[d.camera] for d in seen]),
        body.centers[ball_of],
        body.radii[ball_of],
        _spread(seen),
    )
    points = [d.outline_px for d in seen if d.outline_px is not None]
    sd = [d.outline_sd_px for d in seen if d.outline_sd_px is not None]
    contours, kept = pack(points, sd, balls, views_of(cameras))
    return Outlines(contours, tuple(seen[i] for i in kept), ball_of[kept], cameras)


def _spread(seen: Sequence[Detection]) -> Floats:
    """Variances (k,) of the outlines' own shifts relative to each other.

    Where the edges of an outline scatter more, all of them together sit off further as well. Their
    scatter tells part of that only: it counts by its root, within limits.
    """
    claimed = [d.variance_px2 for d in seen]
    typical = max(median(claimed), _LEAST_VARIANCE_PX2)
    roots = [math.sqrt(variance / typical) for variance in claimed]
    return np.array([min(max(root, 1 / _MOST_SPREAD), _MOST_SPREAD) for root in roots])
