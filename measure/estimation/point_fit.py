"""Points fitted to their pixels in several pictures, compiled: see `multiview.fit_point`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.compiling import compiled
from measure.geometry.kernels import inverse, solved
from measure.geometry.rays import MIN_PARALLAX_RAD
from measure.limits import MAX_STEPS, SETTLED
from measure.model.camera_rows import RigRows
from measure.model.projection import camera_noise, project_one, ray_rows, rows_between

FITTED, PARALLEL, BEHIND = 0, 1, 2
"""How a fit ends: with a point, without one for parallel rays, with one behind a camera."""


class PointFit(NamedTuple):
    """A point fitted to n pixels."""

    point: Floats  # (3,) mm
    covariance: Floats  # (3, 3) mm^2 from the weights, calibration included
    residuals_px: Floats  # (n, 2)
    chi_square: float  # of the residuals under the weights, 2 n - 3 degrees of freedom
    # (n,) squared Mahalanobis distances of the residuals, 2 degrees of freedom each, with
    # `extra_px` added to the pixels' standard deviations.
    disagreement: Floats
    distances_mm: Floats  # (n,) of the rays from the point
    end: int  # FITTED, PARALLEL or BEHIND


@compiled
def fit_point_rows(
    rig: RigRows, pixels: Floats, noise: Floats, shifts: Floats, extra_px: float
) -> PointFit:
    """The point that n >= 2 pixels show, by Gauss-Newton from the point nearest to their rays.

    See docs/explanation/joint_fit.md, formula 21.

    Args:
        rig: the n cameras.
        pixels: (n, 2).
        noise: (n, 2, 2) covariances of the pixels alone.
        shifts: (n, 3) where each camera saw the point, relative to where it is.
        extra_px: added to every pixel's standard deviation in `disagreement`, in quadrature.
    """
    directions, origins = ray_rows(pixels, rig), rig.centers - shifts
    start, meet = nearest_to_rays(origins, directions)
    total = noise + camera_noise(rig, start + shifts)
    point, information, residuals, chi_square, seen = refine_point(
        rig, pixels, shifts, total, start
    )
    off, distances = np.zeros(len(pixels)), np.zeros(len(pixels))
    if not meet or not seen:
        end = BEHIND if meet else PARALLEL
        return PointFit(point, information, residuals, chi_square, off, distances, end)
    total = noise + camera_noise(rig, point + shifts)
    for i in range(len(pixels)):
        a, b = total[i, 0, 0] + extra_px**2, total[i, 1, 1] + extra_px**2
        c, u, v = total[i, 0, 1], residuals[i, 0], residuals[i, 1]
        off[i] = (b * u * u - 2 * c * u * v + a * v * v) / (a * b - c * c)
        distances[i] = _distance(point, origins[i], directions[i])
    return PointFit(point, inverse(information), residuals, chi_square, off, distances, FITTED)


class PointFits(NamedTuple):
    """k points fitted to n pixels, see `PointFit`."""

    points: Floats  # (k, 3)
    covariances: Floats  # (k, 3, 3)
    chi_squares: Floats  # (k,)
    disagreements: Floats  # (k,) sums of those of the point's pixels
    distances_mm: Floats  # (n,)
    ends: Ints  # (k,)

    @property
    def fitted(self) -> Bools:
        """Which of the k points (k,) were found; the rays of others are parallel or meet behind."""
        return np.asarray(self.ends == FITTED)


@compiled
def fit_points(
    starts: Ints, rig: RigRows, pixels: Floats, noise: Floats, extra_px: float
) -> PointFits:
    """`fit_point_rows` for k points one after the other, each at rest.

    Args:
        starts: (k + 1,) where each point's rows begin; the others are as in `fit_point_rows`.
    """
    k = len(starts) - 1
    points, known, distances = np.empty((k, 3)), np.empty((k, 3, 3)), np.empty(len(pixels))
    chi_squares, disagreements, ends = np.empty(k), np.empty(k), np.empty(k, np.int64)
    for i in range(k):
        a, b = starts[i], starts[i + 1]
        own = rows_between(rig, a, b)
        fit = fit_point_rows(own, pixels[a:b], noise[a:b], np.zeros((b - a, 3)), extra_px)
        points[i], known[i], ends[i] = fit.point, fit.covariance, fit.end
        chi_squares[i], disagreements[i] = fit.chi_square, np.sum(fit.disagreement)
        distances[a:b] = fit.distances_mm
    return PointFits(points, known, chi_squares, disagreements, distances, ends)


@compiled
def nearest_to_rays(origins: Floats, directions: Floats) -> tuple[Floats, bool]:
    """The point (3,) nearest to lines, and whether there is one: see `geometry.nearest_point`."""
    point, normal, right = np.full(3, np.nan), np.zeros((3, 3)), np.zeros(3)
    for i in range(len(origins)):
        for a in range(3):
            for b in range(3):
                across = (1.0 if a == b else 0.0) - directions[i, a] * directions[i, b]
                normal[a, b] += across
                right[a] += across * origins[i, b]
    if not np.all(np.isfinite(normal)):
        return point, True
    spread = np.linalg.eigvalsh(normal)
    if spread[0] < spread[2] * MIN_PARALLAX_RAD**2:
        return point, False
    point[:] = solved(normal, right)
    return point, True


@compiled
def _distance(point: Floats, origin: Floats, direction: Floats) -> float:
    """Distance of a point from a line."""
    x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    p, q, r = direction
    return float(np.sqrt((y * r - z * q) ** 2 + (z * p - x * r) ** 2 + (x * q - y * p) ** 2))


@compiled
def refine_point(
    rig: RigRows, pixels: Floats, shifts: Floats, noise: Floats, start: Floats
) -> tuple[Floats, Floats, Floats, float, bool]:
    """Gauss-Newton from `start` with fixed weights; everything else as in `fit_point_rows`.

    Args:
        noise: (n, 2, 2) total covariances of the pixels.
        start: (3,) mm.

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
    for step_count in range(MAX_STEPS + 1):
        normal[:], right[:], chi_square = 0.0, 0.0, 0.0
        for i in range(n):
            project_one(rig, i, point + shifts[i], pixel, by_point)
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
        if settled or step_count == MAX_STEPS:
            break
        step = solved(normal, right)
        point += step
        settled = np.max(np.abs(step)) < SETTLED
    return point, normal, residuals, chi_square, True


def warm_up_point_fits() -> None:
    """Compile the fits, by fitting a point to pixels of two cameras in one place."""
    two, noise = np.zeros((2, 3)), np.zeros((2, 2, 2))
    lenses = np.tile(np.eye(1, 16) + np.eye(1, 16, 3), (2, 1))
    turns = np.stack([np.eye(3), np.eye(3)])
    rig = RigRows(lenses, np.full(2, np.inf), turns, two, np.zeros((2, 18, 18)))
    fit_point_rows(rig, two[:, :2].copy(), noise, two, 0.0)
    fit_points(np.array([0, 2]), rig, two[:, :2].copy(), noise, 0.0)
