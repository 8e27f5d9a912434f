"""Edges along rays, corrected by the bias of the edge finder on the predicted picture.

See docs/explanation/outline.md, formulas 9, 13 and 14.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats, Reals, Singles
from measure.compiling import compiled, folded
from measure_plugins._outline.appearance import (
    CHROMA_REACH,
    FIT_LAST_PX,
    Ambient,
    encode,
    predict_light,
    read_off,
)
from measure_plugins._outline.rays import (
    CLEAR,
    HIGHLIGHT_PX,
    STEPS,
    TOGETHER,
    RaySet,
    Statuses,
    crossings,
    in_highlights,
    levels,
    middle_angles,
    project,
    sample,
    together,
    uncertainty,
)
from measure_plugins._outline.reflectance import RadialTables

INSIDE_PX = (-7.0, -3.0)
"""Where the colour inside is taken, px along the normal: inside the blurred edge, and near it."""
_MAX_DEPTH_RADII, _MIN_DEPTH_SHARE = 1 / 7, 0.6
"""Limits of that window in small outlines: no deeper than this share of the radius, since further
in the shading differs from that at the edge; but at least this share of its depth, because of the
blur. Of two depths tried on simulated scenes of half the size, the lesser was better on six of
eight."""
OUTSIDE_PX = (3.0, 6.5)
"""Where the colour outside is taken."""
SEARCH_PX = 3.0
_BACKGROUND_PX = (3.0, 6.0)
_MIN_COLOR_SHARE = 0.35
"""Share of the edges' contrast that must be chromatic for edges to be found without grey."""
_CORRECTION_SD_SHARE = 0.25
"""Standard deviation of a ray's correction, per difference from the outline's median."""
_SYSTEMATIC_PX = 0.25
"""Standard deviation that the model leaves on a ray, however low the noise: it bounds the weight of
bright rays."""
_FIRST = int(np.searchsorted(STEPS, INSIDE_PX[0]))  # The first step that edges are found from
LATER_STEPS = STEPS[_FIRST:]
"""Where the picture is predicted, px along the normal."""
_LIGHT_STEPS = (STEPS <= FIT_LAST_PX) | (
    (_BACKGROUND_PX[0] <= STEPS) & (_BACKGROUND_PX[1] >= STEPS)
)
"""Steps at which light is sampled in addition to picture values. Kernels take copies of these: a
constant array is of another type than a variable one, and all would be compiled twice."""


class Edges(NamedTuple):
    """Edges along n rays."""

    shifts: Floats  # (n,) px outward from the prediction, NaN where there is none
    sd: Floats  # (n,) px
    contrast: Floats  # (n,) difference of inside and outside
    inside: Floats  # (3, n) light inside
    outside: Floats  # (3, n) light outside


class PredictionInputs(NamedTuple):
    """A ball in a picture, and all that the picture is predicted from along rays across it."""

    pixels: Bytes  # (h, w, 3) uint8
    table: Floats  # (256,) light of each picture value
    encoding: Singles  # see `sensor.encoding`
    rays: RaySet  # n rays across the predicted outline; those that leave the picture are marked
    tables: RadialTables  # what the ball shows along a ray, see `tables.tables`
    ambient: Ambient  # the light on it, along the rays that are predicted


class EdgePairs(NamedTuple):
    """Edges along n rays, found without the grey component of their colours, then with it."""

    at: Floats  # (2, n) px outward from the prediction, NaN where there is none
    sd: Floats  # (2, n) px
    contrast: Floats  # (2, n) difference of inside and outside, in picture values from 0 to 1
    predicted: Floats  # (2, n / 2) where the same finder sees edges on the prediction, px
    inside: Singles  # (3, n) light inside
    outside: Singles  # (3, n) light outside


@folded
def corrected_edges(found: EdgePairs, correction_weight: float) -> Edges:
    """Mean of both edges of a ray, each corrected by its predicted bias (formula 13).

    Errors of the prediction move the two differently: their mean is better than either, and half
    their difference is part of its standard deviation.

    Args:
        correction_weight: share subtracted of the difference of a ray's bias from the median.

    Returns:
        The edges; contrast in picture values from 0 to 1.
    """
    n = found.at.shape[1]
    shifts, variances = np.empty((2, n)), np.empty((2, n))
    for k in range(2):
        common = np.nanmedian(found.predicted[k])
        for i in range(n):
            own = found.predicted[k, i // TOGETHER] - common
            sd = found.sd[k, i]
            shifts[k, i] = found.at[k, i] - common - correction_weight * own
            variances[k, i] = sd * sd + _CORRECTION_SD_SHARE * own * _CORRECTION_SD_SHARE * own
    shift, sds, contrast = np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):  # formula 14
        a, b = shifts[0, i], shifts[1, i]
        apart, variance = 0.5 * (a - b), 0.5 * (variances[0, i] + variances[1, i])
        shift[i] = 0.5 * (a + b)
        sds[i] = np.sqrt(variance + apart * apart + _SYSTEMATIC_PX**2)
        contrast[i] = min(found.contrast[0, i], found.contrast[1, i])
    inside, outside = found.inside.astype(np.float64), found.outside.astype(np.float64)
    return Edges(shift, sds, contrast, inside, outside)


