"""Edges with the edge finder's own error taken off: the error it makes on the predicted picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Bytes, Floats
from measure_plugins._edges.crossing import crossings, levels
from measure_plugins._edges.radial import REFRACTIVE_INDEX, STEPS, Radial, radial
from measure_plugins._edges.rays import FREE, sample
from measure_plugins._edges.sensor import blur_chroma, encode
from measure_plugins._edges.shading import predict_light

INSIDE_PX = (-7.0, -3.0)
OUTSIDE_PX = (3.0, 6.5)
_SEARCH_PX = 3.0
_BLUR_PX = 1.0
"""Optics, pixel, colour mosaic and interpolation together. A blur estimated from the steepness of
the edges of each picture was tried: it changes little, and settles less well."""
_BACKGROUND_PX = (3.0, 6.0)
_COLORFUL = 0.35
"""Share of the edges' contrast that is colour, above which grey is left out of it."""
_TRUST = 0.25
"""Share of a ray's correction, beyond the contour's common one, that counts as its uncertainty."""
_SYSTEMATIC_PX = 0.25
"""What the prediction leaves on a ray, however low the noise: it keeps bright rays from ruling."""
_IDENTITY = np.arange(256) / 255.0


@dataclass(frozen=True, eq=False)
class Edges:
    """Corrected edges along rays.

    Attributes:
        shifts: (n,) px outward from the prediction, NaN where there is none.
        sd: (n,) px.
        clear: (n,) whether inside and outside differ enough.
        inside: (n, 3) light inside.
        outside: (n, 3) light outside.
    """

    shifts: Floats
    sd: Floats
    clear: Bools
    inside: Floats
    outside: Floats


def corrected_edges(
    pixels: Bytes,
    table: Floats,
    points: Floats,
    normals: Floats,
    around: Floats,
    free: Floats,
    half_angle: float,
    scale: float,
    min_contrast: float,
) -> Edges:
    """Find edges twice, by all colours and without grey, less the finder's errors on a prediction.

    Without grey, colourless reflections do not count; with it, brightness does, which the camera
    shows sharper. What the prediction gets wrong moves the two differently: their mean is less off
    than either, and their difference tells by how much.

    Args:
        pixels: (h, w, 3) uint8.
        table: (256,) light of each picture value.
        points: (n, 2) predicted outline, px.
        normals: (n, 2) its outward unit normals.
        around: (n, 2) cosine and sine around the axis.
        free: (n,) `rays.FREE` where nothing is known to be in the way; may be set to OUTSIDE.
        half_angle: of the predicted cone, rad.
        scale: mean px per rad across the outline.
        min_contrast: least difference of inside and outside, in picture values from 0 to 1.
    """
    light = sample(pixels, table, points, normals, STEPS, free)
    values = sample(pixels, _IDENTITY, points, normals, STEPS, free)
    within, background = levels(light, STEPS, INSIDE_PX, _BACKGROUND_PX)
    predicted = _predict(light, free, around, background, half_angle, scale)
    predicted = blur_chroma(encode(predicted, table), STEPS[1] - STEPS[0])
    shifts, variances, contrasts = [], [], []
    for without_grey in (_is_colorful(light, free == FREE), False):
        at, sd, contrast = _find(values, without_grey)
        bias, _, _ = _find(predicted, without_grey)
        common = np.nanmedian(bias) if np.any(np.isfinite(bias)) else 0.0
        shifts.append(at - bias)
        variances.append(sd**2 + (_TRUST * (bias - common)) ** 2)
        contrasts.append(contrast)
    apart = shifts[0] - shifts[1]
    sd = np.sqrt((variances[0] + variances[1]) / 2 + apart**2 / 4 + _SYSTEMATIC_PX**2)
    clear = np.minimum(contrasts[0], contrasts[1]) >= min_contrast
    return Edges((shifts[0] + shifts[1]) / 2, sd, clear, within, background)


def _find(profiles: Floats, colorful: bool) -> tuple[Floats, Floats, Floats]:
    within, without = levels(profiles, STEPS, INSIDE_PX, OUTSIDE_PX)
    return crossings(profiles, STEPS, within, without, INSIDE_PX, _SEARCH_PX, colorful)


def _predict(
    light: Floats,
    free: Floats,
    around: Floats,
    background: Floats,
    half_angle: float,
    scale: float,
) -> Floats:
    tables: Radial = radial(half_angle * scale, half_angle, _BLUR_PX, REFRACTIVE_INDEX)
    return predict_light(
        light,
        free,
        around,
        background,
        STEPS,
        tables.diffuse,
        tables.grey,
        tables.nearby,
        tables.outside,
        tables.solve_grey,
        tables.tie_grey,
    )


def _is_colorful(light: Floats, free: Bools) -> bool:
    """Whether the edges differ enough in colour alone."""
    if not free.any():
        return False
    within, without = levels(light[free], STEPS, INSIDE_PX, OUTSIDE_PX)
    difference = within - without
    colour = difference - difference.mean(axis=1, keepdims=True)
    whole, part = np.linalg.norm(difference, axis=1), np.linalg.norm(colour, axis=1)
    return bool(part.sum() > _COLORFUL * whole.sum())
