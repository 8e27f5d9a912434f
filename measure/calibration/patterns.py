"""Sub-pixel places of dots, balls and crosses: the picture of each is fitted.

A marker head is a small shaded ball: its centroid lies a pixel or two towards the light, and its
dark side fades into the background. So the whole picture of a shaded ball is fitted: intensity
a + b . n over its disc (n the surface normal; light from all sides plus light from one), blurred
by the lens, on a flat background, in linear light, with a robust loss because the post hides a
part. A flat printed dot is the case b = 0. A ball's outline is an ellipse away from the middle
of the image.

A cross is two straight bars, light on dark or dark on light. Their middle lines meet in its centre
under any perspective, whatever the angle between them and however long the arms. So both bars are
fitted as lines, each of its own width, blurred, on a background with a slope, within a window that
the arms' ends do not reach.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from measure.arrays import Bools, Bytes, Floats, Ints
from measure.estimation.losses import tukey_weights
from measure.geometry.covariance import MAD_TO_SD
from measure.limits import MAX_STEPS
from measure.model import Intrinsics

BLUR_PX = 0.8  # Optics and colour mosaic together; the fits of recorded dots are best about here
SUPERSAMPLING = 3
_NUDGE_PX = 0.1
_UNEXPLAINED_RESIDUAL = 0.25

Basis = Callable[[Floats], Floats]
"""From the unknowns (k,) to pictures (pixels, layers) whose levels are fitted linearly."""


def linear_light(bgr: Bytes) -> Floats:
    """Luminance (h, w), 0 to 1, proportional to light (sRGB's curve undone)."""
    code = np.arange(256) / 255.0
    curve = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return curve[bgr] @ np.array([0.0722, 0.7152, 0.2126])


def spots(excess: Floats) -> Iterator[tuple[slice, slice, Bools]]:
    """Rows, columns and masks of what stands out of luminance less its surroundings (h, w)."""
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
    for _ in range(MAX_STEPS):
        weights = root**2 * robust
        step = _step(values, weights, unknowns, basis)
        unknowns = np.maximum(unknowns + step, least)
        whitened = (_residuals(values, weights, unknowns, basis) * root)[root > 0]
        misfit = MAD_TO_SD * float(np.median(np.abs(whitened))) + 1e-4
        robust[root > 0] = tukey_weights((whitened / misfit) ** 2)
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


_NOISE_FLOOR = 0.1
_RADII_PX = (1.5, 25.0)  # Smallest and largest radius of what may be a dot


@dataclass(frozen=True, eq=False)
class Dot:
    """A dot found in a picture."""

    center_px: Floats  # (2,)
    radius_px: float


def dot_candidates(light: Floats) -> list[Dot]:
    """Spots in linear luminance (h, w) that are bright, round, and stand out from around them."""
    reach = 2 * int(2 * _RADII_PX[1]) + 1
    found = []
    for rows, columns, inside in spots(light - cv2.blur(light, (reach, reach))):
        radius = float(np.sqrt(inside.sum() / np.pi))
        if not _RADII_PX[0] <= radius <= _RADII_PX[1] or max(inside.shape) > 3.2 * radius + 2:
            continue
        patch = light[rows, columns] * inside
        strong = inside & (patch > 0.25 * patch.max())
        v, u = np.nonzero(strong)
        place = np.array([columns.start + u.mean(), rows.start + v.mean()])
        found.append(Dot(place, float(np.sqrt(strong.sum() / np.pi))))
    return found


def outline_shape(intrinsics: Intrinsics, pixel: Floats) -> Floats:
    """Shape (2, 2) of a small ball's outline at a pixel (2,), of determinant 1.

    A ball's rays fill a round cone, so its outline is a circle across the ray and is stretched to
    an ellipse where the ray meets the image at an angle. The shape turns offsets in the image into
    offsets across the ray.
    """
    ray = intrinsics.unproject(pixel[None])
    _, by_point, _ = intrinsics.project_with_jacobians(ray)
    across = np.linalg.svd(ray)[2][1:] @ np.linalg.pinv(by_point[0])
    return np.asarray(across / np.sqrt(abs(np.linalg.det(across))), dtype=np.float64)


def refine_dot(light: Floats, dot: Dot, shape: Floats) -> Dot | None:
    """Fit a shaded ball of outline shape (2, 2) in linear light (h, w); None where that fails."""
    half = int(np.ceil(dot.radius_px + 4))
    cut = patch_about(light, dot.center_px, half)
    if cut is None:
        return None
    middle, patch = cut
    values = patch.ravel() / patch.max()
    offsets = np.arange(-half, half + 1)
    near = np.hypot(*np.meshgrid(offsets, offsets)).ravel() < dot.radius_px + 3.5
    root = near / np.sqrt(np.maximum(values, 0) + _NOISE_FLOOR)
    start = np.array([*(dot.center_px - middle), dot.radius_px])
    side = 2 * half + 1
    least = np.array([-half, -half, 0.7])
    unknowns = fit_pattern(
        values, root, start, lambda here: _dot_layers(here, side, shape), least
    ).unknowns
    moved = float(np.linalg.norm(unknowns[:2] - start[:2]))
    if moved > 1.5 * dot.radius_px + 1 or not 0.4 < unknowns[2] / dot.radius_px < 2.5:
        return None
    return Dot(unknowns[:2] + middle, float(unknowns[2]))


def _dot_layers(unknowns: Floats, side: int, shape: Floats) -> Floats:
    """Blurred pictures (pixels, 5) of the disc, of the normal's components on it, and of 1."""
    grid = (np.arange(side * SUPERSAMPLING) + 0.5) / SUPERSAMPLING - side / 2
    offsets = np.stack(np.meshgrid(grid - unknowns[0], grid - unknowns[1]))
    x, y = np.einsum("ij,jvu->ivu", shape, offsets) / unknowns[2]
    disc = (x**2 + y**2 < 1).astype(np.float64)
    depth = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    layers = np.dstack([disc, x * disc, y * disc, depth])
    blurred = cv2.GaussianBlur(layers, (0, 0), BLUR_PX * SUPERSAMPLING)
    small = cv2.resize(blurred, (side, side), interpolation=cv2.INTER_AREA)
    return np.column_stack([small.reshape(-1, 4), np.ones(side * side)])


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
    fit = fit_pattern(values, root, start, lambda k: _cross_layers(k, places, half), least)
    unknowns, angles = fit.unknowns, fit.unknowns[2:4] / half
    apart = np.abs((angles[0] - angles[1] + np.pi / 2) % np.pi - np.pi / 2)
    moved = float(np.linalg.norm(unknowns[:2] - start[:2]))
    crossing = apart > np.deg2rad(_MIN_ANGLE_DEG) / 2
    explained = fit.misfit <= _MAX_MISFIT and fit.unexplained <= _MAX_UNEXPLAINED_SHARE
    if moved > 0.5 * half + 1 or not crossing or not explained:
        return None
    return Cross(unknowns[:2] + middle, cross.reach_px, angles)


def _cross_layers(unknowns: Floats, places: Floats, half: int) -> Floats:
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
