"""The outlines of one frame set with their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.model import Body, Camera, Detection, Motion, Rig
from measure.model.observations import stacked_detections

if TYPE_CHECKING:
    from measure_plugins._joint_fit.problem import Balls, Contours, Views


@dataclass(frozen=True, eq=False)
class Named:
    """Which balls in which cameras k ball-views show; the same from frame set to frame set.

    Attributes:
        balls: (k,) names.
        ball_of: (k,) the balls' places in the body.
        shown: the balls' names, each once, in the order of the body.
        seen_by: (c,) names of the cameras, sorted.
        cameras: (c,) the same.
        rig: (c,) the same, stacked.
        rows: what is known of the balls as arrays.
        views: the same of the cameras.
    """

    balls: tuple[str, ...]
    ball_of: Ints
    shown: tuple[str, ...]
    seen_by: tuple[str, ...]
    cameras: tuple[Camera, ...]
    rig: Rig
    rows: Balls
    views: Views


@dataclass(frozen=True, eq=False)
class Outlines:
    """Packed outlines with the names that go with them.

    Attributes:
        contours: k ball-views in c views, of a body at rest.
        detections: (k,) which they are.
        named: the same by their names.
        instants: the times of the pictures.
    """

    contours: Contours
    detections: tuple[Detection, ...]
    named: Named
    instants: set[float]

    def moved(self, motion: Motion, time_s: float) -> Floats:
        """How far (k, 6) the body has moved in each picture from where it is at `time_s`."""
        times = np.array([d.time_s for d in self.detections])
        return motion.moved(times) - motion.moved(time_s)

    def center_by_size(self, i: int) -> Floats | None:
        """World centre (3,) of a ball from the size and place of ball-view i."""
        from measure.geometry import fit_cone

        points, contours = self.contours.points(i), self.contours
        try:
            cone = fit_cone(contours.rays[:3, points].T, contours.sharpness[points] ** 2)
        except DegenerateGeometryError:
            return None
        camera = self.named.cameras[self.contours.view_of[i]]
        return camera.world_from_camera.apply(cone.center(float(self.contours.radii[i])))


def outlines_of(
    detections: Sequence[Detection], body: Body, cameras: Mapping[str, Camera]
) -> Outlines | None:
    """The outlines of detections, ready for the fit; None if they have none."""
    seen = [d for d in detections if d.outline_px is not None and d.outline_sd_px is not None]
    return _packed(tuple(seen), body, tuple([cameras[d.camera] for d in seen]))


@lru_cache(maxsize=16)
def _packed(
    seen: tuple[Detection, ...], body: Body, cameras: tuple[Camera, ...]
) -> Outlines | None:
    """Detections compare by identity, and are solved again when the motion is known better."""
    from measure_plugins._joint_fit.problem import pack

    if not seen:
        return None
    named = _named(tuple([d.ball for d in seen]), body, cameras)
    points = [d.outline_px for d in seen if d.outline_px is not None]
    sd = [d.outline_sd_px for d in seen if d.outline_sd_px is not None]
    covariances = stacked_detections(seen)[1]
    contours, kept = pack(points, sd, covariances, named.rows, named.views)
    if len(kept) < len(seen):
        return _packed(tuple(seen[i] for i in kept), body, tuple(cameras[i] for i in kept))
    return Outlines(contours, seen, named, {d.time_s for d in seen})


@lru_cache(maxsize=64)
def _named(balls: tuple[str, ...], body: Body, cameras: tuple[Camera, ...]) -> Named:
    """Of k ball-views; bodies and cameras compare by identity."""
    from measure_plugins._joint_fit.problem import Balls, views_of

    used = {camera.name: camera for camera in cameras}
    names = tuple(sorted(used))
    own = tuple(used[name] for name in names)
    ball_of = np.array([body.index(name) for name in balls])
    view_of = np.array([names.index(camera.name) for camera in cameras])
    rows = Balls(view_of, body.centers[ball_of], body.radii[ball_of])
    shown = tuple(name for name in body.names if name in balls)
    return Named(balls, ball_of, shown, names, own, Rig.of(own), rows, views_of(own))
