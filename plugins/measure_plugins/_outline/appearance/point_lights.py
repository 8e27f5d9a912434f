"""Diffuse shading of a ball by a few point lights.

A point light adds the cosine of incidence, and nothing beyond its terminator, where a polynomial of
the normal would become negative. Light that enters a glossy surface is weakened by its Fresnel
reflectance. Lights are rows (k, 4): place in the camera frame in mm, and irradiance one metre away
in any unit; seen from a ball, unit direction and irradiance there. They are near, so that their
terminators differ from ball to ball. See docs/explanation/outline.md, formulas 5 and 6.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints, Singles
from measure.compiling import compiled, inlined
from measure.geometry.covariance import MAD_TO_SD
from measure.geometry.linear_kernels import cholesky, solve_factored
from measure_plugins._outline.appearance.dichromatic import every_second
from measure_plugins._outline.sampling.rays import CLEAR, Statuses

REFERENCE_MM = 1000.0
"""The distance at which a light's irradiance is stated."""
_ITERATIONS = 4
_COLUMNS = 5
_FITTED_RAYS = 36  # Light is fitted to about so many rays, evenly spaced
_LANES = 2 * _FITTED_RAYS  # An upper limit of their number
_MIN_UNIFORM = 1e-4  # Diffuse light below which a step along a ray lies past the blurred outline
_NONE, _ONE = np.float32(0), np.float32(1)
UNIFORM, AXIAL, RADIAL = 0, 1, 3
"""Columns of `RadialTables.diffuse` for uniform light, and light linear in the normal."""


def no_point_lights() -> Floats:
    """The array (0, 4) of no lights."""
    return np.zeros((0, 4))


@compiled
def lights_about(point_lights: Floats, frame: Floats, distance: float) -> Floats:
    """Lights (k, 4) as a ball sees them, in the frame about its axis.

    Args:
        point_lights: (k, 4) in the camera frame.
        frame: (3, 3) see `rays.frame_about`.
        distance: of the ball, mm.
    """
    out, way = np.empty_like(point_lights), np.empty(3)
    for k in range(len(point_lights)):
        for a in range(3):
            way[a] = point_lights[k, a] - distance * frame[2, a]
        square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
        per = 1 / np.sqrt(square)
        for a in range(3):
            out[k, a] = per * (frame[a, 0] * way[0] + frame[a, 1] * way[1] + frame[a, 2] * way[2])
        out[k, 3] = point_lights[k, 3] * REFERENCE_MM**2 / square
    return out


@compiled
def shade_by_lights(
    diffuse: Floats, fresnel_loss: float, around: Floats, point_lights: Floats
) -> Floats:
    """Diffuse light (m, n) of a ball by point lights, along its rays; (0, n) without lights.

    Args:
        diffuse: (m, 6) see `RadialTables`.
        fresnel_loss: see `RadialTables`.
        around: (n, 2) cosine and sine around the axis.
        point_lights: (k, 4) seen from the ball.
    """
    n, out = len(around), np.zeros((len(diffuse) if len(point_lights) > 0 else 0, len(around)))
    rows = 0
    for j in range(len(out)):
        if diffuse[j, UNIFORM] > _MIN_UNIFORM:
            rows = j + 1
    # The places of all steps in one row, for one long vectorised loop per light.
    places = rows * n
    ahead, right = np.zeros(places, np.float32), np.zeros(places, np.float32)
    down, total = np.zeros(places, np.float32), np.zeros(places, np.float32)
    for j in range(rows):
        uniform = diffuse[j, UNIFORM]
        if uniform > _MIN_UNIFORM:
            axial, radial = diffuse[j, AXIAL] / uniform, diffuse[j, RADIAL] / uniform
            for i in range(n):
                ahead[j * n + i] = -axial
                right[j * n + i] = radial * around[i, 0]
                down[j * n + i] = radial * around[i, 1]
    for k in range(len(point_lights)):
        _add_light(point_lights[k], fresnel_loss, right, down, ahead, total)
    for j in range(rows):
        for i in range(n):
            out[j, i] = diffuse[j, UNIFORM] * total[j * n + i]
    return out


