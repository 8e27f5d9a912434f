"""The outlines of one frame set with their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.model import Body, Camera, Detection, Motion, Rig
from measure.model.observations import stacked_detections

if TYPE_CHECKING:
    from measure_plugins._joint_fit.problem import BallRows, PackedOutlines, ViewRows


@dataclass(frozen=True, eq=False)
class BallViewNames:
    """Which balls in which cameras k ball-views show; the same from frame set to frame set."""

    balls: tuple[str, ...]  # (k,) names
    ball_of: Ints  # (k,) the balls' places in the body
    shown: tuple[str, ...]  # the balls' names, each once, in the order of the body
    seen_by: tuple[str, ...]  # (c,) names of the cameras, sorted
    cameras: tuple[Camera, ...]  # (c,) the same
    rig: Rig  # (c,) the same, stacked
    rows: BallRows
    views: ViewRows


class NamedOutlines(NamedTuple):
    """The outlines of one frame set with the names of their balls and cameras."""

    packed: PackedOutlines  # k ball-views in c views, of a body at rest
    detections: tuple[Detection, ...]  # (k,) they come from
    named: BallViewNames
    instants: set[float]

    def moved(self, motion: Motion, time_s: float) -> Floats:
        """How far (k, 6) the body has moved in each picture from where it is at `time_s`."""
        times = np.array([d.time_s for d in self.detections])
        return motion.moved(times) - motion.moved(time_s)

    def center_by_size(self, i: int) -> Floats | None:
        """World centre (3,) of a ball from the size and place of ball-view i."""
        from measure.geometry import fit_cone

        points, packed = self.packed.points(i), self.packed
        try:
            cone = fit_cone(packed.rays[:3, points].T, packed.sharpness[points] ** 2)
        except DegenerateGeometryError:
            return None
        camera = self.named.cameras[self.packed.view_of[i]]
        return camera.world_from_camera.apply(cone.center(float(self.packed.radii[i])))


def outlines_of(
    detections: Sequence[Detection], body: Body, cameras: Mapping[str, Camera]
) -> NamedOutlines | None:
    """The outlines of detections, ready for the fit; None if they have none."""
    seen = [d for d in detections if d.outline_px is not None and d.outline_sd_px is not None]
    return _packed(tuple(seen), body, tuple([cameras[d.camera] for d in seen]))


@lru_cache(maxsize=16)
def _packed(
    seen: tuple[Detection, ...], body: Body, cameras: tuple[Camera, ...]
) -> NamedOutlines | None:
    """Kept: the same detections (compared by identity) are solved again with a better motion."""
    from measure_plugins._joint_fit.problem import pack

    if not seen:
        return None
    named = _named(tuple([d.ball for d in seen]), body, cameras)
    points = [d.outline_px for d in seen if d.outline_px is not None]
    sd = [d.outline_sd_px for d in seen if d.outline_sd_px is not None]
    covariances = stacked_detections(seen)[1]
    packed, kept = pack(points, sd, covariances, named.rows, named.views)
    if len(kept) < len(seen):
        return _packed(tuple(seen[i] for i in kept), body, tuple(cameras[i] for i in kept))
    return NamedOutlines(packed, seen, named, {d.time_s for d in seen})


@lru_cache(maxsize=64)
def _named(balls: tuple[str, ...], body: Body, cameras: tuple[Camera, ...]) -> BallViewNames:
    """Of k ball-views; bodies and cameras compare by identity."""
    from measure_plugins._joint_fit.problem import BallRows, view_rows

    used = {camera.name: camera for camera in cameras}
    names = tuple(sorted(used))
    own = tuple(used[name] for name in names)
    ball_of = np.array([body.index(name) for name in balls])
    view_of = np.array([names.index(camera.name) for camera in cameras])
    rows = BallRows(view_of, body.centers[ball_of], body.radii[ball_of])
    shown = tuple(name for name in body.names if name in balls)
    return BallViewNames(balls, ball_of, shown, names, own, Rig.of(own), rows, view_rows(own))
