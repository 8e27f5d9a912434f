"""Whether measured ball centres are those of the body: their distances, and their handedness."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.errors import DegenerateGeometryError
from measure.geometry import align_points
from measure.geometry.rotation_kernels import apply_matrix
from measure.model import Body

_MAX_DISTANCE_SIGMAS = 4.0
_MAX_MIRRORED_RMS_RATIO = 0.5
"""RMS of the mirrored body over the body's own below which the centres are called mirrored."""
_MIN_THICKNESS_MM = 1.0  # A body thinner than this about its plane is its own mirror image


def layout_flags(
    body: Body, balls: Sequence[str], centers: Floats, covariances: Floats, tolerance_mm: float
) -> tuple[str, ...]:
    """Reasons to doubt that `centers` are this body's balls, as texts for `Pose.flags`.

    Args:
        body: as its file says.
        balls: names of the n balls, in the order of `centers`.
        centers: (n, 3) in mm, in one frame.
        covariances: (n, 3, 3) of `centers`.
        tolerance_mm: how far a distance may be off beyond four of its standard deviations, that of
            the balls' places on the body included.
    """
    points_body = body.centers_of(balls)
    stated = covariances + body.center_covariance
    pairs = pair_distances(points_body, centers, stated).tolist()
    flags = [
        f"balls {one} and {other} are {measured:.1f} mm apart, the body says {expected:.1f} mm"
        for (one, other), (measured, expected, sd) in zip(
            combinations(balls, 2), pairs, strict=True
        )
        if abs(measured - expected) > _MAX_DISTANCE_SIGMAS * sd + tolerance_mm
    ]
    if looks_mirrored(points_body, centers):
        flags.append("the balls form the mirror image of the body")
    return tuple(flags)


def looks_mirrored(points_body: Floats, centers: Floats) -> bool:
    """Whether the mirror image of the body fits (n, 3) centres much better than the body does.

    Never for balls in one plane: such a body turned over is its own mirror image.
    """
    if len(points_body) < 4 or thickness(points_body) < _MIN_THICKNESS_MM:
        return False
    try:
        rms = [
            float(np.sqrt(np.mean((centers - align_points(centers, p).apply(p)) ** 2)))
            for p in (points_body, points_body * [1.0, 1.0, -1.0])
        ]
    except DegenerateGeometryError:
        return False
    return rms[1] < _MAX_MIRRORED_RMS_RATIO * rms[0]


def thickness(points_body: Floats) -> float:
    """RMS distance in mm of points (n, 3) from their best plane."""
    centred = points_body - points_body.mean(axis=0)
    return float(np.linalg.svd(centred, compute_uv=False)[2] / np.sqrt(len(centred)))


@compiled
def pair_distances(points_body: Floats, centers: Floats, covariances: Floats) -> Floats:
    """Distances of every two of n balls: (0, 1), (0, 2) ... (1, 2) ...

    Args:
        points_body: (n, 3) centres in the body file, mm.
        centers: (n, 3) as measured, mm.
        covariances: (n, 3, 3) of those.

    Returns:
        (n (n - 1) / 2, 3) as measured, as the file says, and the standard deviation, mm.
    """
    n, row = len(centers), 0
    out = np.empty((n * (n - 1) // 2, 3))
    for i in range(n):
        for j in range(i + 1, n):
            apart, nominal = centers[i] - centers[j], points_body[i] - points_body[j]
            out[row, 0] = np.sqrt(np.sum(apart * apart))
            out[row, 1] = np.sqrt(np.sum(nominal * nominal))
            along, variance = apart / max(out[row, 0], 1e-9), 0.0
            for a in range(3):
                for b in range(3):
                    noise = covariances[i, a, b] + covariances[j, a, b]
                    variance += along[a] * noise * along[b]
            out[row, 2] = np.sqrt(variance)
            row += 1
    return out


@compiled
def distances_from_body(
    rotation: Floats, translation: Floats, points_body: Floats, centers: Floats, covariances: Floats
) -> Floats:
    """Distances of n measured balls from where a pose puts them.

    Args:
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        points_body: (n, 3) centres in the body file, mm.
        centers: (n, 3) as measured, mm.
        covariances: (n, 3, 3) of those.

    Returns:
        (n, 2) squared Mahalanobis distances, and distances in mm.
    """
    out = np.empty((len(centers), 2))
    for i in range(len(centers)):
        off = centers[i] - apply_matrix(rotation, points_body[i]) - translation
        out[i, 0] = np.sum(off * np.linalg.solve(covariances[i], off))
        out[i, 1] = np.sqrt(np.sum(off * off))
    return out