@inlined
def _add_light(
    source: Floats, fresnel_loss: float, right: Singles, down: Singles, ahead: Singles, out: Singles
) -> None:
    """Add the shading by one light to the sums (k,) (formula 5).

    Args:
        source: (4,) the light, seen from the ball.
        fresnel_loss: see `RadialTables`.
        right: (k,) first component of the surface normals.
        down: (k,) their second component.
        ahead: (k,) their component along the ball's axis.
        out: (k,) changed.
    """
    x, y, z = np.float32(source[0]), np.float32(source[1]), np.float32(source[2])
    power, kept = np.float32(source[3]), np.float32(source[3] * fresnel_loss)
    for i in range(len(out)):
        light = x * right[i] + y * down[i] + z * ahead[i]
        light = light if light > _NONE else _NONE
        slant = _ONE - light
        slant = slant if slant > _NONE else _NONE
        square = slant * slant
        out[i] += light * (power - kept * (square * square * slant))


@compiled
def fit_light_shading(
    amounts: Floats, status: Statuses, around: Floats, diffuse: Floats, lighted: Floats, used: int
) -> Floats:
    """Coefficients (5,) of point lights and of light linear in the normal, robustly (formula 6).

    Args:
        amounts: (m, n) of the body colour.
        status: (n,) see `RaySet`.
        around: (n, 2) cosine and sine around the axis.
        diffuse: (m, 6) see `RadialTables`.
        lighted: (m, n) see `shade_by_lights`.
        used: how many steps to use, of which every second one is.

    Returns:
        Factors of uniform light, of axial light, of that along the other axes, and of `lighted`.
    """
    clear = some_clear(status)
    if len(clear) == 0:
        return np.zeros(_COLUMNS)
    factors, angles = _factors(diffuse[:used:2]), around[clear]
    seen, bright = every_second(amounts, used, clear), every_second(lighted, used, clear)
    coefficients, right = np.zeros(_COLUMNS), np.empty(_COLUMNS)
    factor, normal = np.empty((_COLUMNS, _COLUMNS)), np.empty((_COLUMNS, _COLUMNS))
    per_limit = 0.0
    for turn in range(_ITERATIONS):
        sums = _along_rays(seen, bright, factors, angles, coefficients, per_limit)
        _equations(sums, angles, normal, right)
        cholesky(normal, factor)
        solve_factored(factor, right, coefficients)
        if turn < _ITERATIONS - 1:
            off = _median_residual(seen, bright, factors, angles, coefficients)
            per_limit = 1 / (5 * MAD_TO_SD * off + 5e-4)
    return coefficients


