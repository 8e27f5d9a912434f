"""The light that a ball sends: diffuse and mirrored, along rays across its outline.

The formulas are those of docs/explanation/outline.md. Diffuse light leaves a glossy surface through
a boundary whose reflectance rises towards grazing angles (Fresnel): it fades to nothing at the
outline, and the reflection of the surroundings takes its place. Shading by distant lights is a
quadratic polynomial of the normal (Ramamoorthi and Hanrahan 2001); around the view axis it is a sum
of angular times six radial functions, and all that is costly depends on the radius alone (1, 2, 4,
5, 7 and 8).

Shading is fitted robustly to what is seen of it. Where point lights are known, it is an even light,
one linear in the normal, and the lights together: five functions (6). Elsewhere it is a quadratic
polynomial of the normal: nine, each one of six radial functions times an angular one (7).

A point light adds the cosine of incidence, and nothing beyond its terminator, where a polynomial of
the normal would become negative. Light that enters a glossy surface is weakened by its Fresnel
reflectance (5). Lights are rows (k, 4): place in the camera frame in mm, and irradiance one metre
away in any unit; seen from a ball, unit direction and irradiance there. They are near, so that
their terminators differ from ball to ball.

Each pixel inside is split into an amount of the body colour and an amount of grey, the reflected
light (the dichromatic reflection model, Shafer 1985). The former is fitted along the whole outline,
the latter ray by ray (3 and 8). Profiles are (3, m, n): colours, steps along the rays, rays.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints, Singles
from measure.compiling import compiled, inlined
from measure.geometry.covariance import MAD_TO_SD
from measure.geometry.kernels import cholesky, solve_factored
from measure_plugins._outline.rays import CLEAR, FITTED_RAYS, STEPS, Statuses

DEFLECTIONS = np.radians([0, 10, 20, 30, 40, 50, 60, 75])
"""Angles in rad by which the ball deflects the line of sight: the knots of the reflected light."""
REFRACTIVE_INDEX = 1.5
"""Of clear plastics and lacquers (1.45 to 1.6)."""
BLUR_PX = 1.0
"""Blur of a webcam's optics, pixels, colour mosaic and interpolation, before it is estimated."""
_FINE = np.arange(-24.0, 12.01, 0.25)
_INSIDE = (_FINE < 0).astype(np.float64)
_WIDTHS = np.diff(DEFLECTIONS)
_REFLECTION_RANGE_PX = (-13.0, 0.6)
_REFLECTION_USED = (
    np.abs(STEPS - np.mean(_REFLECTION_RANGE_PX))[:, None] <= np.ptp(_REFLECTION_RANGE_PX) / 2
)
_STIFFNESS, _FIRM = 0.02, 1e3
_SLANTING = 0.3  # Cosine at which Schlick's formula is fitted to a surface
FADE_RAD = np.radians(40)
_LOBES = 6


class RadialTables(NamedTuple):
    """Blurred radial functions at `STEPS`."""

    diffuse: Floats  # (m, 6) of the diffuse light, see `_lobes`
    grey: Floats  # (m, k) of light reflected from the directions around each of `DEFLECTIONS`
    grazing_reflection: Floats  # (m,) of what is right behind the ball, mirrored at grazing angles
    outside: Floats  # (m,) of the background outside the outline
    # (1,) share of light that the surface reflects at grazing incidence; at other incidence it is
    # (1 - cosine)^5 times as much (Schlick 1994).
    fresnel_loss: Floats
    # (k, m) from a profile to the reflected light, smooth where unobserved.
    reflection_solver: Floats
    reflection_prior: Floats  # (k,) from the grey of the background to the same


def radial_tables(
    radius_px: float, half_angle: float, blur_px: float, index: float, mirrors: bool = True
) -> RadialTables:
    """Tables for a ball; radius, angle and blur are rounded to negligible steps.

    Args:
        half_angle: of its cone, rad.
        index: refractive index of the surface.
        mirrors: whether the colours behind are mirrored at grazing angles.
    """
    size, angle, blur = round(4 * radius_px), round(200 * half_angle), round(20 * blur_px)
    return _radial(size, angle, blur, index, mirrors)


