"""The environment map of a camera, from its pictures without the balls.

At what angle from a ball the camera sees what the ball mirrors depends on the distance of the
walls. It is estimated on each side from colours in the reflection that neither the ball nor grey
light has. See docs/explanation/outline.md, formula 22.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Bytes, Floats
from measure.compiling import compiled
from measure.model.lens import bearing, to_pixel
from measure_plugins._outline.appearance.dichromatic import COLORLESS, GREY, body_color
from measure_plugins._outline.appearance.environment_map import (
    EnvironmentMap,
    environment_reflection,
    no_environment,
    side_weights,
)
from measure_plugins._outline.appearance.model import GLOSSY, Appearance
from measure_plugins._outline.fitting.edges import sampled_light
from measure_plugins._outline.sampling.rays import CLEAR, STEPS
from measure_plugins._outline.self_calibration.patch import BallPatch

_LONGER_SIDE_CELLS = 80
"""Cells of the map along the longer side of a picture, finer than the blur of reflections."""
_SAMPLES_PER_CELL = 4  # Pixels sampled in either direction of each cell
_MAX_TANGENT = 2.0  # Tangent of the angle from the optical axis up to which the map reaches
_CUT_OUT_FACTOR = 1.15
"""Factor of the radius within which balls are cut out, because they are blurred."""
_MIRRORING_PX = (-6.0, 0.0)  # Range in px along the outward normal where a ball mirrors enough
_MIN_RAYS = 16
_TINY = 1e-20
_MIN_CORRELATION = 0.25
"""Mean correlation above which the map is used: in three recordings in coloured rooms it is at
least 0.27, in ten others at most 0.24 and mostly less than 0.15, by chance."""
_DISTANCE_SHARES = (0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
"""Values tried for `EnvironmentMap.share`: the mirrored walls are from a quarter of the camera's
distance to nearly infinitely far from the ball."""


class BackgroundAccumulator(NamedTuple):
    """Sums over one picture without its balls, on a grid of the undistorted image plane."""

    sums: Floats  # (h, w, 3) of picture values from 0 to 1
    counts: Floats  # (h, w) number of values
    corner: Floats  # (2,) x / z and y / z of the first cell
    step: float  # of the grid, in x / z and y / z


class _ForeignColor(NamedTuple):
    """Light of a patch along the colour that is orthogonal to the body colour and to grey."""

    patch: BallPatch
    direction: Floats  # (3,) unit vector of that colour, B G R
    rows: Bools  # (m,) which of `STEPS` are used
    clear: Bools  # (n,) which rays are
    grey: Floats  # see `RadialTables`
    seen: Floats  # amounts of it on these rows and rays, less that of the background


def background_of(pixels: Bytes, lens: Floats, balls: Floats) -> BackgroundAccumulator:
    """Sums over a picture without its balls.

    Args:
        pixels: (h, w, 3) the picture.
        lens: (16,) lens row.
        balls: (k, 4) unit axes and half angles of the outlines of all balls.
    """
    low, high = _visible_plane(pixels.shape[1], pixels.shape[0], lens)
    step = float(np.max(high - low)) / _LONGER_SIDE_CELLS
    columns, rows = np.maximum(np.round((high - low) / step), 2).astype(int)
    corner = low + step / 2
    sums, counts = np.zeros((rows, columns, 3)), np.zeros((rows, columns))
    _add_up(pixels, lens, balls, corner, step, sums, counts)
    return BackgroundAccumulator(sums / 255, counts, corner, step)


def _visible_plane(width: int, height: int, lens: Floats) -> tuple[Floats, Floats]:
    """Least and greatest x / z and y / z (2,) that a picture shows."""
    sides = np.array([0.0, 0.5, 1.0])
    pixels = np.array([[x * (width - 1), y * (height - 1)] for x in sides for y in sides])
    rays = np.array([bearing(pixel, lens) for pixel in pixels])
    beyond = np.sign(pixels - lens[[2, 4]]) * _MAX_TANGENT
    plane = np.where(np.isfinite(rays[:, 2:]), rays[:, :2] / rays[:, 2:], beyond)
    plane = np.clip(plane, -_MAX_TANGENT, _MAX_TANGENT)
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
    """Add up picture values (h, w, 3) of each cell, where no ball is, and count them (h, w)."""
    height, width = pixels.shape[0], pixels.shape[1]
    for row in range(_SAMPLES_PER_CELL * len(sums)):
        y = corner[1] + step * ((row + 0.5) / _SAMPLES_PER_CELL - 0.5)
        for column in range(_SAMPLES_PER_CELL * sums.shape[1]):
            x = corner[0] + step * ((column + 0.5) / _SAMPLES_PER_CELL - 0.5)
            u, v = to_pixel(x, y, 1.0, lens)
            if not (0 <= u < width - 0.5 and 0 <= v < height - 0.5) or _in_ball(x, y, balls):
                continue
            i, j = row // _SAMPLES_PER_CELL, column // _SAMPLES_PER_CELL
            counts[i, j] += 1
            for c in range(3):
                sums[i, j, c] += pixels[int(v + 0.5), int(u + 0.5), c]


@compiled
def _in_ball(x: float, y: float, balls: Floats) -> bool:
    length = np.sqrt(x * x + y * y + 1)
    for k in range(len(balls)):
        cosine = (x * balls[k, 0] + y * balls[k, 1] + balls[k, 2]) / length
        if cosine > np.cos(_CUT_OUT_FACTOR * balls[k, 3]):
            return True
    return False


def environment_of(backgrounds: Sequence[BackgroundAccumulator], table: Floats) -> EnvironmentMap:
    """The map by one camera's pictures without balls; unknown if there is none. `table`: (256,)."""
    sums = np.sum([one.sums for one in backgrounds], axis=0)
    counts = np.sum([one.counts for one in backgrounds], axis=0)
    known = counts > 0
    if not known.any():
        return no_environment()
    values = sums / np.maximum(counts, 1)[..., None]
    light = np.interp(values, np.arange(len(table)) / (len(table) - 1), table)
    light = _inpainted(light, known)
    colors = light - light.mean(axis=-1, keepdims=True)
    return EnvironmentMap(
        colors, backgrounds[0].corner, backgrounds[0].step, np.ones(4), np.ones(4)
    )


