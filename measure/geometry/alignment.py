"""The rigid transform between two sets of corresponding points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import floats
from measure.errors import DegenerateGeometryError
from measure.geometry.transform import RigidTransform


def align_points(
    target: ArrayLike, source: ArrayLike, weights: ArrayLike | None = None
) -> RigidTransform:
    """The transform target_from_source that minimises the weighted squared distances.

    Closed form by singular values, never a reflection (Umeyama 1991, eq. 40-42, without scale).

    Args:
        target: (n, 3) points in mm, n >= 3 and not on one line.
        source: (n, 3) the same points in the source frame.
        weights: (n,) inverse variances up to a factor; all equal if omitted.

    Raises:
        DegenerateGeometryError: fewer than three points, all on one line, or some not finite.
    """
    q, p = floats("target", target, "n", 3), floats("source", source, len(np.atleast_2d(target)), 3)
    w = np.ones(len(p)) if weights is None else floats("weights", weights, len(p))
    finite = np.isfinite(q).all(axis=1) & np.isfinite(p).all(axis=1) & np.isfinite(w)
    if len(p) < 3 or not finite.all():
        raise DegenerateGeometryError(
            f"aligning needs 3 points with finite coordinates, got {np.count_nonzero(finite)} "
            f"of {len(p)}"
        )
    w = w / w.sum()
    q0, p0 = w @ q, w @ p
    u, s, vt = np.linalg.svd((w[:, None] * (q - q0)).T @ (p - p0))
    if s[1] < 1e-9 * max(s[0], 1e-300):
        raise DegenerateGeometryError(
            f"{len(p)} points on one line (singular values {s[0]:.3g}, {s[1]:.3g} mm^2) "
            "leave a turn about it free"
        )
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    return RigidTransform(rotation, q0 - rotation @ p0)