@compiled
def some_clear(status: Statuses) -> Ints:
    """Indices (k,) of the clear rays, by the `status` (n,), to which light is fitted."""
    return np.nonzero(status == CLEAR)[0][:: max(len(status) // _FITTED_RAYS, 1)]


@compiled
def _factors(diffuse: Floats) -> Floats:
    """Columns (3, p) of uniform light, of axial and of radial light."""
    out = np.empty((3, len(diffuse)))
    for j in range(len(diffuse)):
        out[0, j], out[1, j] = diffuse[j, UNIFORM], diffuse[j, AXIAL]
        out[2, j] = diffuse[j, RADIAL]
    return out


@compiled
def _median_residual(
    seen: Floats, bright: Floats, factors: Floats, angles: Floats, coefficients: Floats
) -> float:
    """Median absolute residual of every third pixel."""
    p, n = len(seen), len(angles)
    sizes, count = np.empty(-(-p * n // 3)), 0
    uniform, axial, x, y, power = coefficients
    for j in range(p):
        common, radial = uniform * factors[0, j] + axial * factors[1, j], factors[2, j]
        for i in range((-j * n) % 3, n, 3):
            sideways = x * angles[i, 0] + y * angles[i, 1]
            sizes[count] = abs(seen[j, i] - (common + radial * sideways + power * bright[j, i]))
            count += 1
    return float(np.partition(sizes, len(sizes) // 2)[len(sizes) // 2])


@compiled
def _equations(sums: Floats, angles: Floats, normal: Floats, right: Floats) -> None:
    """Normal matrix (5, 5), its lower half, and right side (5,) from `_along_rays`' sums."""
    normal[:], right[:] = 1e-3 * np.eye(_COLUMNS), 0.0
    for i in range(len(angles)):
        x, y = angles[i]
        normal[0, 0] += sums[0, i]
        normal[1, 0] += sums[1, i]
        normal[1, 1] += sums[2, i]
        normal[2, 0] += x * sums[3, i]
        normal[2, 1] += x * sums[4, i]
        normal[2, 2] += x * x * sums[5, i]
        normal[3, 0] += y * sums[3, i]
        normal[3, 1] += y * sums[4, i]
        normal[3, 2] += y * x * sums[5, i]
        normal[3, 3] += y * y * sums[5, i]
        normal[4, 0] += sums[6, i]
        normal[4, 1] += sums[7, i]
        normal[4, 2] += x * sums[8, i]
        normal[4, 3] += y * sums[8, i]
        normal[4, 4] += sums[9, i]
        right[0] += sums[10, i]
        right[1] += sums[11, i]
        right[2] += x * sums[12, i]
        right[3] += y * sums[12, i]
        right[4] += sums[13, i]


@compiled
def _along_rays(
    seen: Floats,
    bright: Floats,
    factors: Floats,
    angles: Floats,
    coefficients: Floats,
    per_limit: float,
) -> Floats:
    """Sums along each ray that the normal equations are made of, without the angular factors.

    Args:
        seen: (p, n) amounts of the body colour, see `every_second`.
        bright: (p, n) shading by the point lights there.
        factors: (3, p) see `_factors`.
        angles: (k, 2) cosine and sine around the axis of the first k <= n of the rays.
        coefficients: (5,) about which Tukey's weights are taken.
        per_limit: 1 / their limit; 0 for equal weights.

    Returns:
        (14, _LANES), of whose columns the first k count: rows of constant length are vectorised.
    """
    p, n = seen.shape
    sums, sideways = np.zeros((14, _LANES)), np.zeros(n)
    uniform_by, axial_by, x_by, y_by, power = coefficients
    for i in range(len(angles)):
        sideways[i] = x_by * angles[i, 0] + y_by * angles[i, 1]
    for j in range(p):
        uniform, axial, radial = factors[0, j], factors[1, j], factors[2, j]
        common = uniform_by * uniform + axial_by * axial
        for i in range(n):
            b, s = bright[j, i], seen[j, i]
            t = (s - (common + radial * sideways[i] + power * b)) * per_limit
            root = 1 - t * t
            root = root if root > 0.0 else 0.0
            w = root * root
            lighted, shown = w * b, w * s
            sums[0, i] += uniform * uniform * w
            sums[1, i] += uniform * axial * w
            sums[2, i] += axial * axial * w
            sums[3, i] += uniform * radial * w
            sums[4, i] += axial * radial * w
            sums[5, i] += radial * radial * w
            sums[6, i] += uniform * lighted
            sums[7, i] += axial * lighted
            sums[8, i] += radial * lighted
            sums[9, i] += b * lighted
            sums[10, i] += uniform * shown
            sums[11, i] += axial * shown
            sums[12, i] += radial * shown
            sums[13, i] += b * shown
    return sums


@compiled
def shaded_body(
    coefficients: Floats, around: Floats, diffuse: Floats, lighted: Floats, first: int
) -> Floats:
    """Diffuse light (m - first, n) by the coefficients of `fit_light_shading`."""
    return _light(coefficients, around, _factors(diffuse[first:]), lighted[first:])


@compiled
def _light(coefficients: Floats, angles: Floats, factors: Floats, bright: Floats) -> Floats:
    """Diffuse light (p, n); arguments as of `_along_rays`."""
    uniform, axial, x, y, power = coefficients
    out, sideways = np.empty(bright.shape), np.empty(len(angles))
    for i in range(len(angles)):
        sideways[i] = x * angles[i, 0] + y * angles[i, 1]
    for j in range(len(bright)):
        common, radial = uniform * factors[0, j] + axial * factors[1, j], factors[2, j]
        for i in range(len(angles)):
            out[j, i] = common + radial * sideways[i] + power * bright[j, i]
    return out