def _inpainted(light: Floats, known: Bools) -> Floats:
    """Light (h, w, 3) with cells that are not `known` (h, w) filled from their neighbours."""
    light, done = light * known[..., None], known.astype(np.float64)
    while not done.all():
        near, count = _around(light), _around(done)
        new = (done == 0) & (count > 0)
        light[new], done[new] = near[new] / count[new][:, None], 1.0
    return light


def _around(values: Floats) -> Floats:
    """Sums over each cell and its eight neighbours (h, w, ...)."""
    pad = np.pad(values, [(1, 1), (1, 1)] + [(0, 0)] * (values.ndim - 2))
    rows, columns = values.shape[:2]
    places = [(i, j) for i in range(3) for j in range(3)]
    return np.asarray(sum(pad[i : i + rows, j : j + columns] for i, j in places))


def with_environment(
    patches: Sequence[BallPatch],
    appearance: Appearance,
    backgrounds: Sequence[BackgroundAccumulator],
) -> Appearance:
    """The appearance with the environment map, on those sides on which the balls mirror it.

    Decided by the colour orthogonal to a ball's own and to grey: whatever of it shows inside an
    outline is mirrored, however the ball is lit.
    """
    foreign = [one for patch in patches if (one := _foreign_color(patch, appearance)) is not None]
    if not foreign or not backgrounds or appearance.index != GLOSSY:
        return appearance
    environment = environment_of(backgrounds, appearance.table)
    if environment.colors.size == 0:
        return appearance
    environments = [environment._replace(share=np.full(4, share)) for share in _DISTANCE_SHARES]
    correlations = np.array([_correlations(foreign, one) for one in environments])
    best = np.argmax(correlations, axis=0)
    most = np.maximum(correlations.max(axis=0), 0.0)
    if np.mean(most) < _MIN_CORRELATION:
        return appearance
    mirrored = most > 0
    shares = np.where(mirrored, np.array(_DISTANCE_SHARES)[best], 0.0)
    return replace(
        appearance, environment=environment._replace(share=shares, strength=mirrored.astype(float))
    )


def _foreign_color(patch: BallPatch, appearance: Appearance) -> _ForeignColor | None:
    """The foreign colour of a patch; None if the ball is grey or too few rays are clear."""
    rays = patch.own_rays()
    tables = appearance.tables(patch.half_angle * patch.scale, patch.half_angle)
    light, background = sampled_light(patch.pixels, appearance.table, rays)
    clear = rays.status == CLEAR
    if np.count_nonzero(clear) < _MIN_RAYS:
        return None
    direction = np.cross(body_color(light, rays.status, STEPS), np.full(3, GREY))
    if np.linalg.norm(direction) < COLORLESS:
        return None
    direction /= np.linalg.norm(direction)
    first, last = _MIRRORING_PX
    rows = (first < STEPS) & (last > STEPS)
    beside = (tables.outside + tables.grazing_reflection)[rows, None] * (direction @ background)
    seen = np.tensordot(direction, light[:, rows], 1) - beside
    return _ForeignColor(patch, direction, rows, clear, tables.grey, seen[:, clear])


def _correlations(foreign: Sequence[_ForeignColor], environment: EnvironmentMap) -> Floats:
    """Correlation (4,), by side, of the foreign colour of patches and of an environment map.

    Not the residuals: where things are not quite where the map has them, amplitudes are smaller.
    """
    seen2, mirrored2, both = np.zeros(4), np.zeros(4), np.zeros(4)
    for one in foreign:
        patch = one.patch
        light = environment_reflection(
            environment, one.grey, patch.frame, patch.half_angle, patch.rays.around
        )
        mirrored = np.tensordot(one.direction, light[:, one.rows][:, :, one.clear], 1)
        sides = np.zeros((np.count_nonzero(one.clear), 4))
        for i, around in enumerate(patch.rays.around[one.clear]):
            side_weights(patch.frame, around, sides[i])
        seen2 += np.sum(one.seen**2, axis=0) @ sides
        mirrored2 += np.sum(mirrored**2, axis=0) @ sides
        both += np.sum(mirrored * one.seen, axis=0) @ sides
    return both / np.sqrt(np.maximum(seen2 * mirrored2, _TINY))
