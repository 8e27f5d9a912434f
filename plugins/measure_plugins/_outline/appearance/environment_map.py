"""What balls mirror of a room, as the camera's own pictures show that room.

Just inside its outline a ball turns the line of sight outwards by some tens of degrees. It goes on
away from the camera, into a part of the room that is in the camera's picture too, further out than
the ball: not as much further as the line of sight is turned, for the camera stands further back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled, inlined
from measure.geometry.linear_kernels import times
from measure_plugins._outline.appearance.radial_basis import DEFLECTIONS, FADE_RAD

_AHEAD = 0.2
"""Cosine from the optical axis of directions that no camera of this kind sees any more."""
_BEYOND_RAD = float(DEFLECTIONS[1] - DEFLECTIONS[0])
"""Past the picture's border colours go on, and are gone after the step in which mirrored directions
are told apart: a ball that moves must not see them end at once."""
_EVEN = 7
"""So many of these are even steps; further in, little is mirrored."""
_NOTHING = 1e-6


class Room(NamedTuple):
    """A camera's surroundings, coarsely, over even steps of the undistorted image plane.

    Attributes:
        colors: (h, w, 3) how far the light there is from grey, B G R; none (0, 0, 3) if not known.
        corner: (2,) x / z and y / z of the first of them.
        step: their distance in either direction.
        share: (4,) of the angle by which a ball turns a line of sight, how far from the ball the
            camera sees what it meets, on the right of the picture, below, on the left and above:
            what is near, like a floor, less than what is far.
        strength: (4,) how much of it is seen on balls, on these sides.
    """

    colors: Floats
    corner: Floats
    step: float
    share: Floats
    strength: Floats


def no_room() -> Room:
    """Nothing known."""
    return Room(np.zeros((0, 0, 3)), np.zeros(2), 1.0, np.zeros(4), np.zeros(4))


@compiled
def room_light(
    room: Room, grey: Floats, frame: Floats, half_angle: float, around: Floats
) -> Floats:
    """Colour (3, m, n) a ball mirrors beyond what is seen beside it; empty without a room.

    Found on every second ray: in between it is the mean of its neighbours.
    Where the room is as it is beside the ball, that is nothing; what is seen beside it, be it
    another ball, `radial.Radial.nearby` adds.

    Args:
        room: the surroundings.
        grey: (m, k) see `radial.Radial`.
        frame: (3, 3) about the ball's axis, see `rays.frame_about`.
        half_angle: of its cone, rad.
        around: (n, 2) cosine and sine around the axis.
    """
    n, known = len(around), room.colors.size > 0
    out = np.zeros((3, len(grey) if known else 0, n))
    if not known:
        return out
    colors = _at_knots(room, frame, half_angle, np.ascontiguousarray(around[::2]))
    some = np.zeros((len(grey), colors.shape[2]))
    for c in range(3):
        some[:] = 0.0
        times(grey, colors[c], some)
        for j in range(len(grey)):
            for i in range(colors.shape[2] - 1):
                out[c, j, 2 * i] = some[j, i]
                out[c, j, 2 * i + 1] = 0.5 * (some[j, i] + some[j, i + 1])
            out[c, j, 2 * colors.shape[2] - 2] = some[j, -1]
            if n % 2 == 0:
                out[c, j, n - 1] = 0.5 * (some[j, -1] + some[j, 0])
    return out


@compiled
def _at_knots(room: Room, frame: Floats, half_angle: float, around: Floats) -> Floats:
    """Colours (3, k, n) beyond those beside the ball, by how far it turns the line of sight."""
    n, sides, beside = len(around), np.empty(4), np.empty(3)
    colors, flat = np.zeros((3, len(DEFLECTIONS), n)), room.colors.reshape(-1)
    rows, columns = room.colors.shape[0], room.colors.shape[1]
    left, top, per = room.corner[0], room.corner[1], 1 / room.step
    row, one = np.uint64(3 * columns), np.uint64(3)
    for i in range(n):
        by_side(frame, around[i], sides)
        share, strength = _mean(room.share, sides), _mean(room.strength, sides)
        if strength < _NOTHING:
            continue
        x = around[i, 0] * frame[0, 0] + around[i, 1] * frame[1, 0]
        y = around[i, 0] * frame[0, 1] + around[i, 1] * frame[1, 1]
        z = around[i, 0] * frame[0, 2] + around[i, 1] * frame[1, 2]
        along, aside = np.cos(half_angle), np.sin(half_angle)
        cosine, sine = np.cos(share * _BEYOND_RAD), np.sin(share * _BEYOND_RAD)
        for k in range(_EVEN):
            depth = along * frame[2, 2] + aside * z
            deep = max(depth, _AHEAD)
            u = ((along * frame[2, 0] + aside * x) / deep - left) * per
            v = ((along * frame[2, 1] + aside * y) / deep - top) * per
            first, a, b, beyond = _place(u, v, rows, columns)
            weight = strength * max(1 - beyond * room.step / _BEYOND_RAD, 0.0)
            weight = weight if depth > _AHEAD else 0.0
            fades = max(1 - k * _BEYOND_RAD / FADE_RAD, 0.0)
            for c in range(3):
                at = np.uint64(first + c)  # unsigned: no look whether it counts from the end
                upper = (1 - a) * flat[at] + a * flat[at + one]
                lower = (1 - a) * flat[at + row] + a * flat[at + row + one]
                seen = (1 - b) * upper + b * lower
                if k == 0:
                    beside[c] = seen
                colors[c, k, i] = weight * (seen - fades * beside[c])
            along, aside = cosine * along - sine * aside, sine * along + cosine * aside
    return colors


@inlined
def _place(u: float, v: float, rows: int, columns: int) -> tuple[int, float, float, float]:
    """Where a place's upper left neighbour is, how far right of and below it, how far outside."""
    s, t = min(max(u, 0.0), columns - 1.001), min(max(v, 0.0), rows - 1.001)
    column, row = int(s), int(t)
    beyond = np.sqrt((u - s) ** 2 + (v - t) ** 2)
    return 3 * (row * columns + column), s - column, t - row, beyond


@inlined
def _mean(values: Floats, sides: Floats) -> float:
    return values[0] * sides[0] + values[1] * sides[1] + values[2] * sides[2] + values[3] * sides[3]


@compiled
def by_side(frame: Floats, around: Floats, out: Floats) -> None:
    """How much a direction about an axis is to the right, below, to the left and above (4,)."""
    x = around[0] * frame[0, 0] + around[1] * frame[1, 0]
    y = around[0] * frame[0, 1] + around[1] * frame[1, 1]
    per = 1 / (x * x + y * y)
    out[0], out[1] = max(x, 0.0) ** 2 * per, max(y, 0.0) ** 2 * per
    out[2], out[3] = min(x, 0.0) ** 2 * per, min(y, 0.0) ** 2 * per
