"""Fitting the picture of a small pattern: places and sizes by Gauss-Newton, levels linearly."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from measure.arrays import Bools, Bytes, Floats, Ints
from measure.geometry.covariance import MAD_TO_SD

BLUR_PX = 0.8  # Optics and colour mosaic together; the fits of recorded dots are best about here
SUPERSAMPLING = 3
_MAX_ITERATIONS = 25
_NUDGE_PX = 0.1
_TUKEY_SDS = 4.7
_UNEXPLAINED_RESIDUAL = 0.25

Basis = Callable[[Floats], Floats]
"""From the unknowns (k,) to pictures (pixels, layers) whose levels are fitted linearly."""


def linear_light(bgr: Bytes) -> Floats:
    """Luminance (h, w), 0 to 1, proportional to light (sRGB's curve undone)."""
    code = np.arange(256) / 255.0
    curve = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return curve[bgr] @ np.array([0.0722, 0.7152, 0.2126])


def spots(excess: Floats) -> Iterator[tuple[slice, slice, Bools]]:
    """What stands out of linear luminance less its surroundings (h, w): rows, columns, and which.

    A spot's mask (rows, columns) tells it from others within its box.
    """
    spread = float(np.median(np.abs(excess))) * MAD_TO_SD
    mask = (excess > max(8 * spread, 0.02)).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    for label in range(1, len(stats)):
        x, y, width, height, _ = (int(v) for v in stats[label])
        rows, columns = slice(y, y + height), slice(x, x + width)
        yield rows, columns, labels[rows, columns] == label


def patch_about(light: Floats, center_px: Floats, half: int) -> tuple[Ints, Floats] | None:
    """The pixel (2,) nearest to a place, and the square about it; None at the picture's edge."""
    u, v = (int(c) for c in np.rint(center_px))
    patch = light[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
    side = 2 * half + 1
    return (np.array([u, v]), patch) if patch.shape == (side, side) else None


@dataclass(frozen=True, eq=False)
class PatternFit:
    """A fitted pattern."""

    unknowns: Floats  # (k,)
    misfit: float  # robust spread of the weighted residuals
    unexplained: float  # share of pixels whose weighted residual exceeds a quarter


def fit_pattern(
    values: Floats, root: Floats, start: Floats, basis: Basis, least: Floats
) -> PatternFit:
    """Fit a pattern robustly (Tukey's loss).

    Args:
        values: (pixels,) the patch.
        root: (pixels,) square roots of the weights; 0 leaves a pixel out.
        start: (k,) unknowns, all of them worth about a pixel of change.
        least: (k,) lower bounds of the unknowns.
    """
    unknowns, robust = start, np.ones_like(values)
    for _ in range(_MAX_ITERATIONS):
        weights = root**2 * robust
        step = _step(values, weights, unknowns, basis)
        unknowns = np.maximum(unknowns + step, least)
        whitened = (_residuals(values, weights, unknowns, basis) * root)[root > 0]
        misfit = MAD_TO_SD * float(np.median(np.abs(whitened))) + 1e-4
        t = np.zeros_like(values)
        t[root > 0] = np.minimum(np.abs(whitened) / (_TUKEY_SDS * misfit), 1)
        robust = (1 - t**2) ** 2
        if np.abs(step).max() < 2e-3:
            break
    return PatternFit(unknowns, misfit, float(np.mean(np.abs(whitened) > _UNEXPLAINED_RESIDUAL)))


def _step(values: Floats, weights: Floats, unknowns: Floats, basis: Basis) -> Floats:
    """A damped Gauss-Newton step, at most 0.7 px."""
    residuals = _residuals(values, weights, unknowns, basis)
    columns = []
    for nudge in np.eye(len(unknowns)) * _NUDGE_PX:
        before = _residuals(values, weights, unknowns - nudge, basis)
        after = _residuals(values, weights, unknowns + nudge, basis)
        columns.append((before - after) / (2 * _NUDGE_PX))
    jacobian = np.column_stack(columns)
    weighted = (jacobian * weights[:, None]).T
    normal = weighted @ jacobian
    normal[np.diag_indices(len(normal))] *= 1.001
    step = np.linalg.lstsq(normal, weighted @ residuals, rcond=None)[0]
    return np.asarray(step * min(1.0, 0.7 / max(float(np.abs(step).max()), 1e-9)))


def _residuals(values: Floats, weights: Floats, unknowns: Floats, basis: Basis) -> Floats:
    layers = basis(unknowns)
    root = np.sqrt(weights)
    amounts = np.linalg.lstsq(layers * root[:, None], values * root, rcond=None)[0]
    return values - layers @ amounts