@lru_cache(maxsize=1024)
def _radial(radius4: int, angle200: int, blur20: int, index: float, mirrors: bool) -> RadialTables:
    half_angle = max(angle200, 1) / 200
    tilt, cosine = _surface(half_angle, half_angle / (radius4 / 4))
    mirrored = fresnel(cosine, index) * _INSIDE
    deflection = 2 * np.arcsin(np.clip(cosine, 0, 1))
    shown = np.concatenate(
        [
            (_INSIDE - mirrored) * _lobes(tilt),
            mirrored * _hats(deflection),
            [mirrored * np.clip(1 - deflection / FADE_RAD, 0, 1), 1 - _INSIDE],
        ]
    )
    blurred = _blur(blur20) @ shown.T
    grey = np.ascontiguousarray(blurred[:, _LOBES:-2])
    solve, tie = _reflection_solver(grey)
    return RadialTables(
        diffuse=np.ascontiguousarray(blurred[:, :_LOBES]),
        grey=grey,
        grazing_reflection=mirrors * blurred[:, -2],
        outside=np.ascontiguousarray(blurred[:, -1]),
        fresnel_loss=_fresnel_loss(index),
        reflection_solver=solve,
        reflection_prior=tie,
    )


@lru_cache(maxsize=64)
def _fresnel_loss(index: float) -> Floats:
    """See `RadialTables`: 0 of paint without a boundary, 1 of clear plastic (formula 5)."""
    straight, slanting = fresnel(np.array([1.0, _SLANTING]), index)
    return np.array([min((slanting - straight) / (1 - straight) / (1 - _SLANTING) ** 5, 1.0)])


def fresnel(cosine: Floats, index: float) -> Floats:
    """Reflected share of unpolarised light at a cosine of incidence; 0 for index 1 (formula 4)."""
    if index == 1:
        return np.zeros_like(cosine)
    transmitted = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * transmitted) / (cosine + index * transmitted)
    along = (index * cosine - transmitted) / (index * cosine + transmitted)
    return np.asarray(0.5 * (across**2 + along**2))


def _surface(half_angle: float, rad_per_px: float) -> tuple[Floats, Floats]:
    """Tilt of the normal from the axis and cosine of incidence, along the fine ray (formula 1)."""
    beta = np.maximum(half_angle + _FINE * rad_per_px, 0.0)
    incidence = np.arcsin(np.minimum(np.sin(beta) / np.sin(half_angle), 1.0))
    return incidence - beta, np.cos(incidence)


def _lobes(tilt: Floats) -> Floats:
    """Radial factors (6, n) of the quadratic polynomials of the normal (formula 7)."""
    s, c = np.sin(tilt), np.cos(tilt)
    return np.array([np.ones_like(s), c, 3 * c * c - 1, s, s * c, s * s])


def _hats(deflection: Floats) -> Floats:
    """Linear interpolation weights (k, n) of `DEFLECTIONS` at `deflection` (n,)."""
    last = len(DEFLECTIONS) - 2
    lower = np.minimum(np.searchsorted(DEFLECTIONS, deflection, side="right") - 1, last)
    start, width = DEFLECTIONS[lower], _WIDTHS[lower]
    share = np.minimum((deflection - start) / width, 1.0)
    out, each = np.zeros((len(DEFLECTIONS), len(deflection))), np.arange(len(deflection))
    out[lower, each], out[lower + 1, each] = 1 - share, share
    return out


@lru_cache(maxsize=64)
def _blur(blur20: int) -> Floats:
    """From the fine ray to `STEPS` (m, f)."""
    kernel = np.exp(-0.5 * ((STEPS[:, None] - _FINE[None, :]) / (blur20 / 20)) ** 2)
    return np.asarray(kernel / kernel.sum(axis=1, keepdims=True))


def _reflection_solver(grey: Floats) -> tuple[Floats, Floats]:
    """Ridge regression of the reflected light, smooth, and tied to the background (formula 8)."""
    design = grey * _REFLECTION_USED
    inverse = np.linalg.inv(design.T @ design + _REFLECTION_PRIOR)
    return np.ascontiguousarray(inverse @ design.T), np.ascontiguousarray(_FIRM * inverse[:, 0])


def _reflection_normal() -> Floats:
    """What the prior adds to the normal matrix (k, k)."""
    bend = np.diff(np.eye(len(DEFLECTIONS)), 2, axis=0)
    out = _STIFFNESS * bend.T @ bend + 1e-6 * np.eye(len(DEFLECTIONS))
    out[0, 0] += _FIRM
    return np.asarray(out)


_REFLECTION_PRIOR = _reflection_normal()


