"""Whether measured ball centres are those of the body: their distances, and their handedness."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import align_points
from measure.limits import SIGNIFICANT_SIGMAS
from measure.model import Body, Doubt

_MAX_MIRRORED_RMS_RATIO = 0.5
"""RMS of the mirrored body over the body's own below which the centres are called mirrored."""
_MIN_THICKNESS_MM = 1.0  # A body thinner than this about its plane is its own mirror image


def layout_flags(
    body: Body, balls: Sequence[str], centers: Floats, covariances: Floats, tolerance_mm: float
) -> tuple[str, ...]:
    """Reasons to doubt that `centers` are this body's balls, for `Pose.flags`.

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
        Doubt("distance", balls=both, measured_mm=measured, file_mm=expected)
        for both, (measured, expected, sd) in zip(combinations(balls, 2), pairs, strict=True)
        if abs(measured - expected) > SIGNIFICANT_SIGMAS * sd + tolerance_mm
    ]
    if looks_mirrored(points_body, centers):
        flags.append(Doubt("mirror-image"))
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


def pair_distances(points_body: Floats, centers: Floats, covariances: Floats) -> Floats:
    """Distances of every two of n balls: (0, 1), (0, 2) ... (1, 2) ...

    Args:
        points_body: (n, 3) centres in the body file, mm.
        centers: (n, 3) as measured, mm.
        covariances: (n, 3, 3) of those.

    Returns:
        (n (n - 1) / 2, 3) as measured, as the file says, and the standard deviation, mm.
    """
    a, b = np.triu_indices(len(centers), 1)
    apart = centers[a] - centers[b]
    measured = np.linalg.norm(apart, axis=1)
    along = apart / np.maximum(measured, 1e-9)[:, None]
    variance = np.einsum("ni,nij,nj->n", along, covariances[a] + covariances[b], along)
    stated = np.linalg.norm(points_body[a] - points_body[b], axis=1)
    return np.column_stack([measured, stated, np.sqrt(variance)])
