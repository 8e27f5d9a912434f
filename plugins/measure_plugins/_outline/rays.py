"""Rays across a predicted outline: what the picture shows along them, and where they meet edges.

An edge is where a profile passes half-way between inside and outside. Profiles are (3, m, n):
colours, steps along the rays, rays; rays last, so that loops over them are vectorised, twice as
wide in single precision. See docs/explanation/outline.md, formulas 2, 11 and 12.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from measure.arrays import Bools, Bytes, Floats, Ints, Reals, Singles
from measure.compiling import compiled, inlined
from measure.model.lens import BLUE, RED, to_pixel
from measure.model.observations import FULL

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


_MIN_SD_PX = 0.03
"""Least standard deviation of a crossing: quantisation and interpolation leave as much."""
_SLOPE_PX = 4.0
"""Standard deviation in px of a crossing, per slope of the shading inside (share of contrast per
px): the slope over the 5 px to the window shifts the level, half of that the half level, which
costs 3 px per share of contrast on a blurred edge; half of the whole is taken."""

_Real = TypeVar("_Real", bound=np.floating[Any])


@compiled
def levels(profiles: NDArray[_Real], steps: Floats, window: tuple[float, float]) -> NDArray[_Real]:
    """Median colours (3, n) within a window.

    Args:
        profiles: (3, m, n).
        steps: (m,) px along the normal.
        window: its ends, px.
    """
    n, first, last = profiles.shape[2], 0, 0
    for step in steps:
        first += int(step < window[0])
        last += int(step <= window[1])
    within = np.empty((last - first, 3 * n), profiles.dtype)
    for j in range(last - first):
        for c in range(3):
            for i in range(n):
                within[j, c * n + i] = profiles[c, first + j, i]
    return median_rows(within).reshape(3, n)


@compiled
def median_rows(rows: NDArray[_Real]) -> NDArray[_Real]:
    """Medians (n,) over rows (k, n), which are sorted, place by place.

    By exchanges of neighbouring rows (odd-even transposition sort), whose loops are vectorised.
    """
    (count, n), half = rows.shape, rows.dtype.type(0.5)
    for turn in range(count):
        for j in range(turn % 2, count - 1, 2):
            for i in range(n):
                a, b = rows[j, i], rows[j + 1, i]
                rows[j, i], rows[j + 1, i] = a if a < b else b, b if a < b else a
    out = np.empty(n, rows.dtype)
    for i in range(n):
        out[i] = half * (rows[(count - 1) // 2, i] + rows[count // 2, i])
    return out


@compiled
def project(profiles: Reals, inside: Reals, outside: Reals, colorful: bool) -> tuple[Reals, Floats]:
    """Profiles along their inside-minus-outside colour: 1 inside, 0 outside.

    Args:
        profiles: (3, m, n).
        inside: (3, n) colour inside.
        outside: (3, n) colour outside.
        colorful: leave grey out of the difference, so that colourless reflections do not count.

    Returns:
        Shares (m, n), all 0 for a ray without contrast; contrast (n,).
    """
    m, n = profiles.shape[1:]
    x, contrast = np.empty((m, n), profiles.dtype), np.empty(n)
    toward, origin = np.empty((3, n), profiles.dtype), np.empty(n, profiles.dtype)
    for i in range(n):
        a, b, c = inside[0, i] - outside[0, i], inside[1, i] - outside[1, i], inside[2, i]
        c -= outside[2, i]
        if colorful:
            mean = (a + b + c) / 3
            a, b, c = a - mean, b - mean, c - mean
        square = a * a + b * b + c * c
        contrast[i] = np.sqrt(square)
        per = 1 / square if square > 1e-12 else 0.0
        toward[0, i], toward[1, i], toward[2, i] = a * per, b * per, c * per
        origin[i] = (outside[0, i] * a + outside[1, i] * b + outside[2, i] * c) * per
    for j in range(m):
        for i in range(n):
            x[j, i] = (
                profiles[0, j, i] * toward[0, i]
                + profiles[1, j, i] * toward[1, i]
                + profiles[2, j, i] * toward[2, i]
                - origin[i]
            )
    return x, contrast


@compiled
def crossings(x: Reals, steps: Floats, search_px: float) -> tuple[Reals, Reals]:
    """Where shares (m, n) fall through one half, nearest to 0 (formula 11).

    Args:
        steps: (m,) px along the normal, evenly spaced.
        search_px: the furthest crossing from 0.

    Returns:
        Crossing (n,) in px, NaN if there is none; and the slope there (n,) per px, positive.
    """
    m, n = x.shape
    number = x.dtype.type
    at, slope, furthest = np.full(n, number(np.inf)), np.zeros(n, x.dtype), number(search_px)
    step, half, one = number(steps[1] - steps[0]), number(0.5), number(1.0)
    for j in range(m - 1):
        here = number(steps[j])
        if not -furthest - step <= here <= furthest:
            continue
        for i in range(n):  # without branches, so that the loop is vectorised
            drop = x[j, i] - x[j + 1, i]
            falls = (x[j, i] > half) & (x[j + 1, i] <= half)
            s = here + (x[j, i] - half) / (drop if falls else one) * step
            nearest = falls & (abs(s) <= furthest) & (abs(s) < abs(at[i]))
            at[i] = s if nearest else at[i]
            slope[i] = drop / step if nearest else slope[i]
    for i in range(n):
        if at[i] == np.inf:
            at[i] = np.nan
    return at, slope


@compiled
def uncertainty(
    x: Reals, steps: Floats, at: Reals, slope: Reals, window: tuple[float, float]
) -> Floats:
    """Standard deviations (n,) in px of crossings, from noise and slope (formula 12).

    Args:
        x: (m, n) see `project`.
        steps: (m,) px along the normal.
        at: (n,) from `crossings`.
        slope: (n,) from `crossings`.
        window: where the inside colour was taken, px.
    """
    rough = _roughness(x, steps, at)
    uneven = _unevenness(x, steps, window)
    sd = np.empty(len(at))
    for i in range(len(at)):
        if slope[i] > 0:
            blurred = max(rough[i] / slope[i], _MIN_SD_PX)
            sd[i] = np.sqrt(blurred**2 + (_SLOPE_PX * uneven[i]) ** 2)
        else:
            sd[i] = np.inf
    return sd


@compiled
def _unevenness(x: Reals, steps: Floats, window: tuple[float, float]) -> Reals:
    """Absolute slope of normalised profiles over the inside window (n,), per px."""
    m, n = x.shape
    middle = 0.5 * (window[0] + window[1])
    rise, number = np.zeros(n, x.dtype), x.dtype.type
    low, high = 0, 0
    for j in range(m):
        low += window[0] <= steps[j] < middle
        high += middle < steps[j] <= window[1]
    for j in range(m):
        share = 0.0
        if window[0] <= steps[j] < middle:
            share = -1.0 / low
        elif middle < steps[j] <= window[1]:
            share = 1.0 / high
        if share != 0:
            weight = number(share)
            for i in range(n):
                rise[i] += weight * x[j, i]
    for i in range(n):
        rise[i] = abs(rise[i]) / (0.5 * (window[1] - window[0]))
    return rise


@compiled
def _roughness(x: Reals, steps: Floats, at: Reals) -> Reals:
    """Noise of normalised profiles (n,) more than 3 px from their edges, from second differences.

    Of samples a whole pixel apart: those between the same two pixels share their noise.
    """
    m, n = x.shape
    total, count, number = np.zeros(n, x.dtype), np.zeros(n, x.dtype), x.dtype.type
    none, one, two, far = number(0), number(1), number(2), number(3)
    apart = int(np.ceil(1 / (steps[1] - steps[0])))
    for j in range(2 * apart, m):
        middle = number(steps[j - apart])
        for i in range(n):
            second = abs(x[j, i] - two * x[j - apart, i] + x[j - 2 * apart, i])
            away = one if abs(middle - at[i]) > far else none
            total[i] += away * (second if second < one else one)
            count[i] += away
    for i in range(n):
        # Mean absolute value of a normal variable is 0.798 sd; second differences have sqrt(6) sd.
        total[i] = total[i] / count[i] / 0.798 / np.sqrt(6.0) if count[i] > 0 else 0.05
    return total


_WHITE, _PALE = 0.93, 0.6
"""Picture values, 0 to 1, above which a pixel is a highlight in all colours, and above which the
median of a ball's own inside is white itself."""
HIGHLIGHT_PX = 0.5
"""Standard deviation in px added to edges of rays that begin in a highlight. Of 0.5 and 1, compared
on scenes with known truth, the latter was worse under desk lamps."""


