"""Sub-pixel places of crosses: two straight bars, light on dark or dark on light.

The middle lines of the bars meet in the cross's centre under any perspective, whatever the angle
between them and however long the arms. So both bars are fitted as lines, each of its own width,
blurred by the lens, on a background with a slope, within a window that the arms' ends do not reach.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from measure.arrays import Floats
from measure.calibration.pattern_fit import BLUR_PX, fit_pattern, patch_about, spots

_MIN_EXTENT_PX, _MAX_EXTENT_PX = 7, 90
_MAX_FILLED_SHARE = 0.65  # A cross fills less of its box than this; a dot fills more
_MIN_ANGLE_DEG = 25.0
_MAX_MISFIT = 0.12
_MAX_UNEXPLAINED_SHARE = 0.04  # A second cross or a hidden arm takes more of the window than this
_ARM_SHARE = 0.75


@dataclass(frozen=True, eq=False)
class Cross:
    """A cross found in a picture."""

    center_px: Floats  # (2,)
    reach_px: float  # from the centre to the nearer ends of the arms
    angles: Floats  # (2,) directions of the bars, rad


def cross_candidates(light: Floats) -> list[Cross]:
    """What may be a cross in linear luminance (h, w): thin, about as wide as high."""
    reach = 2 * _MAX_EXTENT_PX // 2 + 1
    excess = light - cv2.blur(light, (reach, reach))
    found = []
    for rows, columns, inside in (*spots(excess), *spots(-excess)):
        small, large = min(inside.shape), max(inside.shape)
        if small < _MIN_EXTENT_PX or large > _MAX_EXTENT_PX or large > 4 * small:
            continue
        x, y = columns.start, rows.start
        cut = min(x, y) <= 0 or columns.stop >= light.shape[1] or rows.stop >= light.shape[0]
        if not cut and inside.mean() < _MAX_FILLED_SHARE:
            cross = _as_cross(np.where(inside, np.abs(excess[rows, columns]), 0.0))
            if cross is not None:
                moved = cross.center_px + np.array([x, y])
                found.append(replace(cross, center_px=moved))
    return found


def _as_cross(weights: Floats) -> Cross | None:
    """Centre, arms and directions of a shape (h, w); None if it has not two bars that cross."""
    rows, columns = np.nonzero(weights)
    mass = weights[rows, columns]
    center = np.array([columns @ mass, rows @ mass]) / mass.sum()
    across, down = columns - center[0], rows - center[1]
    turns = np.deg2rad(np.arange(0, 180, 3))
    off_line = np.abs(np.outer(np.cos(turns), down) - np.outer(np.sin(turns), across))
    along = np.outer(np.cos(turns), across) + np.outer(np.sin(turns), down)
    on_line = (off_line < 1.0) * mass
    strength = on_line.sum(axis=1)
    first = int(np.argmax(strength))
    apart = np.abs((turns - turns[first] + np.pi / 2) % np.pi - np.pi / 2)
    second = int(np.argmax(np.where(apart > np.deg2rad(_MIN_ANGLE_DEG), strength, -1.0)))
    reach = np.inf
    for number in (first, second):
        places = along[number][on_line[number] > 0]
        if not len(places):
            return None
        reach = min(reach, float(places.max()), float(-places.min()))
    if not reach > 0.5 * _MIN_EXTENT_PX - 1:
        return None
    return Cross(center, reach, turns[[first, second]])


def refine_cross(light: Floats, cross: Cross) -> Cross | None:
    """Fit both bars; None where that fails, runs away or leaves too much unexplained."""
    half = max(int(_ARM_SHARE * cross.reach_px), 3)
    cut = patch_about(light, cross.center_px, half)
    if cut is None:
        return None
    middle, patch = cut
    low, high = np.quantile(patch, (0.05, 0.95))
    contrast = max(float(high - low), 1e-6)
    values = (patch.ravel() - low) / contrast
    offsets = np.stack(np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1)))
    places = offsets.reshape(2, -1).astype(np.float64)
    root = (np.hypot(*places) <= half).astype(np.float64)
    # Angles in pixels at the arms' ends, half widths in pixels: all unknowns are of one size.
    start = np.array([*(cross.center_px - middle), *(cross.angles * half), 1.5, 1.5])
    least = np.array([-half, -half, -10.0 * half, -10.0 * half, 0.4, 0.4])
    fit = fit_pattern(values, root, start, lambda k: _basis(k, places, half), least)
    unknowns, angles = fit.unknowns, fit.unknowns[2:4] / half
    apart = np.abs((angles[0] - angles[1] + np.pi / 2) % np.pi - np.pi / 2)
    moved = float(np.linalg.norm(unknowns[:2] - start[:2]))
    crossing = apart > np.deg2rad(_MIN_ANGLE_DEG) / 2
    explained = fit.misfit <= _MAX_MISFIT and fit.unexplained <= _MAX_UNEXPLAINED_SHARE
    if moved > 0.5 * half + 1 or not crossing or not explained:
        return None
    return Cross(unknowns[:2] + middle, cross.reach_px, angles)


def _basis(unknowns: Floats, places: Floats, half: int) -> Floats:
    """Pictures (pixels, 4) of the two bars together, of 1 and of a slope."""
    from scipy.special import ndtr

    offsets = places - unknowns[:2, None]
    bars = []
    for angle, half_width in zip(unknowns[2:4] / half, unknowns[4:], strict=True):
        off_line = np.cos(angle) * offsets[1] - np.sin(angle) * offsets[0]
        edges = (ndtr((off_line + s * half_width) / _SIGMA_PX) for s in (1, -1))
        bars.append(next(edges) - next(edges))
    together = 1 - (1 - bars[0]) * (1 - bars[1])
    return np.column_stack([together, np.ones(places.shape[1]), places.T / half])


_SIGMA_PX = float(np.hypot(BLUR_PX, np.sqrt(1 / 12)))  # The lens's blur and the pixel's own width