UNIFORM, AXIAL, RADIAL = 0, 1, 3
"""Columns of `RadialTables.diffuse` for uniform light, and light linear in the normal."""
_LOBE = np.array([0, 1, 2, 3, 3, 4, 4, 5, 5])
"""Which radial function each of the nine angular terms goes with."""
REWEIGHTINGS = 4


@compiled
def some_clear(status: Statuses) -> Ints:
    """Indices (k,) of the clear rays, by the `status` (n,), to which light is fitted."""
    return np.nonzero(status == CLEAR)[0][:: max(len(status) // FITTED_RAYS, 1)]


@compiled
def shading_functions(around: Floats, diffuse: Floats, lighted: Floats) -> Floats:
    """What shading is a sum of: (t, m, n), of five terms or nine.

    Args:
        lighted: (m, n) see `shade_by_lights`; empty if no lights are known.
    """
    m, n, known = len(diffuse), len(around), lighted.size > 0
    out = np.empty((5 if known else 9, m, n))
    for i in range(n):
        x, y = around[i, 0], around[i, 1]
        if known:
            for j in range(m):
                out[0, j, i], out[1, j, i] = diffuse[j, UNIFORM], diffuse[j, AXIAL]
                out[2, j, i], out[3, j, i] = diffuse[j, RADIAL] * x, diffuse[j, RADIAL] * y
                out[4, j, i] = lighted[j, i]
            continue
        angular = (1.0, 1.0, 1.0, x, y, x, y, x * x - y * y, 2 * y * x)
        for k in range(9):
            for j in range(m):
                out[k, j, i] = diffuse[j, _LOBE[k]] * angular[k]
    return out


@compiled
def fit_shading(amounts: Floats, status: Statuses, functions: Floats, used: int) -> Floats:
    """Coefficients (t,) of `shading_functions`, by least squares with Tukey's weights.

    Args:
        amounts: (m, n) of the body colour.
        functions: (t, m, n).
        used: how many steps to use; every second one is.
    """
    rays, terms = some_clear(status), len(functions)
    coefficients, right = np.zeros(terms), np.empty(terms)
    if len(rays) == 0:
        return coefficients
    seen = _every_second(amounts, used, rays)
    design = np.empty((terms, len(seen)))
    for k in range(terms):
        design[k] = _every_second(functions[k], used, rays)
    weights, weighted = np.ones(len(seen)), np.empty(design.shape)
    factor = np.empty((terms, terms))
    for turn in range(REWEIGHTINGS):
        for k in range(terms):
            for i in range(len(seen)):
                weighted[k, i] = weights[i] * design[k, i]
        cholesky(np.dot(weighted, design.T) + 1e-3 * np.eye(terms), factor)
        right[:] = np.dot(weighted, seen)
        solve_factored(factor, right, coefficients)
        if turn < REWEIGHTINGS - 1:
            off = seen - np.dot(coefficients, design)
            sizes = np.abs(off[::3])
            typical = np.partition(sizes, len(sizes) // 2)[len(sizes) // 2]
            per_limit = 1 / (5 * MAD_TO_SD * typical + 5e-4)
            for i in range(len(seen)):
                root = max(1 - (off[i] * per_limit) ** 2, 0.0)
                weights[i] = root * root
    return coefficients


@compiled
def _every_second(values: Floats, used: int, rays: Ints) -> Floats:
    """Every second of the first `used` rows of (m, n), on the rays (k,), one after the other."""
    return values[:used:2][:, rays].reshape(-1)


@compiled
def shaded(coefficients: Floats, functions: Floats) -> Floats:
    """Diffuse light (m, n) by coefficients (t,) of functions (t, m, n)."""
    out = coefficients[0] * functions[0]
    for k in range(1, len(coefficients)):
        out += coefficients[k] * functions[k]
    return out


REFERENCE_MM = 1000.0
"""The distance at which a light's irradiance is stated."""
_MIN_UNIFORM = 1e-4  # Diffuse light below which a step along a ray lies past the blurred outline
_NONE, _ONE = np.float32(0), np.float32(1)


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


GREY = 1 / np.sqrt(3.0)
COLORLESS = 0.15
"""Sine of the angle between a ball's colour and grey below which the two are indistinguishable."""
_OWN_LAST_PX = -3.0
_NEIGHBOURS = tuple(float(w) for w in np.exp(-0.5 * (np.arange(5) / 1.5) ** 2))
"""Weights of a ray and of those one to four further on: a normal distribution of sd 1.5 rays."""


@compiled
def body_color(profiles: Floats, status: Statuses, steps: Floats) -> Floats:
    """Unit colour (3,) of the body reflection: the mean of the least grey well-lit pixels.

    NaN if no pixel is clear and lit.
    """
    m, n = profiles.shape[1:]
    every = max(n // FITTED_RAYS, 1)
    colors = np.empty((3, n * m))
    brightest, greyness = np.empty(n * m), np.empty(n * m)
    count = 0
    for j in range(0, m, 3):
        if steps[j] > _OWN_LAST_PX:
            break
        for i in range(0, n, every):
            if status[i] == CLEAR:
                b, g, r = profiles[0, j, i], profiles[1, j, i], profiles[2, j, i]
                colors[0, count], colors[1, count], colors[2, count] = b, g, r
                brightest[count] = max(b, g, r)
                greyness[count] = (b + g + r) * GREY / np.sqrt(b * b + g * g + r * r + 1e-12)
                count += 1
    brightest, greyness = brightest[:count], greyness[:count]
    if count == 0 or np.max(brightest) <= 0:
        return np.full(3, np.nan)
    high = int(0.9 * (count - 1))
    lit = brightest > 0.25 * np.partition(brightest, high)[high]
    low = int(0.15 * (np.count_nonzero(lit) - 1))
    chosen = lit & (greyness <= np.partition(greyness[lit], low)[low])
    out = np.zeros(3)
    for k in range(count):
        if chosen[k]:
            for c in range(3):
                out[c] += colors[c, k]
    return out / np.sqrt(np.sum(out**2))


@compiled
def split(
    blue: Floats, green: Floats, red: Floats, own: Floats, amount: Floats, grey: Floats
) -> None:
    """Fill amounts (n,) of body colour and grey in colours (n,), by least squares (formula 3)."""
    b = np.sum(own) * GREY
    apart = 1 - b * b
    separable = apart > COLORLESS**2
    per, mixed, greyness = 1 / apart, b / apart, 1.0
    if not separable:
        per, mixed, greyness = 1.0, 0.0, 0.0
    for i in range(len(amount)):
        p = blue[i] * own[0] + green[i] * own[1] + red[i] * own[2]
        q = (blue[i] + green[i] + red[i]) * GREY
        amount[i] = per * p - mixed * q
        grey[i] = greyness * (per * q - mixed * p)


@compiled
def reflected_light(grey: Floats, status: Statuses, solve: Floats) -> Floats:
    """Reflected light (k, n) from amounts of grey (m, n) along the rays (formula 8).

    Args:
        grey: (m, n).
        solve: (k, m) from a profile to the reflected light.

    Returns:
        Weighted means over neighbouring clear rays.
    """
    knots, n = len(solve), grey.shape[1]
    seen = np.nonzero(solve[0])[0]
    single, shares = np.zeros((knots + 1, n)), np.zeros((knots + 1, n))
    if len(seen) > 0:  # else the surface reflects nothing
        first, last = seen[0], seen[-1] + 1
        seen_by = np.ascontiguousarray(solve[:, first:last])
        single[:knots] = np.dot(seen_by, grey[first:last])
    single[knots] = 1.0
    _sum_of_neighbours(single, status, shares)
    out = shares[:knots]
    for k in range(knots):
        for i in range(n):
            out[k, i] /= shares[knots, i] + 1e-9
    return out


@compiled
def _sum_of_neighbours(rows: Floats, status: Statuses, out: Floats) -> None:
    """Fill `out` (k, n) with weighted sums of rows (k, n) over neighbouring clear rays."""
    n = rows.shape[1]
    reach = len(_NEIGHBOURS) - 1
    a, b, c, d, e = _NEIGHBOURS
    ring = np.empty(n + 2 * reach)
    for k in range(len(rows)):
        for i in range(n):
            ring[reach + i] = rows[k, i] if status[i] == CLEAR else 0.0
        for i in range(reach):
            ring[i], ring[reach + n + i] = ring[n + i], ring[reach + i]
        for i in range(n):
            near = a * ring[i + 4] + b * (ring[i + 3] + ring[i + 5])
            far = d * (ring[i + 1] + ring[i + 7]) + e * (ring[i] + ring[i + 8])
            out[k, i] = near + c * (ring[i + 2] + ring[i + 6]) + far
