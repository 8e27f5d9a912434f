"""Learning where the light on a camera's balls comes from.

Many places are tried at once, each with an irradiance that cannot be negative: that leaves a
handful. They are the same for all balls and pictures of a camera, so that what one ball hides in
its shade another shows, and the same for all cameras; each ball has an albedo of its own. Light
from all round, which changes evenly from one side to the other, needs no lamps, and must not pass
for many.

Sums over pixels are loops of our own: a linear algebra library parts products of this size among
threads, which wait for one another where cameras are measured side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats
from measure.compiling import compiled
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.appearance.point_lights import (
    ASIDE,
    FACING,
    REFERENCE_MM,
    UNIFORM,
    lamp_light,
    no_lamps,
    seen_from,
    some_clear,
)
from measure_plugins._outline.appearance.radial_basis import Radial
from measure_plugins._outline.appearance.render import split_light
from measure_plugins._outline.fitting.edges import sampled_light
from measure_plugins._outline.sampling.rays import STEPS, RaySet
from measure_plugins._outline.self_calibration.patch import Sight
from measure_plugins._outline.self_calibration.response_and_blur import misfits

_DIRECTIONS = 200
_AWAY_MM = 1000.0
"""How far lamps are taken to be from the balls, between those on a desk and those on a ceiling;
further only where the camera is."""
_LAST_PX = -1.0
"""Pixels nearer to the outline are left to what is found there later."""
_EVERY = 2
_ALL_ROUND = 6
"""Columns of `_from_all_round`."""
_ROUNDS = 4
_SWEEPS = 400
_SPREAD = 3e-4
"""Ridge, as a share of the mean of the normal matrix's diagonal: where pictures do not tell, light
is rather shared by neighbouring places than given to one."""
_EXPOSURES = 16
"""So often are exposures and powers told by one another."""
_NOTHING = 1e-12
_FAINT = 0.01
"""Lamps that give less than this share of the light are left out."""


class Light(NamedTuple):
    """What balls in one camera's pictures say of the light on them: equations of its powers (m,).

    Attributes:
        places: (k, 4) lamps of irradiance 1 in the camera frame, in the world's directions; the
            other powers, m - k = 6 of them, are of light from all round, by the world's axes.
        normal: (m, m) normal equations, per variance of what the light leaves unexplained.
        right: (m,) their right side.
    """

    places: Floats
    normal: Floats
    right: Floats


def with_lamps(sights: Sequence[Sight], appearance: Appearance, light: Light) -> Appearance:
    """The appearance with the lamps that `light` asks for, if pictures then look more like it."""
    without = replace(appearance, lamps=no_lamps())
    lit = replace(appearance, lamps=lamps_by([light]))
    if len(lit.lamps) == 0:
        return without
    gain = np.log(misfits(sights, lit) / misfits(sights, without))
    return lit if float(np.mean(gain)) < 0 else without


def lamps_by(lights: Sequence[Light]) -> Floats:
    """Lamps (k, 4), in the frame of the first camera, that explain what all the cameras say.

    Cameras see the same light, each by an exposure of its own, which follows from what the powers
    would be by the light so far.

    Args:
        lights: of one or more cameras about the same body.
    """
    own, others = lights[0], lights[1:]
    power = _solved(own.normal, own.right, np.zeros(len(own.right)))
    for _ in range(_EXPOSURES if others else 0):
        normal, right = own.normal.copy(), own.right.copy()
        for other in others:
            expected = max(float(power @ _product(other.normal, power)), _NOTHING)
            exposure = max(float(power @ other.right) / expected, 0.0)
            normal += exposure**2 * other.normal
            right += exposure * other.right
        power = _solved(normal, right, power)
    lamps, power = own.places.copy(), power[: len(own.places)]
    lamps[:, 3] *= power
    return lamps[power > _FAINT * power.sum()]


def light_on(sights: Sequence[Sight], appearance: Appearance, world_from_camera: Floats) -> Light:
    """What the balls' shading says of the light, robustly.

    Args:
        sights: the balls.
        appearance: how the camera shows them.
        world_from_camera: (3, 3) how the camera is turned.
    """
    middle = np.mean([sight.distance * sight.frame[2] for sight in sights], axis=0)
    places = _all_round(middle, world_from_camera)
    shares, seen = [], []
    for sight in sights:
        tables = appearance.tables(sight.half_angle * sight.scale, sight.half_angle)
        one, amounts = _shaded(
            sight.pixels,
            appearance.table,
            sight.own_rays(),
            tables,
            sight.frame @ world_from_camera.T,
            seen_from(places, sight.frame, sight.distance),
        )
        shares.append(one)
        bright = max(float(np.quantile(amounts, 0.9)), 1e-6)
        seen.append(amounts / bright)
    return Light(places, *equations(shares, seen))


def _all_round(middle: Floats, world_from_camera: Floats) -> Floats:
    """Lamps (k, 4) of irradiance 1 at a place (3,) in mm, evenly round it on a spiral."""
    i = np.arange(_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * i / _DIRECTIONS, np.pi * (1 + np.sqrt(5.0)) * i
    aside, away = np.sqrt(1 - height**2), max(_AWAY_MM, float(np.linalg.norm(middle)))
    directions = np.column_stack([aside * np.cos(turn), aside * np.sin(turn), height])
    power = np.full(_DIRECTIONS, (away / REFERENCE_MM) ** 2)
    return np.column_stack([middle + away * directions @ world_from_camera, power])


def equations(shares: Sequence[Floats], seen: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Normal equations (k, k), (k,) of powers, of amounts (p,) by shares (p, k); albedos fitted."""
    albedo, weights = np.ones(len(seen)), [np.ones(len(one)) for one in seen]
    power, variance = np.zeros(shares[0].shape[1]), 1.0
    for turn in range(_ROUNDS):
        normal, right = np.zeros((len(power), len(power))), np.zeros(len(power))
        for one, amounts, scale, w in zip(shares, seen, albedo, weights, strict=True):
            add_normal(scale * one, w, amounts, normal, right)
        normal, right = (normal + np.tril(normal, -1).T) / variance, right / variance
        if turn == _ROUNDS - 1:
            break
        power, left = _solved(normal, right, power), np.zeros(2)
        for i, (one, amounts) in enumerate(zip(shares, seen, strict=True)):
            lit = _product(one, power)
            off = amounts - albedo[i] * lit
            limit = 5 * 1.4826 * np.median(np.abs(off)) + 1e-6
            weights[i] = np.clip(1 - (off / limit) ** 2, 0, None) ** 4
            shown = weights[i] * lit
            albedo[i] = float(shown @ amounts) / max(float(shown @ lit), 1e-9)
            left += weights[i] @ off**2, weights[i].sum()
        variance = max(float(left[0] / left[1]), _NOTHING)
    return normal, right


