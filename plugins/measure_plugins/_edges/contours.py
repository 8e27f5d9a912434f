"""All outlines of one frame set, packed for the joint fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.compiling import compiled
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
    rotations: Floats
    translations: Floats

    def points(self, i: int) -> slice:
        """Where ball-view i's points are."""
        return slice(int(self.start[i]), int(self.start[i + 1]))


class Seen(NamedTuple):
    """One ball-view to pack: its points (n, 2) and sd (n,) in px, and a row of the rest."""

    points_px: Floats
    sd_px: Floats
    view: int
    center_body: Floats
    radius_mm: float
    motion: Floats


def pack(
    seen: Sequence[Seen], lenses: Floats, rotations: Floats, translations: Floats
) -> tuple[Contours, list[int]]:
    """Pack ball-views; those with fewer than three points in reach of the lens model are left out.

    Args:
        seen: the ball-views.
        lenses: (c, 13) lens rows.
        rotations: (c, 3, 3) of camera_from_world.
        translations: (c, 3) of camera_from_world.

    Returns:
        The contours, and which of `seen` they are.
    """
    points = np.concatenate([one.points_px for one in seen])
    sd = np.concatenate([one.sd_px for one in seen])
    start = np.cumsum([0, *(len(one.sd_px) for one in seen)])
    view = np.array([one.view for one in seen])
    bearings, slopes = rays_of(points, start, view, lenses)
    good = np.isfinite(bearings[0])
    kept = list(range(len(seen)))
    if not good.all():
        counts = np.add.reduceat(good.astype(np.int64), start[:-1])
        kept = [i for i in kept if counts[i] >= 3]
        good &= np.repeat(np.isin(np.arange(len(seen)), kept), np.diff(start))
        bearings, slopes, sd = bearings[:, good].copy(), slopes[:, good].copy(), sd[good]
        start = np.cumsum([0, *counts[kept]])
    contours = Contours(
        start,
        bearings,
        slopes,
        sd,
        view[kept],
        np.array([seen[i].center_body for i in kept]).reshape(-1, 3),
        np.array([seen[i].radius_mm for i in kept]),
        np.array([seen[i].motion for i in kept]).reshape(-1, 6),
        rotations,
        translations,
    )
    return contours, kept


@compiled
def rays_of(points: Floats, start: Ints, view: Ints, lenses: Floats) -> tuple[Floats, Floats]:
    """Bearings (3, n) of pixels (n, 2) and their slopes (6, n), see `Contours`; else NaN."""
    n = len(points)
    bearings, slopes = np.empty((3, n)), np.empty((6, n))
    for k in range(len(view)):
        lens = lenses[view[k]]
        dx, dy = 0.0, 0.0
        for i in range(start[k], start[k + 1]):
            dx, dy = bearing_and_slopes(points[i], lens, dx, dy, bearings[:, i], slopes[:, i])
    return bearings, slopes
