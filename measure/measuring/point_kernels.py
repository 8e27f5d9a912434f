"""One point from several pictures, compiled: see `multiview`."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.model.lens import bend
from measure.model.rig_kernels import project_one

_STEPS = 12
_STEP_TOLERANCE_MM = 1e-7


@compiled
def sensitivities(
    lenses: Floats,
    reach: Floats,
    rotation: Floats,
    centers: Floats,
    seen: Floats,
    min_depth: float,
) -> tuple[Floats, Floats, Floats]:
    """Pixels (n, 2) of points (n, 3); their Jacobians by the points and the cameras' poses.

    A camera's pose changes in its `perturb` chart: moving it by (dt, w) moves the point, as the
    camera sees it, by -dt - w x (X - t).

    Returns:
        (n, 2), (n, 2, 3) and (n, 2, 6).
    """
    n = len(seen)
    pixels, by_point, by_pose = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 2, 6))
    for i in range(n):
        project_one(
            lenses[i], reach[i], rotation[i], centers[i], seen[i], min_depth, pixels[i],
            by_point[i],
        )  # fmt: skip
        x, y, z = seen[i, 0] - centers[i, 0], seen[i, 1] - centers[i, 1], seen[i, 2] - centers[i, 2]
        for a in range(2):
            p, q, r = by_point[i, a]
            by_pose[i, a, 0], by_pose[i, a, 1], by_pose[i, a, 2] = -p, -q, -r
            by_pose[i, a, 3] = q * z - r * y
            by_pose[i, a, 4] = r * x - p * z
            by_pose[i, a, 5] = p * y - q * x
    return pixels, by_point, by_pose


@compiled
def by_cameras(
    lenses: Floats,
    rotation: Floats,
    centers: Floats,
    seen: Floats,
    by_pose: Floats,
    covariances: Floats,
) -> Floats:
    """Jacobians (n, 2, 18) of pixels by poses and intrinsics; zero where nothing is uncertain."""
    out = np.zeros((len(seen), 2, 18))
    for i in range(len(seen)):
        if covariances[i, 0, 0] > 0:
            out[i, :, :6] = by_pose[i]
        if covariances[i, 6, 6] > 0:
            x, y = _ideal(rotation[i], centers[i], seen[i])
            _by_lens(x, y, lenses[i], out[i, :, 6:])
    return out


@compiled
def _ideal(rotation: Floats, center: Floats, point: Floats) -> tuple[float, float]:
    """The normalised image point, lens left out, of a world point."""
    dx, dy, dz = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    px = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
    py = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
    pz = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
    return px / pz, py / pz


@compiled
def _by_lens(x: float, y: float, lens: Floats, out: Floats) -> None:
    """A pixel's derivatives (2, 12) by fx fy cx cy and the eight distortion coefficients."""
    r2 = x * x + y * y
    below = 1 + r2 * (lens[10] + r2 * (lens[11] + r2 * lens[12]))
    radial = (1 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))) / below
    out[0, 0], out[1, 1] = bend(x, y, lens)
    out[0, 2] = out[1, 3] = 1.0
    for power in range(3):
        gain = r2 ** (power + 1) / below
        above = 8 if power == 2 else 4 + power
        _lens_column(out, above, x * gain, y * gain, lens)
        _lens_column(out, 9 + power, -radial * x * gain, -radial * y * gain, lens)
    _lens_column(out, 6, 2 * x * y, r2 + 2 * y * y, lens)
    _lens_column(out, 7, r2 + 2 * x * x, 2 * x * y, lens)


@compiled
def _lens_column(out: Floats, column: int, du: float, dv: float, lens: Floats) -> None:
    out[0, column] = lens[0] * du + lens[1] * dv
    out[1, column] = lens[3] * dv


@compiled
def refine_point(
    lenses: Floats,
    reach: Floats,
    rotation: Floats,
    centers: Floats,
    pixels: Floats,
    shifts: Floats,
    noise: Floats,
    start: Floats,
    min_depth: float,
) -> tuple[Floats, Floats, Floats, float, bool]:
    """Gauss-Newton from `start` with fixed weights.

    Args:
        lenses: (n, 13).
        reach: (n,) of the lens models.
        rotation: (n, 3, 3) of world_from_camera.
        centers: (n, 3) of the cameras.
        pixels: (n, 2).
        shifts: (n, 3) where each camera saw the point, relative to where it is.
        noise: (n, 2, 2) total covariances of the pixels.
        start: (3,) mm.
        min_depth: see `rig_kernels.project_one`.

    Returns:
        The point (3,), its information (3, 3), residuals (n, 2), chi-square, and whether the point
        stayed in front of every camera.
    """
    n = len(pixels)
    point, pixel, by_point = start.copy(), np.empty(2), np.empty((2, 3))
    weight = np.empty((n, 3))
    for i in range(n):
        det = noise[i, 0, 0] * noise[i, 1, 1] - noise[i, 0, 1] * noise[i, 1, 0]
        weight[i, 0], weight[i, 1] = noise[i, 1, 1] / det, noise[i, 0, 0] / det
        weight[i, 2] = -noise[i, 0, 1] / det
    normal, right, residuals = np.empty((3, 3)), np.empty(3), np.empty((n, 2))
    chi_square, settled = 0.0, False
    for turn in range(_STEPS + 1):
        normal[:], right[:], chi_square = 0.0, 0.0, 0.0
        for i in range(n):
            project_one(
                lenses[i], reach[i], rotation[i], centers[i], point + shifts[i], min_depth, pixel,
                by_point,
            )  # fmt: skip
            u, v = pixels[i, 0] - pixel[0], pixels[i, 1] - pixel[1]
            residuals[i, 0], residuals[i, 1] = u, v
            wu, wv = weight[i, 0] * u + weight[i, 2] * v, weight[i, 2] * u + weight[i, 1] * v
            chi_square += u * wu + v * wv
            for a in range(3):
                right[a] += by_point[0, a] * wu + by_point[1, a] * wv
                ga = weight[i, 0] * by_point[0, a] + weight[i, 2] * by_point[1, a]
                gb = weight[i, 2] * by_point[0, a] + weight[i, 1] * by_point[1, a]
                for b in range(3):
                    normal[a, b] += ga * by_point[0, b] + gb * by_point[1, b]
        if not np.isfinite(chi_square):
            return point, normal, residuals, chi_square, False
        if settled or turn == _STEPS:
            break
        step = np.linalg.solve(normal, right)
        point += step
        settled = np.max(np.abs(step)) < _STEP_TOLERANCE_MM
    return point, normal, residuals, chi_square, True
