"""Rays across a predicted outline: where they cross it, and what the picture shows along them.

See docs/explanation/outline.md, formula 2.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from measure.arrays import Bools, Bytes, Floats, Ints, Reals, Singles
from measure.compiling import compiled, inlined
from measure.model.lens import BLUE, RED, to_pixel

STEPS = np.arange(-16.5, 6.51, 1.0)
"""Samples along a ray, px along the outward normal: a pixel apart, as the picture's pixels are, and
half a pixel to either side of the outline, so that an edge lies between two of them."""
CLEAR, OCCLUDED, OUT_OF_IMAGE = 0, 1, 2
"""Status of a ray: nothing in its way, a nearer ball in front of it, or it leaves the image."""
Statuses: TypeAlias = NDArray[np.int8]

_LEVEL = np.float32(1 / 255)
_TILT = 1e-4  # Angle in rad over which the outline's normal and scale are taken


class RaySet(NamedTuple):
    """n rays across a predicted outline."""

    points: Floats  # (n, 2) where they cross it, px
    normals: Floats  # (n, 2) its outward unit normals there
    around: Floats  # (n, 2) cosine and sine of their angles around the axis of the ball's cone
    # (n,) int8, CLEAR, OCCLUDED or OUT_OF_IMAGE each; sampling sets the last in place.
    status: Statuses
    # (3, n, 2) px from where green is to where blue, green and red of the same light are (lateral
    # colour); (0, n, 2) for a lens without.
    color_shifts: Floats


@compiled
def frame_about(axis: Floats) -> Floats:
    """Rows e1, e2, axis: a right-handed frame about a unit vector (3,) (formula 2).

    It is continuous in the axis wherever a camera looks, so that what is known about one axis, ray
    by ray or along e1 and e2, holds for its neighbours (Duff et al. 2017, "Building an Orthonormal
    Basis, Revisited").
    """
    x, y, z = axis[0], axis[1], axis[2]
    sign = 1.0 if z >= 0 else -1.0
    per = -1 / (sign + z)
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = 1 + sign * x * x * per, sign * x * y * per, -sign * x
    out[1, 0], out[1, 1], out[1, 2] = x * y * per, sign + y * y * per, -y
    out[2, 0], out[2, 1], out[2, 2] = x, y, z
    return out


@compiled
def angles_around(count: int) -> Floats:
    """Cosine and sine (count, 2) of the angles of evenly spaced rays around an axis.

    Each is the one before turned by their distance, which costs no cosine.
    """
    out = np.empty((count, 2))
    x, y = 1.0, 0.0
    cosine, sine = np.cos(2 * np.pi / count), np.sin(2 * np.pi / count)
    for i in range(count):
        out[i, 0], out[i, 1] = x, y
        x, y = cosine * x - sine * y, sine * x + cosine * y
    return out


@compiled
def cast_rays(frame: Floats, half_angle: float, count: int, lens: Floats) -> tuple[RaySet, Floats]:
    """Evenly spaced clear rays across a cone's outline; its scale along normals (n,), px/rad."""
    points, normals, scale = np.empty((count, 2)), np.empty((count, 2)), np.empty(count)
    around, at, beyond = angles_around(count), np.empty((2, count)), np.empty((2, count))
    _project_ring(frame, half_angle, around, lens, at)
    _project_ring(frame, half_angle + _TILT, around, lens, beyond)
    for i in range(count):
        u, v = at[0, i], at[1, i]
        right, down = beyond[0, i] - u, beyond[1, i] - v
        length = np.sqrt(right**2 + down**2)
        points[i, 0], points[i, 1] = u, v
        normals[i, 0], normals[i, 1] = right / length, down / length
        scale[i] = length / _TILT
    shifts = _color_shifts(points, lens)
    return RaySet(points, normals, around, np.zeros(count, np.int8), shifts), scale


@compiled
def _color_shifts(points: Floats, lens: Floats) -> Floats:
    """Shifts of the colours at pixels (n, 2), see `RaySet`."""
    if lens[RED] == 0 and lens[BLUE] == 0:
        return np.empty((0, len(points), 2))
    out = np.zeros((3, len(points), 2))
    for i in range(len(points)):
        for axis in range(2):
            away = points[i, axis] - lens[2 + 2 * axis]
            out[0, i, axis], out[2, i, axis] = lens[BLUE] * away, lens[RED] * away
    return out


@compiled
def _project_ring(
    frame: Floats, half_angle: float, around: Floats, lens: Floats, out: Floats
) -> None:
    """Fill pixels (2, n) of the directions at `half_angle` from `frame[2]`, at (n, 2) around it."""
    near, radial = np.cos(half_angle), np.sin(half_angle)
    a, b, c = near * frame[2, 0], near * frame[2, 1], near * frame[2, 2]
    for i in range(len(around)):
        cosine, sine = around[i, 0], around[i, 1]
        x = cosine * frame[0, 0] + sine * frame[1, 0]
        y = cosine * frame[0, 1] + sine * frame[1, 1]
        z = cosine * frame[0, 2] + sine * frame[1, 2]
        out[0, i], out[1, i] = to_pixel(a + radial * x, b + radial * y, c + radial * z, lens)


@compiled
def radius_px(axis: Floats, half_angle: float, lens: Floats) -> float:
    """Mean radius of an outline, as the scale across it times its half angle."""
    _, scale = cast_rays(frame_about(axis), half_angle, 8, lens)
    return half_angle * float(np.mean(scale))


@compiled
def mark_occluded(
    rays: RaySet,
    scale: Floats,
    frame: Floats,
    half_angle: float,
    nearer: Floats,
    reach: tuple[float, float],
    margin_px: float,
) -> None:
    """Set the status of rays that pass within `margin_px` of a nearer ball to OCCLUDED.

    Args:
        scale: (n,) px per rad, from `cast_rays`.
        frame: (3, 3) of the cone, see `frame_about`.
        half_angle: of the cone, rad.
        nearer: (k, 4) unit axes and half angles of the outlines of nearer balls.
        reach: start and end of the rays along the normal, px.
    """
    if len(nearer) == 0:
        return
    around = rays.around
    least = np.min(scale)
    near = _near(frame, half_angle, nearer, (reach[1] + margin_px) / least)
    axial, radial = np.cos(half_angle), np.sin(half_angle)
    far_px = margin_px + max(abs(reach[0]), abs(reach[1]))
    for k in near:
        meets = np.cos(nearer[k, 3] + far_px / least)
        for i in range(len(scale)):
            if _cosine(frame, around[i], axial, radial, nearer[k]) > meets:
                hides = np.cos(nearer[k, 3] + margin_px / scale[i])
                for step in range(5):
                    s = reach[0] + (reach[1] - reach[0]) * step / 4
                    beta = half_angle + s / scale[i]
                    if _cosine(frame, around[i], np.cos(beta), np.sin(beta), nearer[k]) > hides:
                        rays.status[i] = OCCLUDED


@compiled
def _cosine(frame: Floats, around: Floats, axial: float, radial: float, ball: Floats) -> float:
    """Of the angle between a ball's axis and a direction of these components about `frame[2]`."""
    total = 0.0
    for a in range(3):
        side = around[0] * frame[0, a] + around[1] * frame[1, a]
        total += (axial * frame[2, a] + radial * side) * ball[a]
    return total


@compiled
def _near(frame: Floats, half_angle: float, nearer: Floats, reach: float) -> Ints:
    """Which of the nearer balls' outlines come within reach, in rad, of this one at all."""
    found = np.empty(len(nearer), np.int64)
    count = 0
    for k in range(len(nearer)):
        cosine = 0.0
        for a in range(3):
            cosine += frame[2, a] * nearer[k, a]
        if cosine > np.cos(min(half_angle + nearer[k, 3] + reach, np.pi)):
            found[count] = k
            count += 1
    return found[:count]


@compiled
def sample(
    image: Bytes, table: Floats, rays: RaySet, steps: Floats, light_wanted: Bools, values_from: int
) -> tuple[Singles, Singles]:
    """Light and picture values along the rays, both by bilinear interpolation.

    Args:
        image: (h, w, 3) uint8.
        table: (256,) light of each picture value.
        rays: n rays; clear ones are sampled; those that leave the picture are marked.
        steps: (m,) px along the normals.
        light_wanted: (m,) at which steps; light is zero at the others.
        values_from: the first step at which picture values are wanted.

    Returns:
        Light (3, m, n), and values from 0 to 1 (3, m - values_from, n), in single precision; zeros
        on rays that are not clear.
    """
    n = len(rays.points)
    light = np.zeros((3, len(steps), n), np.float32)
    values = np.zeros((3, len(steps) - values_from, n), np.float32)
    _mark_outside(image, rays, steps)
    flat, row, light_of = image.reshape(-1), 3 * image.shape[1], table.astype(np.float32)
    shifted, at = len(rays.color_shifts) > 0, 0
    upper_left = upper_right = lower_left = lower_right = np.float32(0)
    for i in range(n):  # ray by ray: a ray's pixels are near each other in memory
        if rays.status[i] != CLEAR:
            continue
        for j in range(len(steps)):
            u = rays.points[i, 0] + steps[j] * rays.normals[i, 0]
            v = rays.points[i, 1] + steps[j] * rays.normals[i, 1]
            for c in range(3):
                if c == 0 or shifted:
                    right_by, down_by = _shift(rays.color_shifts, c, i)
                    x, y = np.floor(u + right_by), np.floor(v + down_by)
                    a, b = u + right_by - x, v + down_by - y
                    upper_left, upper_right = np.float32((1 - a) * (1 - b)), np.float32(a * (1 - b))
                    lower_left, lower_right = np.float32((1 - a) * b), np.float32(a * b)
                    at = int(y) * row + 3 * int(x)
                # Unsigned indices: no check for negative ones.
                p, q = flat[np.uint64(at + c)], flat[np.uint64(at + c + 3)]
                r, s = flat[np.uint64(at + c + row)], flat[np.uint64(at + c + row + 3)]
                if light_wanted[j]:
                    upper = upper_left * light_of[p] + upper_right * light_of[q]
                    light[c, j, i] = upper + lower_left * light_of[r] + lower_right * light_of[s]
                if j >= values_from:
                    left = upper_left * np.float32(p) + lower_left * np.float32(r)
                    right = upper_right * np.float32(q) + lower_right * np.float32(s)
                    values[c, j - values_from, i] = (left + right) * _LEVEL
    return light, values


@inlined
def _shift(shifts: Floats, color: int, i: int) -> tuple[float, float]:
    return (shifts[color, i, 0], shifts[color, i, 1]) if len(shifts) > 0 else (0.0, 0.0)


@compiled
def sample_nearest(image: Bytes, table: Floats, rays: RaySet, steps: Floats) -> Singles:
    """Light (3, m, n) of the nearest pixels; else as `sample`."""
    points, normals = rays.points, rays.normals
    m, n = len(steps), len(points)
    light = np.zeros((3, m, n), np.float32)
    _mark_outside(image, rays, steps)
    for j in range(m):
        for i in range(n):
            if rays.status[i] != CLEAR:
                continue
            x = np.uint64(points[i, 0] + steps[j] * normals[i, 0] + 0.5)
            y = np.uint64(points[i, 1] + steps[j] * normals[i, 1] + 0.5)
            for c in range(3):
                light[c, j, i] = table[image[y, x, c]]
    return light


@compiled
def _mark_outside(image: Bytes, rays: RaySet, steps: Floats) -> None:
    """Set the status of clear rays that leave the picture to OUT_OF_IMAGE."""
    points, normals = rays.points, rays.normals
    height, width = image.shape[:2]
    margin = np.max(np.abs(rays.color_shifts)) if len(rays.color_shifts) > 0 else 0.0
    right, down = width - 1 - margin, height - 1 - margin
    for i in range(len(points)):
        if rays.status[i] != CLEAR:
            continue
        for end in (steps[0], steps[len(steps) - 1]):
            u, v = points[i, 0] + end * normals[i, 0], points[i, 1] + end * normals[i, 1]
            if not (u >= margin and v >= margin and u < right and v < down):
                rays.status[i] = OUT_OF_IMAGE


FITTED_RAYS = 36  # Light and the body colour are fitted to about so many rays, evenly spaced
TOGETHER = 2
"""Rays in a group, to whose mean profile the predicted picture is fitted: that of one ray would
follow its noise. With three, which are further apart, predictions are worse."""


@compiled
def middle_angles(around: Floats) -> Floats:
    """Cosine and sine (n / 2, 2) of the angles midway between the rays of each group (n, 2)."""
    out = np.zeros((len(around) // TOGETHER, 2))
    for i in range(len(out)):
        x, y = 0.0, 0.0
        for k in range(TOGETHER):
            x += around[TOGETHER * i + k, 0]
            y += around[TOGETHER * i + k, 1]
        length = np.sqrt(x * x + y * y)
        out[i, 0], out[i, 1] = x / length, y / length
    return out


@compiled
def together(light: Reals, status: Statuses) -> tuple[Floats, Statuses]:
    """Mean light of the clear rays of each group, and the status of the groups.

    Args:
        light: (3, m, n) along the rays.

    Returns:
        Light (3, m, n / 2); and status (n / 2,): CLEAR where a ray is, else that of the first.
    """
    colors, m, n = light.shape
    groups = n // TOGETHER
    weights, grouped = np.zeros((TOGETHER, groups)), np.empty(groups, np.int8)
    for i in range(groups):
        count = 0
        for k in range(TOGETHER):
            count += int(status[TOGETHER * i + k] == CLEAR)
        grouped[i] = CLEAR if count > 0 else status[TOGETHER * i]
        for k in range(TOGETHER):
            weights[k, i] = 1 / count if status[TOGETHER * i + k] == CLEAR else 0.0
    out = np.empty((colors, m, groups))
    for c in range(colors):
        for j in range(m):
            for i in range(groups):
                total = 0.0
                for k in range(TOGETHER):
                    total += weights[k, i] * light[c, j, TOGETHER * i + k]
                out[c, j, i] = total
    return out, grouped
