"""Point lights, by non-negative least squares over many places at once.

Few of the irradiances come out positive. Lights are common to all balls and pictures of a camera,
and to all cameras; each ball has an albedo of its own. Light from all round that changes linearly
from one side to the other has columns of its own, else it would be fitted by many point lights.
See docs/explanation/outline.md, formula 19.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats
from measure.compiling import compiled
from measure.geometry.covariance import MAD_TO_SD
from measure_plugins._outline.appearance import Appearance, split_light
from measure_plugins._outline.edges import sampled_light
from measure_plugins._outline.rays import STEPS, RaySet
from measure_plugins._outline.reflectance import (
    AXIAL,
    RADIAL,
    REFERENCE_MM,
    REWEIGHTINGS,
    UNIFORM,
    RadialTables,
    lights_about,
    no_point_lights,
    shade_by_lights,
    some_clear,
)
from measure_plugins._outline.response import BallPatch, misfits

_LIGHT_COUNT = 200
_LIGHT_DISTANCE_MM = 1000.0
"""Assumed distance of the lights from the balls, between that of desk and ceiling lamps; or that of
the camera if it is further away."""
_OUTERMOST_PX = -1.0  # Last step along the normal that is used
_STEP_STRIDE = 2
_SKY_COLUMNS = 6  # Columns of light from all round, see `_skies`
_SWEEPS = 400
_RIDGE = 3e-4
"""Ridge, per mean of the normal matrix's diagonal: it shares power among neighbouring places
between which the pictures do not distinguish."""
_EXPOSURE_ITERATIONS = 16  # Alternations between the cameras' exposures and the lights' powers
_TINY = 1e-12
_MIN_POWER_SHARE = 0.01  # Lights below this share of the total power are left out


class LightEquations(NamedTuple):
    """Normal equations of the powers (m,) of lights, from the balls in one camera's pictures."""

    # (k, 4) lights of irradiance 1 in the camera frame, in the world's directions; the other
    # powers, m - k = 6 of them, are of light from all round, by the world's axes.
    places: Floats
    normal: Floats  # (m, m) normal matrix, per variance of the residuals
    right: Floats  # (m,) their right side


def with_point_lights(
    patches: Sequence[BallPatch], appearance: Appearance, light: LightEquations
) -> Appearance:
    """The appearance with the point lights by `light`, if these improve the fit."""
    without = replace(appearance, point_lights=no_point_lights())
    lit = replace(appearance, point_lights=solve_point_lights([light]))
    if len(lit.point_lights) == 0:
        return without
    ratios = misfits(patches, lit) / misfits(patches, without)
    return lit if float(np.mean(np.log(ratios))) < 0 else without


def solve_point_lights(lights: Sequence[LightEquations]) -> Floats:
    """Point lights (k, 4), in the frame of the first camera, by the equations of all cameras.

    Each camera has an exposure of its own, estimated in turn with the powers.

    Args:
        lights: of one or more cameras about the same body.
    """
    own, others = lights[0], lights[1:]
    power = _solve(own.normal, own.right, np.zeros(len(own.right)))
    for _ in range(_EXPOSURE_ITERATIONS if others else 0):
        normal, right = own.normal.copy(), own.right.copy()
        for other in others:
            expected = max(float(power @ other.normal @ power), _TINY)
            exposure = max(float(power @ other.right) / expected, 0.0)
            normal += exposure**2 * other.normal
            right += exposure * other.right
        power = _solve(normal, right, power)
    point_lights, power = own.places.copy(), power[: len(own.places)]
    point_lights[:, 3] *= power
    return point_lights[power > _MIN_POWER_SHARE * power.sum()]


def light_equations(
    patches: Sequence[BallPatch], appearance: Appearance, world_from_camera: Floats
) -> LightEquations:
    """Equations of the lights from the shading of balls, robustly; `world_from_camera` (3, 3)."""
    middle = np.mean([patch.distance * patch.frame[2] for patch in patches], axis=0)
    places = _light_sphere(middle, world_from_camera)
    shares, seen = [], []
    for patch in patches:
        tables = appearance.tables(patch.half_angle * patch.scale, patch.half_angle)
        one, amounts = _light_design(
            patch.pixels,
            appearance.table,
            patch.own_rays(),
            tables,
            patch.frame @ world_from_camera.T,
            lights_about(places, patch.frame, patch.distance),
        )
        shares.append(one)
        bright = max(float(np.quantile(amounts, 0.9)), 1e-6)
        seen.append(amounts / bright)
    return LightEquations(places, *equations(shares, seen))


def _light_sphere(middle: Floats, world_from_camera: Floats) -> Floats:
    """Lights (k, 4) of irradiance 1 at a place (3,) in mm, evenly round it on a spiral."""
    i = np.arange(_LIGHT_COUNT) + 0.5
    height, turn = 1 - 2 * i / _LIGHT_COUNT, np.pi * (1 + np.sqrt(5.0)) * i
    radial = np.sqrt(1 - height**2)
    distance_mm = max(_LIGHT_DISTANCE_MM, float(np.linalg.norm(middle)))
    directions = np.column_stack([radial * np.cos(turn), radial * np.sin(turn), height])
    power = np.full(_LIGHT_COUNT, (distance_mm / REFERENCE_MM) ** 2)
    return np.column_stack([middle + distance_mm * directions @ world_from_camera, power])