@compiled
def find_edge_pairs(inputs: PredictionInputs) -> EdgePairs:
    """Find edges without grey and with it, in a picture and on its prediction.

    Without grey, colourless reflections do not count; with it, brightness does, which the camera
    blurs less. The ambient light of `inputs` is that along the n / 2 groups of its rays.
    """
    rays, steps, later, wanted = inputs.rays, STEPS.copy(), LATER_STEPS.copy(), _LIGHT_STEPS.copy()
    light, values = sample(inputs.pixels, inputs.table, rays, steps, wanted, _FIRST)
    window = inside_window(rays.points)
    within, background = levels(light, steps, window), levels(light, steps, _BACKGROUND_PX)
    grouped, status = together(light, rays.status)
    predicted = _predicted_values(inputs, grouped, status, middle_angles(rays.around))
    inside, outside = levels(values, later, window), levels(values, later, OUTSIDE_PX)
    model_inside = levels(predicted, later, window)
    model_outside = levels(predicted, later, OUTSIDE_PX)
    n, highlights = len(rays.points), in_highlights(inside, rays.status)
    at, sd, contrasts = np.empty((2, n)), np.empty((2, n)), np.empty((2, n))
    biases = np.empty((2, n // TOGETHER))
    for k in range(2):
        without_grey = k == 0 and _is_colorful(within, background, rays.status)
        x, contrasts[k] = project(values, inside, outside, without_grey)
        seen, slope = crossings(x, later, SEARCH_PX)
        at[k], sd[k] = seen, uncertainty(x, later, seen, slope, window)
        for i in range(n):
            sd[k, i] += HIGHLIGHT_PX * highlights[i]
        y, _ = project(predicted, model_inside, model_outside, without_grey)
        biases[k], _ = crossings(y, later, SEARCH_PX)
    return EdgePairs(at, sd, contrasts, biases, within, background)


@compiled
def inside_window(points: Floats) -> tuple[float, float]:
    """Where the colour inside an outline (n, 2) is taken, px along its normals."""
    across = 0.0
    for k in range(2):
        across += (np.max(points[:, k]) - np.min(points[:, k])) / 4
    share = min(max(_MAX_DEPTH_RADII * across / -INSIDE_PX[0], _MIN_DEPTH_SHARE), 1.0)
    return share * INSIDE_PX[0], share * INSIDE_PX[1]


@compiled
def compare(inputs: PredictionInputs) -> tuple[Floats, Floats]:
    """Picture values (3, m, n) along all rays at `LATER_STEPS`: seen, and predicted."""
    rays = inputs.rays
    steps, wanted = STEPS.copy(), _LIGHT_STEPS.copy()
    seen, values = sample(inputs.pixels, inputs.table, rays, steps, wanted, _FIRST)
    predicted = _predicted_values(inputs, seen.astype(np.float64), rays.status, rays.around)
    return values.astype(np.float64), predicted.astype(np.float64)


@compiled
def sampled_light(pixels: Bytes, table: Floats, rays: RaySet) -> tuple[Floats, Floats]:
    """Light (3, m, n) along rays at `STEPS`, and of the surroundings (3, n); see `sample`."""
    steps, everywhere = STEPS.copy(), np.ones(len(STEPS), np.bool_)
    seen, _ = sample(pixels, table, rays, steps, everywhere, len(steps))
    light = seen.astype(np.float64)
    return light, levels(light, steps, _BACKGROUND_PX)


@folded
def _predicted_values(
    inputs: PredictionInputs, light: Floats, status: Statuses, around: Floats
) -> Reals:
    """Predicted picture values (3, m, n) at `LATER_STEPS` along rays of `light` (formula 9)."""
    steps = STEPS.copy()
    predicted = predict_light(
        light,
        status,
        around,
        levels(light, steps, _BACKGROUND_PX),
        steps,
        inputs.tables,
        inputs.ambient,
        _FIRST - CHROMA_REACH,
    )
    return read_off(encode(predicted, inputs.encoding))


@compiled
def _is_colorful(inside: Reals, outside: Reals, status: Statuses) -> bool:
    """Whether enough of the edges' contrast is chromatic."""
    whole, part = 0.0, 0.0
    for i in range(len(status)):
        if status[i] == CLEAR:
            a = inside[0, i] - outside[0, i]
            b = inside[1, i] - outside[1, i]
            c = inside[2, i] - outside[2, i]
            mean = (a + b + c) / 3
            whole += np.sqrt(a * a + b * b + c * c)
            part += np.sqrt((a - mean) ** 2 + (b - mean) ** 2 + (c - mean) ** 2)
    return part > _MIN_COLOR_SHARE * whole