def _solved(normal: Floats, right: Floats, start: Floats) -> Floats:
    """Powers (m,), none negative, by their normal equations."""
    ridge = _SPREAD * np.mean(np.diag(normal)) * np.eye(len(right))
    return non_negative(normal + ridge, right, start, _SWEEPS)


@compiled
def add_normal(
    shares: Floats, weights: Floats, amounts: Floats, normal: Floats, right: Floats
) -> None:
    """Add the normal equations of amounts (p,) by shares (p, k); of `normal` the lower half."""
    for i in range(len(amounts)):
        for a in range(len(right)):
            weighted = weights[i] * shares[i, a]
            if weighted == 0:  # half of all lamps are below a pixel's horizon
                continue
            right[a] += weighted * amounts[i]
            for b in range(a + 1):
                normal[a, b] += weighted * shares[i, b]


@compiled
def _product(matrix: Floats, vector: Floats) -> Floats:
    out = np.zeros(len(matrix))
    for i in range(len(matrix)):
        for k in range(len(vector)):
            out[i] += matrix[i, k] * vector[k]
    return out


@compiled
def non_negative(normal: Floats, right: Floats, start: Floats, sweeps: int) -> Floats:
    """Least squares without negative unknowns (k,), one unknown at a time (Franc et al. 2005)."""
    out = start.copy()
    slope = _product(normal, out) - right
    for _ in range(sweeps):
        for k in range(len(out)):
            if normal[k, k] > 0:
                step = max(out[k] - slope[k] / normal[k, k], 0.0) - out[k]
                if step != 0:
                    out[k] += step
                    for j in range(len(out)):
                        slope[j] += step * normal[k, j]
    return out


@compiled
def _shaded(
    pixels: Bytes,
    table: Floats,
    rays: RaySet,
    tables: Radial,
    frame: Floats,
    lamps: Floats,
) -> tuple[Floats, Floats]:
    """What lamps would give at some of a ball's clear pixels, and what light from all round would.

    Returns:
        That (p, k + 6), see `_from_all_round`; and the amounts (p,) seen there.
    """
    light, background = sampled_light(pixels, table, rays)
    inside = int(np.searchsorted(STEPS, _LAST_PX, side="right"))
    _, amounts, _, _ = split_light(light, rays.status, background, STEPS, tables, inside)
    used, clear = np.arange(0, inside, _EVERY), some_clear(rays.status)
    rows, angles = tables.diffuse[used], rays.around[clear]
    out = np.empty((len(used), len(clear), len(lamps) + _ALL_ROUND))
    for k in range(len(lamps)):
        out[:, :, k] = lamp_light(rows, tables.kept_out[0], angles, lamps[k : k + 1])
    _from_all_round(rows, angles, frame, out[:, :, len(lamps) :])
    seen = amounts[used][:, clear].copy()
    return out.reshape(seen.size, len(lamps) + _ALL_ROUND), seen.reshape(-1)


@compiled
def _from_all_round(diffuse: Floats, around: Floats, frame: Floats, out: Floats) -> None:
    """Fill in the light (m, n, 6) of skies that fade evenly, all from one side to none opposite.

    Args:
        diffuse: (m, 6) see `radial.Radial`.
        around: (n, 2) cosine and sine around the axis.
        frame: (3, 3) about it.
        out: by the side from which most comes: either way along the camera's x, y and z.
    """
    for a in range(3):
        for i in range(len(around)):
            sideways = around[i, 0] * frame[0, a] + around[i, 1] * frame[1, a]
            for j in range(len(diffuse)):
                even = diffuse[j, UNIFORM]
                leaning = diffuse[j, ASIDE] * sideways - diffuse[j, FACING] * frame[2, a]
                out[j, i, 2 * a], out[j, i, 2 * a + 1] = even + leaning, even - leaning