def clipped(pixels: Bytes, points: Floats, normals: Floats, steps: Floats) -> Bools:
    """Which of n rays meet a pixel that is saturated in one colour.

    Args:
        pixels: (h, w, 3).
        points: (n, 2) where the rays begin, px.
        normals: (n, 2) their unit directions.
        steps: (m,) px along the normals, where they are sampled.
    """
    at = np.rint(points + steps[:, None, None] * normals).astype(np.intp)
    height, width = pixels.shape[:2]
    column, row = np.clip(at[..., 0], 0, width - 1), np.clip(at[..., 1], 0, height - 1)
    return np.asarray(np.any(pixels[row, column] >= FULL, axis=(0, 2)))


@compiled
def in_highlights(inside: Reals, status: Statuses) -> Bools:
    """Which of n rays begin in a white highlight, on a ball that is not white itself.

    The edge such a ray shows near the rim is the highlight's, not the outline of the ball.

    Args:
        inside: (3, n) picture values inside the outline, from 0 to 1.
    """
    n = inside.shape[1]
    out, clear, count = np.zeros(n, np.bool_), np.empty(n), 0
    for i in range(n):
        white = min(inside[0, i], min(inside[1, i], inside[2, i]))
        out[i] = white > _WHITE
        if status[i] == CLEAR:
            clear[count] = white
            count += 1
    if count == 0 or np.median(clear[:count]) >= _PALE:
        out[:] = False
    return out