def equations(shares: Sequence[Floats], seen: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Normal equations (k, k), (k,) of powers, of amounts (p,) by shares (p, k); albedos fitted."""
    albedo, weights = np.ones(len(seen)), [np.ones(len(one)) for one in seen]
    power, variance = np.zeros(shares[0].shape[1]), 1.0
    for turn in range(REWEIGHTINGS):
        normal, right = np.zeros((len(power), len(power))), np.zeros(len(power))
        for one, amounts, scale, w in zip(shares, seen, albedo, weights, strict=True):
            add_normal(scale * one, w, amounts, normal, right)
        normal, right = (normal + np.tril(normal, -1).T) / variance, right / variance
        if turn == REWEIGHTINGS - 1:
            break
        power, left = _solve(normal, right, power), np.zeros(2)
        for i, (one, amounts) in enumerate(zip(shares, seen, strict=True)):
            lit = one @ power
            off = amounts - albedo[i] * lit
            limit = 5 * MAD_TO_SD * np.median(np.abs(off)) + 1e-6
            weights[i] = np.clip(1 - (off / limit) ** 2, 0, None) ** 4
            shown = weights[i] * lit
            albedo[i] = float(shown @ amounts) / max(float(shown @ lit), 1e-9)
            left += weights[i] @ off**2, weights[i].sum()
        variance = max(float(left[0] / left[1]), _TINY)
    return normal, right


def _solve(normal: Floats, right: Floats, start: Floats) -> Floats:
    """Powers (m,), none negative, by their normal equations."""
    ridge = _RIDGE * np.mean(np.diag(normal)) * np.eye(len(right))
    power = start.copy()
    descend(normal + ridge, (normal + ridge) @ power - right, power, _SWEEPS)
    return power


@compiled
def add_normal(
    shares: Floats, weights: Floats, amounts: Floats, normal: Floats, right: Floats
) -> None:
    """Add the normal equations of amounts (p,) by shares (p, k); of `normal` the lower half."""
    for i in range(len(amounts)):
        for a in range(len(right)):
            weighted = weights[i] * shares[i, a]
            if weighted == 0:  # half of all lights are below a pixel's horizon
                continue
            right[a] += weighted * amounts[i]
            for b in range(a + 1):
                normal[a, b] += weighted * shares[i, b]


@compiled
def descend(normal: Floats, slope: Floats, out: Floats, sweeps: int) -> None:
    """Non-negative least squares (k,) by coordinate descent (Franc et al. 2005), in place.

    Args:
        normal: (k, k) normal matrix.
        slope: (k,) `normal @ out` less the right side.
    """
    for _ in range(sweeps):
        for k in range(len(out)):
            if normal[k, k] > 0:
                step = max(out[k] - slope[k] / normal[k, k], 0.0) - out[k]
                if step != 0:
                    out[k] += step
                    for j in range(len(out)):
                        slope[j] += step * normal[k, j]


def _light_design(
    pixels: Bytes,
    table: Floats,
    rays: RaySet,
    tables: RadialTables,
    frame: Floats,
    point_lights: Floats,
) -> tuple[Floats, Floats]:
    """Light of each point light, and from all round, at some of a ball's clear pixels.

    Returns:
        That (p, k + 6), see `_skies`; and the amounts (p,) of the body colour seen there.
    """
    light, background = sampled_light(pixels, table, rays)
    inside = int(np.searchsorted(STEPS, _OUTERMOST_PX, side="right"))
    _, amounts, _, _ = split_light(light, rays.status, background, STEPS, tables, inside)
    used, clear = np.arange(0, inside, _STEP_STRIDE), some_clear(rays.status)
    rows, angles = tables.diffuse[used], rays.around[clear]
    loss = tables.fresnel_loss[0]
    lit = [shade_by_lights(rows, loss, angles, one[None]) for one in point_lights]
    out = np.concatenate([np.stack(lit, axis=2), _skies(rows, angles, frame)], axis=2)
    return out.reshape(-1, out.shape[2]), amounts[used][:, clear].ravel()


def _skies(diffuse: Floats, around: Floats, frame: Floats) -> Floats:
    """The light (m, n, 6) of skies that fade linearly from one side to none on the opposite.

    By the side from which most comes: either way along the camera's x, y and z.

    Args:
        frame: (3, 3) about the axis.
    """
    uniform, radial, axial = (diffuse[:, [k], None] for k in (UNIFORM, RADIAL, AXIAL))
    gradient = radial * (around @ frame[:2]) - axial * frame[2]
    both = np.stack([uniform + gradient, uniform - gradient], axis=-1)
    return both.reshape(len(diffuse), len(around), _SKY_COLUMNS)
