"""Learning what a camera's balls mirror of the room: from pictures of the room, without the balls.

How far from a ball the camera sees what the ball mirrors depends on how far the walls are. That is
told, on each side, by the colours that balls show and do not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Bytes, Floats
from measure.compiling import compiled
from measure.model.lens import bearing, to_pixel
from measure_plugins._outline.appearance.dichromatic import COLORLESS, GREY, own_color
from measure_plugins._outline.appearance.environment_map import Room, by_side, no_room, room_light
from measure_plugins._outline.appearance.model import GLOSSY, Appearance
from measure_plugins._outline.fitting.edges import sampled_light
from measure_plugins._outline.sampling.rays import CLEAR, STEPS
from measure_plugins._outline.self_calibration.patch import Sight

_LONGER = 80
"""Places along the longer side of a picture: what balls mirror is blurred more than that."""
_SAMPLES = 4
"""Pixels looked at in either direction of each place."""
_WIDEST = 2.0
"""Tangent of the angle from the optical axis up to which a room is taken down."""
_WIDER = 1.15
"""Balls are cut out somewhat larger than they are, for they are blurred."""
_MIRRORING_PX = (-6.0, 0.0)
"""Where a ball mirrors enough to tell, px along the outward normal."""
_FEWEST_RAYS = 16
_NOTHING = 1e-20
_ALIKE = 0.25
"""Mean correlation above which a room is believed to be mirrored: in three recordings in coloured
rooms it is at least 0.27, in ten others at most 0.24 and mostly less than 0.15, by chance."""
_SHARES = (0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
"""What is mirrored lies from a quarter as far from the ball as the camera is to nearly infinitely
far."""


class Backdrop(NamedTuple):
    """One picture without its balls, over even steps of the undistorted image plane.

    Attributes:
        sums: (h, w, 3) of picture values from 0 to 1.
        counts: (h, w) how many values were added up.
        corner: (2,) x / z and y / z of the first place.
        step: distance of the places.
    """

    sums: Floats
    counts: Floats
    corner: Floats
    step: float


class _Foreign(NamedTuple):
    """What of a sight's light has a colour that neither its ball nor grey light has.

    Attributes:
        sight: the ball.
        way: (3,) unit vector of that colour, B G R.
        rows: (m,) which of `STEPS` are told.
        clear: (n,) which rays are.
        grey: see `radial.Radial`.
        seen: how much there is of it on these rows and rays, less what is seen beside the ball.
    """

    sight: Sight
    way: Floats
    rows: Bools
    clear: Bools
    grey: Floats
    seen: Floats


def backdrop_of(pixels: Bytes, lens: Floats, balls: Floats) -> Backdrop:
    """A picture without its balls.

    Args:
        pixels: (h, w, 3) the picture.
        lens: (13,) lens row.
        balls: (k, 4) unit axes and half angles of the outlines of all balls.
    """
    low, high = _seen(pixels.shape[1], pixels.shape[0], lens)
    step = float(np.max(high - low)) / _LONGER
    columns, rows = np.maximum(np.round((high - low) / step), 2).astype(int)
    corner = low + step / 2
    sums, counts = np.zeros((rows, columns, 3)), np.zeros((rows, columns))
    _add_up(pixels, lens, balls, corner, step, sums, counts)
    return Backdrop(sums / 255, counts, corner, step)


def _seen(width: int, height: int, lens: Floats) -> tuple[Floats, Floats]:
    """Least and greatest x / z and y / z (2,) that a picture shows."""
    sides = np.array([0.0, 0.5, 1.0])
    pixels = np.array([[x * (width - 1), y * (height - 1)] for x in sides for y in sides])
    rays = np.array([bearing(pixel, lens) for pixel in pixels])
    rays = rays[rays[:, 2] > 0]
    plane = np.clip(rays[:, :2] / rays[:, 2:], -_WIDEST, _WIDEST)
    return plane.min(axis=0), plane.max(axis=0)


@compiled
def _add_up(
    pixels: Bytes,
    lens: Floats,
    balls: Floats,
    corner: Floats,
    step: float,
    sums: Floats,
    counts: Floats,
) -> None:
    """Add up picture values (h, w, 3) round each place, where no ball is, and count them (h, w)."""
    height, width = pixels.shape[0], pixels.shape[1]
    for row in range(_SAMPLES * len(sums)):
        y = corner[1] + step * ((row + 0.5) / _SAMPLES - 0.5)
        for column in range(_SAMPLES * sums.shape[1]):
            x = corner[0] + step * ((column + 0.5) / _SAMPLES - 0.5)
            u, v = to_pixel(x, y, 1.0, lens)
            if not (0 <= u < width - 0.5 and 0 <= v < height - 0.5) or _in_ball(x, y, balls):
                continue
            i, j = row // _SAMPLES, column // _SAMPLES
            counts[i, j] += 1
            for c in range(3):
                sums[i, j, c] += pixels[int(v + 0.5), int(u + 0.5), c]


@compiled
def _in_ball(x: float, y: float, balls: Floats) -> bool:
    length = np.sqrt(x * x + y * y + 1)
    for k in range(len(balls)):
        cosine = (x * balls[k, 0] + y * balls[k, 1] + balls[k, 2]) / length
        if cosine > np.cos(_WIDER * balls[k, 3]):
            return True
    return False


def room_of(backdrops: Sequence[Backdrop], table: Floats) -> Room:
    """The room that pictures of one camera show, far away; none if they show nothing but balls.

    Args:
        backdrops: the pictures without their balls.
        table: (256,) light of each picture value.
    """
    sums = np.sum([one.sums for one in backdrops], axis=0)
    counts = np.sum([one.counts for one in backdrops], axis=0)
    known = counts > 0
    if not known.any():
        return no_room()
    values = sums / np.maximum(counts, 1)[..., None]
    light = np.interp(values, np.arange(len(table)) / (len(table) - 1), table)
    light = _filled(light, known)
    colors = light - light.mean(axis=-1, keepdims=True)
    return Room(colors, backdrops[0].corner, backdrops[0].step, np.ones(4), np.ones(4))


def _filled(light: Floats, known: Bools) -> Floats:
    """Light (h, w, 3) with places that are not `known` (h, w) filled from beside, inwards."""
    light, done = light * known[..., None], known.astype(np.float64)
    while not done.all():
        near, count = _around(light), _around(done)
        new = (done == 0) & (count > 0)
        light[new], done[new] = near[new] / count[new][:, None], 1.0
    return light


def _around(values: Floats) -> Floats:
    """Sums over each place and its eight neighbours (h, w, ...)."""
    pad = np.pad(values, [(1, 1), (1, 1)] + [(0, 0)] * (values.ndim - 2))
    rows, columns = values.shape[:2]
    places = [(i, j) for i in range(3) for j in range(3)]
    return np.asarray(sum(pad[i : i + rows, j : j + columns] for i, j in places))


def with_room(
    sights: Sequence[Sight], appearance: Appearance, backdrops: Sequence[Backdrop]
) -> Appearance:
    """The appearance with the room its balls mirror, on the sides on which they are seen to.

    Told by the one direction of colour that neither a ball's own light has nor grey light: what
    shows there inside an outline is mirrored, however the ball is lit.
    """
    told = [one for sight in sights if (one := _foreign(sight, appearance)) is not None]
    if not told or not backdrops or appearance.index != GLOSSY:
        return appearance
    room = room_of(backdrops, appearance.table)
    if room.colors.size == 0:
        return appearance
    rooms = [room._replace(share=np.full(4, share)) for share in _SHARES]
    alike = np.array([_likeness(told, one) for one in rooms])
    best = np.argmax(alike, axis=0)
    most = np.maximum(alike.max(axis=0), 0.0)
    if np.mean(most) < _ALIKE:
        return appearance
    believed = most > 0
    shares = np.where(believed, np.array(_SHARES)[best], 0.0)
    return replace(appearance, room=room._replace(share=shares, strength=believed.astype(float)))


def _foreign(sight: Sight, appearance: Appearance) -> _Foreign | None:
    """A sight's foreign colour that is not seen beside the ball; None if it cannot be told."""
    rays = sight.own_rays()
    tables = appearance.tables(sight.half_angle * sight.scale, sight.half_angle)
    light, background = sampled_light(sight.pixels, appearance.table, rays)
    clear = rays.status == CLEAR
    if np.count_nonzero(clear) < _FEWEST_RAYS:
        return None
    way = np.cross(own_color(light, rays.status, STEPS), np.full(3, GREY))
    if np.linalg.norm(way) < COLORLESS:
        return None
    way /= np.linalg.norm(way)
    first, last = _MIRRORING_PX
    rows = (first < STEPS) & (last > STEPS)
    beside = (tables.outside + tables.nearby)[rows, None] * (way @ background)
    seen = np.tensordot(way, light[:, rows], 1) - beside
    return _Foreign(sight, way, rows, clear, tables.grey, seen[:, clear])


def _likeness(told: Sequence[_Foreign], room: Room) -> Floats:
    """Correlation (4,), by side, of the foreign colour that sights show and of a room's.

    Not how much of the former the latter leaves: how much is mirrored is known from the surface,
    and shows weaker where things are not quite where they are taken to be.
    """
    seen2, mirrored2, both = np.zeros(4), np.zeros(4), np.zeros(4)
    for one in told:
        sight = one.sight
        light = room_light(room, one.grey, sight.frame, sight.half_angle, sight.rays.around)
        mirrored = np.tensordot(one.way, light[:, one.rows][:, :, one.clear], 1)
        sides = np.zeros((np.count_nonzero(one.clear), 4))
        for i, around in enumerate(sight.rays.around[one.clear]):
            by_side(sight.frame, around, sides[i])
        seen2 += np.sum(one.seen**2, axis=0) @ sides
        mirrored2 += np.sum(mirrored**2, axis=0) @ sides
        both += np.sum(mirrored * one.seen, axis=0) @ sides
    return both / np.sqrt(np.maximum(seen2 * mirrored2, _NOTHING))
