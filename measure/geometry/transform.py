"""Rigid transforms, named `target_from_source` wherever they appear."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from measure.arrays import Floats, Ints, floats
from measure.errors import DegenerateGeometryError

ROTATION_TOLERANCE = 1e-6
"""A matrix from a file is a rotation if R R^T is the identity within this, entry by entry."""


def skew(vectors: ArrayLike) -> Floats:
    """Cross-product matrices: `skew(a) @ b == cross(a, b)`.

    Args:
        vectors: (..., 3).

    Returns:
        (..., 3, 3).
    """
    v = floats("vectors", vectors, "...", 3)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def chart_jacobian(arms: Floats) -> Floats:
    """How points move with the `perturb` chart of what carries them: (..., 3, 6).

    Args:
        arms: (..., 3) of the points from the carrier's origin, in the chart's frame.
    """
    return np.concatenate([np.broadcast_to(np.eye(3), (*arms.shape, 3)), -skew(arms)], axis=-1)


def _is_single(rotation: object, translation: object) -> bool:
    """Whether these are what one transform is made of, with nothing to convert."""
    return (
        type(rotation) is np.ndarray
        and type(translation) is np.ndarray
        and rotation.shape == (3, 3)
        and translation.shape == (3,)
        and rotation.dtype == translation.dtype == np.float64
    )


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """A rotation followed by a translation, or a batch of them.

    Points go `points_target = rotation @ points_source + translation`; transforms compose by
    cancelling the inner names: `world_from_body = world_from_camera @ camera_from_body`.
    """

    # (..., 3, 3) proper rotation matrices; taken as they are, so that composing stays cheap. What
    # comes from outside enters by `from_quat_wxyz` or `from_matrix`.
    rotation: Floats
    translation: Floats  # (..., 3) in mm. Batch axes of the two are broadcast against each other

    def __post_init__(self) -> None:
        if _is_single(self.rotation, self.translation):
            return
        rotation = floats("rotation", self.rotation, "...", 3, 3)
        translation = floats("translation", self.translation, "...", 3)
        if rotation.shape[:-2] != translation.shape[:-1]:
            batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
            rotation = np.broadcast_to(rotation, (*batch, 3, 3))
            translation = np.broadcast_to(translation, (*batch, 3))
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @classmethod
    def identity(cls) -> RigidTransform:
        """The transform that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quat_wxyz(cls, quat_wxyz: ArrayLike, translation: ArrayLike) -> RigidTransform:
        """From quaternions (..., 4), scalar first, any length; and translations (..., 3) in mm."""
        rotation = Rotation.from_quat(floats("quat_wxyz", quat_wxyz, "...", 4), scalar_first=True)
        return cls(rotation.as_matrix(), floats("translation", translation, "...", 3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> RigidTransform:
        """From homogeneous matrices (..., 4, 4), as found in files.

        Raises:
            ValueError: the upper left part scales, shears or mirrors.
        """
        m = floats("matrix", matrix, "...", 4, 4)
        rotation = m[..., :3, :3]
        defect = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max(initial=0.0)
        handed = np.sum(
            np.cross(rotation[..., 0, :], rotation[..., 1, :]) * rotation[..., 2, :], -1
        )
        if not (defect < ROTATION_TOLERANCE and np.all(handed > 0)):
            raise ValueError(
                "matrix: its upper left 3x3 is not a rotation (R R^T differs from the identity by "
                f"{defect:.2g}, determinant {np.min(handed):.3g})"
            )
        return cls(rotation, m[..., :3, 3])

    @classmethod
    def from_rotvec(
        cls, rotvec: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)
    ) -> RigidTransform:
        """From rotation vectors (..., 3) in rad and translations (..., 3) in mm."""
        rotation = _exponential(floats("rotvec", rotvec, "...", 3))
        return cls(rotation, floats("translation", translation, "...", 3))

    @property
    def quat_wxyz(self) -> Floats:
        """Unit quaternions (..., 4), scalar first and not negative."""
        return np.asarray(
            Rotation.from_matrix(self.rotation).as_quat(canonical=True, scalar_first=True)
        )

    @property
    def rotvec(self) -> Floats:
        """Rotation vectors (..., 3) in rad, of length at most pi."""
        return _logarithm(self.rotation)

    @property
    def matrix(self) -> Floats:
        """Homogeneous matrices (..., 4, 4)."""
        out = np.zeros((*self.translation.shape[:-1], 4, 4))
        out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = self.rotation, self.translation, 1.0
        return out

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        return RigidTransform(self.rotation @ other.rotation, self.apply(other.translation))

    @classmethod
    def stack(cls, transforms: Sequence[RigidTransform]) -> RigidTransform:
        """A batch of single transforms."""
        rotations = np.stack([one.rotation for one in transforms])
        return cls(rotations, np.stack([one.translation for one in transforms]))

    def __getitem__(self, index: int | slice | Ints) -> RigidTransform:
        return RigidTransform(self.rotation[index], self.translation[index])

    def apply(self, points: ArrayLike) -> Floats:
        """Move points (..., 3) from the source frame to the target frame."""
        p = floats("points", points, "...", 3)
        return np.einsum("...ij,...j->...i", self.rotation, p) + self.translation

    def rotate(self, vectors: ArrayLike) -> Floats:
        """Turn free vectors (..., 3), which know no origin, into the target frame."""
        return np.einsum("...ij,...j->...i", self.rotation, floats("vectors", vectors, "...", 3))

    def inverse(self) -> RigidTransform:
        """The transform the other way: `source_from_target`."""
        rotation = np.swapaxes(self.rotation, -1, -2)
        return RigidTransform(rotation, -np.einsum("...ij,...j->...i", rotation, self.translation))

    def perturb(self, delta: ArrayLike) -> RigidTransform:
        """The neighbour at `delta` = (dx dy dz mm, rotation vector rad), both in the target frame.

        This is the chart every 6x6 covariance of this project is written in
        (docs/conventions.md): the translation moves by `delta[:3]`, and the rotation is multiplied
        on the left by exp(`delta[3:]`).
        """
        d = floats("delta", delta, "...", 6)
        turn = _exponential(d[..., 3:])
        return RigidTransform(turn @ self.rotation, self.translation + d[..., :3])

    def difference(self, reference: RigidTransform) -> Floats:
        """The `delta` (..., 6) with `reference.perturb(delta) == self`."""
        turn = self.rotation @ np.swapaxes(reference.rotation, -1, -2)
        shift, turn = np.broadcast_arrays(
            self.translation - reference.translation, _logarithm(turn)
        )
        return np.concatenate([shift, turn], axis=-1)


def _exponential(rotvec: Floats) -> Floats:
    """Rotations (..., 3, 3) of rotation vectors (..., 3) in rad; a single one by Rodrigues."""
    if rotvec.ndim > 1:
        return np.asarray(Rotation.from_rotvec(rotvec).as_matrix())
    x, y, z = rotvec.tolist()
    square = x * x + y * y + z * z
    if not square > 1e-16:  # also not a number, which has to stay one
        return np.eye(3) + skew(rotvec)
    angle = math.sqrt(square)
    a, b = math.sin(angle) / angle, 2 * (math.sin(angle / 2) / angle) ** 2
    return np.array(
        [
            [1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)],
        ]
    )


def _logarithm(rotation: Floats) -> Floats:
    """Rotation vectors (..., 3) of rotations (..., 3, 3); a single one far from 180 deg by hand."""
    if rotation.ndim == 2:
        (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
        x, y, z = (h - f) / 2, (c - g) / 2, (d - b) / 2
        sine, cosine = math.sqrt(x * x + y * y + z * z), (a + e + i - 1) / 2
        if cosine > 0:
            ratio = math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0
            return np.array([x * ratio, y * ratio, z * ratio])
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


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
