"""Learning where the light on a camera's balls comes from.

Many directions are tried at once, each with an irradiance that cannot be negative: that leaves a
handful. They are the same for all balls and pictures of a camera, so that what one ball hides in
its shade another shows; each ball has an albedo of its own.

Sums over pixels are loops of our own: a linear algebra library parts products of this size among
threads, which wait for one another where cameras are measured side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Bytes, Floats
from measure.compiling import compiled
from measure_plugins._edges.appearance import Appearance
from measure_plugins._edges.appearance_fit import Sight, misfits, telling
from measure_plugins._edges.corrected import sampled_light
from measure_plugins._edges.lamps import lamp_light, no_lamps, seen_from
from measure_plugins._edges.prediction import split_light
from measure_plugins._edges.radial import STEPS, Radial

_DIRECTIONS = 100
_LAST_PX = -1.0
"""Pixels nearer to the outline are left to what is found there later."""
_EVERY = 2
_ROUNDS = 4
_SWEEPS = 40
_SPREAD = 0.01
"""Ridge, as a share of the mean of the normal matrix's diagonal: lamps have a size, so light is
rather shared by neighbouring directions than given to one."""
_FAINT = 0.01
"""Lamps that give less than this share of the light are left out."""


def with_lamps(sights: Sequence[Sight], appearance: Appearance) -> Appearance:
    """The appearance with lamps, if pictures then look more like their predictions."""
    useful = telling(sights)
    if not useful:
        return appearance
    without = replace(appearance, lamps=no_lamps())
    lit = replace(appearance, lamps=learn_lamps(useful, without))
    if len(lit.lamps) == 0:
        return without
    gain = np.log(misfits(useful, lit) / misfits(useful, without))
    return lit if float(np.mean(gain)) < 0 else without


def learn_lamps(sights: Sequence[Sight], appearance: Appearance) -> Floats:
    """Lamps (k, 4) in the camera's frame that explain the balls' shading, robustly."""
    directions, table = _directions(_DIRECTIONS), appearance.table
    shares, seen = [], []
    for sight in sights:
        tables = appearance.tables(sight.half_angle * sight.scale, sight.half_angle)
        lamps = seen_from(directions, sight.frame)
        one, amounts = _shaded(
            sight.pixels,
            table,
            sight.points,
            sight.normals,
            sight.around,
            sight.free.copy(),
            tables,
            lamps,
        )
        shares.append(one)
        bright = max(float(np.quantile(amounts, 0.9)), 1e-6)
        seen.append(amounts / bright)
    power = powers(shares, seen)
    kept = power > _FAINT * power.sum()
    return np.column_stack([directions[kept, :3], power[kept]])


def _directions(count: int) -> Floats:
    """Lamps (count, 4) of unit power, spread evenly over the sphere on a spiral."""
    i = np.arange(count) + 0.5
    height, turn = 1 - 2 * i / count, np.pi * (1 + np.sqrt(5.0)) * i
    aside = np.sqrt(1 - height**2)
    return np.column_stack([aside * np.cos(turn), aside * np.sin(turn), height, np.ones(count)])


def powers(shares: Sequence[Floats], seen: Sequence[Floats]) -> Floats:
    """Irradiances (k,), none negative, of amounts (p,) by shares (p, k); albedos fitted too."""
    albedo, weights = np.ones(len(seen)), [np.ones(len(one)) for one in seen]
    power = np.zeros(shares[0].shape[1])
    for _ in range(_ROUNDS):
        normal, right = np.zeros((len(power), len(power))), np.zeros(len(power))
        for one, amounts, scale, w in zip(shares, seen, albedo, weights, strict=True):
            add_normal(scale * one, w, amounts, normal, right)
        normal += np.tril(normal, -1).T
        normal += _SPREAD * np.mean(np.diag(normal)) * np.eye(len(power))
        power = non_negative(normal, right, power, _SWEEPS)
        for i, (one, amounts) in enumerate(zip(shares, seen, strict=True)):
            lit = _product(one, power)
            off = amounts - albedo[i] * lit
            limit = 5 * 1.4826 * np.median(np.abs(off)) + 1e-6
            weights[i] = np.clip(1 - (off / limit) ** 2, 0, None) ** 4
            shown = weights[i] * lit
            albedo[i] = float(shown @ amounts) / max(float(shown @ lit), 1e-9)
    return power


@compiled
def add_normal(
    shares: Floats, weights: Floats, amounts: Floats, normal: Floats, right: Floats
) -> None:
    """Add the normal equations of amounts (p,) by shares (p, k); of `normal` the lower half."""
    for i in range(len(amounts)):
        for a in range(len(right)):
            weighted = weights[i] * shares[i, a]
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
    points: Floats,
    normals: Floats,
    around: Floats,
    free: Floats,
    tables: Radial,
    lamps: Floats,
) -> tuple[Floats, Floats]:
    """What each lamp would give (p, k) at a ball's clear pixels; the amounts (p,) seen there."""
    light, background = sampled_light(pixels, table, points, normals, free)
    inside = int(np.searchsorted(STEPS, _LAST_PX, side="right"))
    _, amounts, _, _ = split_light(light, free, background, STEPS, tables, inside)
    used = np.arange(0, inside, _EVERY)
    clear = np.nonzero(free == 0)[0]
    rows, angles, out = (
        tables.diffuse[used],
        around[clear],
        np.empty((len(used) * len(clear), len(lamps))),
    )
    for k in range(len(lamps)):
        out[:, k] = lamp_light(rows, angles, lamps[k : k + 1]).reshape(-1)
    return out, amounts[used][:, clear].copy().reshape(-1)
