"""Lens models of growing freedom, and a camera whose free parameters are a plain vector."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats, Ints
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, Projection

_NAMES: dict[Projection, str] = {
    "pinhole": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "fisheye": "fx fy cx cy k1 k2 k3 k4",
}


@dataclass(frozen=True)
class LensModel:
    """Which of fx fy cx cy and the distortion coefficients are free; the rest stay as given."""

    name: str
    free: tuple[int, ...]
    projection: Projection = "pinhole"

    @property
    def parameters(self) -> str:
        """Names of the free parameters."""
        names = _NAMES[self.projection].split()
        return " ".join(names[i] for i in self.free)


LENS_MODELS: tuple[LensModel, ...] = (
    LensModel("pinhole", (0, 1, 2, 3)),
    LensModel("radial1", (0, 1, 2, 3, 4)),
    LensModel("radial2", (0, 1, 2, 3, 4, 5)),
    LensModel("tangential", (0, 1, 2, 3, 4, 5, 6, 7)),
    LensModel("brown", (0, 1, 2, 3, 4, 5, 6, 7, 8)),
)
"""From the stiffest to the freest; each contains the one before."""
MODELS_OF: dict[Projection, tuple[LensModel, ...]] = {
    "pinhole": LENS_MODELS,
    "fisheye": tuple(LensModel(f"fisheye{k}", tuple(range(4 + k)), "fisheye") for k in range(5)),
}


def intrinsics_vector(intrinsics: Intrinsics) -> Floats:
    """Fx fy cx cy and the eight distortion coefficients (12,)."""
    m = intrinsics.matrix
    return np.concatenate([[m[0, 0], m[1, 1], m[0, 2], m[1, 2]], intrinsics.distortion])


def shifted(intrinsics: Intrinsics, free: tuple[int, ...] | Ints, increment: Floats) -> Intrinsics:
    """The intrinsics with `increment` (len(free),) added to the free parameters."""
    vector = intrinsics_vector(intrinsics)
    vector[list(free)] += increment
    matrix = intrinsics.matrix.copy()
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = vector[:4]
    return replace(intrinsics, matrix=matrix, distortion=vector[4:])


def changed(camera: Camera, increment: Floats, free: tuple[int, ...] | Ints) -> Camera:
    """The camera moved by the first six entries, its free lens parameters by the rest."""
    return replace(
        camera,
        world_from_camera=camera.world_from_camera.perturb(increment[:6]),
        intrinsics=shifted(camera.intrinsics, free, increment[6:]),
    )


def lens_change(first: Camera, now: Camera) -> Floats:
    """Lens parameters (12,) of `now` less those of `first`."""
    return intrinsics_vector(now.intrinsics) - intrinsics_vector(first.intrinsics)


def free_parameters(camera: Camera) -> Ints:
    """Indices of the lens parameters that have a variance: those that are not known exactly."""
    P = camera.intrinsics.covariance
    return np.flatnonzero(np.diag(P) > 0) if P is not None else np.zeros(0, dtype=np.int64)


def with_covariance(camera: Camera, P: Floats, free: Ints, rms_px: float | None) -> Camera:
    """The camera with the covariance P of its pose (6) and its free lens parameters, if any."""
    camera = replace(camera, pose_covariance=P[:6, :6], reprojection_rms_px=rms_px)
    if not len(free):
        lens_as_given = replace(camera.intrinsics, covariance=None)
        return replace(camera, intrinsics=lens_as_given, pose_intrinsics_covariance=None)
    lens = np.zeros((12, 12))
    lens[np.ix_(free, free)] = P[6:, 6:]
    cross = np.zeros((6, 12))
    cross[:, free] = P[:6, 6:]
    return replace(
        camera,
        intrinsics=replace(camera.intrinsics, covariance=lens),
        pose_intrinsics_covariance=cross,
    )


def stack(transforms: list[RigidTransform]) -> RigidTransform:
    """A batch of single transforms."""
    return RigidTransform(
        np.stack([t.rotation for t in transforms]), np.stack([t.translation for t in transforms])
    )
