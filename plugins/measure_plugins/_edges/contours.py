"""All outlines of one frame set, packed for the joint fit."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
from measure.model import Camera
from measure.model.lens import bearing_and_slopes


class Contours(NamedTuple):
    """k ball-views with n outline points together; ball-view i has those from start[i] on.

    Attributes:
        start: (k + 1,).
        bearings: (3, n) unit bearings of the points.
        slopes: (6, n) their pixels' derivatives by the bearing's x, y and z: first of u, then of v.
        sd_px: (n,).
        view_of: (k,) index of the camera among those used.
        centers_body: (k, 3) of the balls, mm.
        radii: (k,) mm.
        motion: (k, 6) how far the body has moved, at the picture's time, from where it is at the
            pose's time (mm, rad, world).
        spread: (k,) variance of each outline's own shift relative to the others'.
        rotations: (c, 3, 3) of camera_from_world.
        translations: (c, 3) of camera_from_world, mm.
    """

    start: Ints
    bearings: Floats
    slopes: Floats
    sd_px: Floats
    view_of: Ints
    centers_body: Floats
    radii: Floats
    motion: Floats
    spread: Floats
    rotations: Floats
    translations: Floats

    def points(self, i: int) -> slice:
        """Where ball-view i's points are."""
        return slice(int(self.start[i]), int(self.start[i + 1]))


class Balls(NamedTuple):
    """What is known of k ball-views besides their outlines; rows of `Contours`' arrays."""

    view_of: Ints
    centers_body: Floats
    radii: Floats
    spread: Floats

    def take(self, rows: list[int]) -> Balls:
        """Only some of them."""
        return Balls(
            self.view_of[rows], self.centers_body[rows], self.radii[rows], self.spread[rows]
        )


class Views(NamedTuple):
    """Lens rows (c, 13) of cameras, rotations (c, 3, 3) and translations (c, 3) into them."""

    lenses: Floats
    rotations: Floats
    translations: Floats


@lru_cache(maxsize=64)
def views_of(cameras: tuple[Camera, ...]) -> Views:
    """Cameras compare by identity: what is kept never stands for a camera that was changed."""
    inward = [camera.camera_from_world for camera in cameras]
    return Views(
        np.stack([camera.intrinsics.row for camera in cameras]),
        np.array([into.rotation for into in inward], order="C"),
        np.stack([into.translation for into in inward]),
    )


def pack(
    points: Sequence[Floats], sd: Sequence[Floats], balls: Balls, views: Views
) -> tuple[Contours, list[int]]:
    """Pack ball-views of a body at rest.

    Those with fewer than three points in reach of the lens model are left out.

    Args:
        points: k outlines (n, 2), px.
        sd: (n,) of each, px.
        balls: which they are.
        views: the cameras that saw them.

    Returns:
        The contours, and which of the k ball-views they are.
    """
    start = np.array([0, *accumulate(map(len, sd))])
    at, sd_px = np.concatenate(points), np.concatenate(sd)
    bearings, slopes, reached = rays_of(at, start, balls.view_of, views.lenses)
    kept = list(range(len(sd)))
    if sum(reached.tolist()) < len(at):
        good = np.isfinite(bearings[0])
        kept = np.flatnonzero(reached >= 3).tolist()
        good &= np.repeat(reached >= 3, np.diff(start))
        bearings, slopes, sd_px = bearings[:, good].copy(), slopes[:, good].copy(), sd_px[good]
        start = np.cumsum([0, *reached[kept]])
        balls = balls.take(kept)
    view_of, centers_body, radii, spread = balls
    return Contours(
        start,
        bearings,
        slopes,
        sd_px,
        view_of,
        centers_body,
        radii,
        np.zeros((len(kept), 6)),
        spread,
        views.rotations,
        views.translations,
    ), kept


@compiled
def rays_of(points: Floats, start: Ints, view: Ints, lenses: Floats) -> tuple[Floats, Floats, Ints]:
    """Bearings (3, n) of pixels (n, 2) and their slopes (6, n), see `Contours`; else NaN.

    And how many pixels of each ball-view (k,) have one.
    """
    n = len(points)
    bearings, slopes, reached = np.empty((3, n)), np.empty((6, n)), np.zeros(len(view), np.int64)
    for k in range(len(view)):
        lens = lenses[view[k]]
        dx, dy = 0.0, 0.0
        for i in range(start[k], start[k + 1]):
            dx, dy = bearing_and_slopes(points[i], lens, dx, dy, bearings[:, i], slopes[:, i])
            reached[k] += int(np.isfinite(bearings[0, i]))
    return bearings, slopes, reached
