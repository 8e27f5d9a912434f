"""Sub-pixel places of bright dots and balls.

A marker head is a small shaded ball: its centroid lies a pixel or two towards the light, and its
dark side fades into the background. So the whole picture of a shaded ball is fitted: intensity
a + b . n over its disc (n the surface normal; light from all sides plus light from one), blurred
by the lens, on a flat background, in linear light, with a robust loss because the post hides a
part. A flat printed dot is the case b = 0. A ball's outline is an ellipse away from the middle
of the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from measure.arrays import Floats
from measure.calibration.pattern_fit import BLUR_PX, SUPERSAMPLING, fit_pattern, patch_about, spots
from measure.model import Intrinsics

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
        values, root, start, lambda here: _basis(here, side, shape), least
    ).unknowns
    moved = float(np.linalg.norm(unknowns[:2] - start[:2]))
    if moved > 1.5 * dot.radius_px + 1 or not 0.4 < unknowns[2] / dot.radius_px < 2.5:
        return None
    return Dot(unknowns[:2] + middle, float(unknowns[2]))


def _basis(unknowns: Floats, side: int, shape: Floats) -> Floats:
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
