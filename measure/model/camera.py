"""Cameras, each standing somewhere in the world, and several stacked as arrays.

Lenses are OpenCV's pinhole with distortion or its fisheye. One call projects a point into all
cameras of a rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Bools, Floats, Ints, floats
from measure.geometry import Cone, Rays, RigidTransform, tangent_cone
from measure.model.camera_rows import (
    Projection,
    RigRows,
    check_coefficients,
    fisheye_fold,
    pinhole_fold,
)

USUAL_FOCAL = 0.72  # Focal length over the longer side of a picture, of ordinary webcams


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """The lens and sensor of one camera."""

    size_wh: tuple[int, int]  # image width and height in px
    # (3, 3) camera matrix [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] in px, pixel centres at
    # integers.
    matrix: Floats
    # (8,) k1 k2 p1 p2 k3 k4 k5 k6, or of a fisheye k1 k2 k3 k4 and four zeros; shorter OpenCV
    # vectors (0, 4 or 5) are filled with zeros.
    distortion: Floats = field(default_factory=lambda: np.zeros(8))
    # (12, 12) of fx fy cx cy and the eight coefficients, or None if unknown.
    covariance: Floats | None = None
    model: Projection = "pinhole"  # the lens model
    # how much larger about the principal point its red and blue pictures are than the green one,
    # less 1; None if unknown.
    lateral_color: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        given = np.asarray(self.distortion, dtype=np.float64).reshape(-1)
        check_coefficients(given, self.model)
        object.__setattr__(self, "distortion", np.pad(given, (0, 8 - given.size)))
        object.__setattr__(self, "matrix", floats("matrix", self.matrix, 3, 3))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", floats("covariance", self.covariance, 12, 12))

    @property
    def focal_px(self) -> float:
        """Mean focal length in px."""
        return float((self.matrix[0, 0] + self.matrix[1, 1]) / 2)

    @property
    def vector(self) -> Floats:
        """Fx fy cx cy and the eight distortion coefficients (12,), as in `covariance`."""
        m = self.matrix
        return np.concatenate([[m[0, 0], m[1, 1], m[0, 2], m[1, 2]], self.distortion])

    def shifted(self, delta: Floats) -> Intrinsics:
        """The intrinsics with `delta` (12,) added to `vector`."""
        vector, matrix = self.vector + delta, self.matrix.copy()
        matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = vector[:4]
        return replace(self, matrix=matrix, distortion=vector[4:])

    @property
    def free(self) -> Ints:
        """Which of the parameters of `covariance` have a variance: are not known exactly."""
        diagonal = np.zeros(0) if self.covariance is None else np.diag(self.covariance)
        return np.flatnonzero(diagonal > 0)

    @property
    def coefficients(self) -> Floats:
        """The distortion's coefficients that the model has: (8,), of a fisheye (4,)."""
        return self.distortion[:4] if self.model == "fisheye" else self.distortion

    @cached_property
    def row(self) -> Floats:
        """Matrix, distortion, widest angle of a fisheye, lateral colour: (16,), see `lens`."""
        k = self.matrix
        affine = k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]
        widest = np.arctan(self.reach) if self.model == "fisheye" else 0.0
        return np.concatenate([affine, self.distortion, [widest], self.lateral_color or (0.0, 0.0)])

    @cached_property
    def reach(self) -> float:
        """Ideal (undistorted, normalised) radius beyond which the lens model sees nothing."""
        fold = fisheye_fold if self.model == "fisheye" else pinhole_fold
        return fold(self.distortion)

    def project(self, points_camera: ArrayLike) -> Floats:
        """Pixels (n, 2) of points (n, 3) in the camera frame.

        NaN for points not in front of it, or so far aside that the lens model folds.
        """
        from measure.model.projection import project_rows

        points = floats("points_camera", points_camera, "n", 3)
        return project_rows(self._alone, np.ascontiguousarray(points))[0]

    @cached_property
    def _alone(self) -> RigRows:
        """As compiled code takes a camera that stands at the origin."""
        return RigRows(
            lenses=self.row[None],
            reach=np.array([self.reach]),
            rotation=np.eye(3)[None],
            centers=np.zeros((1, 3)),
            covariances=np.zeros((1, 18, 18)),
        )

    def project_with_jacobians(self, points_camera: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Project, with analytic derivatives.

        Args:
            points_camera: (n, 3) in mm (any common unit).

        Returns:
            Pixels (n, 2); their Jacobian by the point (n, 2, 3); and by fx fy cx cy and the eight
            distortion coefficients (n, 2, 12).
        """
        points = floats("points_camera", points_camera, "n", 3)
        pixels, by_point, by_camera = _with_jacobians(self._alone, points)
        return pixels, by_point, by_camera[:, :, 6:]

    def unproject(self, pixels: ArrayLike) -> Floats:
        """Unit bearings (n, 3) of pixels (n, 2); NaN where the lens model has no inverse.

        Points are undistorted, never images: resampling blurs the very edges that are measured.
        """
        from measure.model.projection import ray_rows

        return ray_rows(np.ascontiguousarray(floats("pixels", pixels, "n", 2)), self._alone)

    def outline(self, cone: Cone, count: int = 72) -> Floats:
        """The outline of a sphere, distortion and all: `count` pixels (count, 2) around it."""
        return self.project(cone.bearings(np.arange(count) * (2 * np.pi / count)))

    def contains(self, pixels: Floats, margin_px: float = 0.0) -> Bools:
        """Which pixels (n, 2) lie in the image, at least `margin_px` from its border."""
        upper = np.asarray(self.size_wh) - 1 - margin_px
        with np.errstate(invalid="ignore"):
            return np.all((pixels >= margin_px) & (pixels <= upper), axis=-1)


def _with_jacobians(camera: RigRows, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Pixels (n, 2), Jacobians by the points (n, 2, 3) and by pose and intrinsics (n, 2, 18)."""
    from measure.model.projection import by_cameras, project_rows

    points = np.ascontiguousarray(points)
    pixels, by_point = project_rows(camera, points)
    by_camera = by_cameras(camera, points)
    by_camera[np.isnan(pixels[:, 0])] = np.nan
    return pixels, by_point, by_camera


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera."""

    name: str  # as in the session and the calibration
    intrinsics: Intrinsics  # lens and sensor
    world_from_camera: RigidTransform  # pose; the camera looks along its +z, x right, y down
    # (6, 6) of `world_from_camera` in its `perturb` chart, or None if unknown.
    pose_covariance: Floats | None = None
    reprojection_rms_px: float | None = None  # of the calibration, or None if unknown
    # (6, 12) covariance of the two, or None if unknown. A fit of both leaves them strongly
    # correlated: a turned camera and a moved principal point look alike.
    pose_intrinsics_covariance: Floats | None = None
    # rolling shutter: time from the first row's exposure to the last's, negative if from the bottom
    # up; an image's time is that of its middle row.
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        if self.pose_covariance is not None:
            object.__setattr__(
                self, "pose_covariance", floats("pose_covariance", self.pose_covariance, 6, 6)
            )
        if self.pose_intrinsics_covariance is not None:
            cross = floats("pose_intrinsics_covariance", self.pose_intrinsics_covariance, 6, 12)
            object.__setattr__(self, "pose_intrinsics_covariance", cross)

    @cached_property
    def camera_from_world(self) -> RigidTransform:
        """The inverse of the pose."""
        return self.world_from_camera.inverse()

    @property
    def center(self) -> Floats:
        """The projection centre (3,) in the world, mm."""
        return self.world_from_camera.translation

    @cached_property
    def covariance(self) -> Floats | None:
        """(18, 18) of pose and intrinsics together, or None if neither is known.

        What is not known counts as exact, and as independent.
        """
        pose, lens = self.pose_covariance, self.intrinsics.covariance
        if pose is None and lens is None:
            return None
        out = np.zeros((18, 18))
        out[:6, :6] = 0.0 if pose is None else pose
        out[6:, 6:] = 0.0 if lens is None else lens
        if pose is not None and lens is not None and self.pose_intrinsics_covariance is not None:
            out[:6, 6:] = self.pose_intrinsics_covariance
            out[6:, :6] = self.pose_intrinsics_covariance.T
        return out

    @property
    def free(self) -> Ints:
        """Which of the parameters of `perturb` are not known exactly: the pose, and of the lens."""
        return np.concatenate([np.arange(6), 6 + self.intrinsics.free])

    def perturb(self, delta: Floats) -> Camera:
        """The neighbour at `delta` (18,): of the pose in its `perturb` chart, of the intrinsics."""
        return replace(
            self,
            world_from_camera=self.world_from_camera.perturb(delta[:6]),
            intrinsics=self.intrinsics.shifted(delta[6:]),
        )

    def difference(self, reference: Camera) -> Floats:
        """The `delta` (18,) with `reference.perturb(delta)` where and as this camera is."""
        moved = self.world_from_camera.difference(reference.world_from_camera)
        return np.concatenate([moved, self.intrinsics.vector - reference.intrinsics.vector])

    def with_covariance(self, covariance: Floats, free: Ints, rms_px: float | None) -> Camera:
        """The same with the covariance of its pose (6) and its `free` lens parameters, if any."""
        lens, cross = None, None
        if len(free):
            lens, cross = np.zeros((12, 12)), np.zeros((6, 12))
            lens[np.ix_(free, free)], cross[:, free] = covariance[6:, 6:], covariance[:6, 6:]
        return replace(
            self,
            intrinsics=replace(self.intrinsics, covariance=lens),
            pose_covariance=covariance[:6, :6],
            pose_intrinsics_covariance=cross,
            reprojection_rms_px=rms_px,
        )

    def row_delay_s(self, row_px: ArrayLike) -> Floats:
        """How much later than the middle row other rows (...) are exposed."""
        height = self.intrinsics.size_wh[1]
        rows = np.asarray(row_px, dtype=np.float64)
        return np.asarray(self.readout_s * (rows - (height - 1) / 2) / height)

    def project(self, points_world: ArrayLike) -> Floats:
        """Pixels (n, 2) of world points (n, 3); NaN for points without an image."""
        return self.intrinsics.project(
            self.camera_from_world.apply(floats("points_world", points_world, "n", 3))
        )

    def project_with_jacobians(
        self, points_world: ArrayLike
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Project, with analytic derivatives.

        Returns:
            Pixels (n, 2); Jacobians by the world point (n, 2, 3), by the pose's `perturb` chart
            (n, 2, 6), and by the intrinsics (n, 2, 12).
        """
        world = floats("points_world", points_world, "n", 3)
        pixels, by_world, by_camera = _with_jacobians(Rig.of((self,)).rows, world)
        return pixels, by_world, by_camera[:, :, :6], by_camera[:, :, 6:]

    def rays(self, pixels: ArrayLike) -> Rays:
        """World rays of pixels (n, 2)."""
        directions = self.world_from_camera.rotate(self.intrinsics.unproject(pixels))
        return Rays(np.broadcast_to(self.center, directions.shape), directions)

    def hides(self, centers_world: Floats, radii_mm: Floats, share: float = 0.0) -> Bools:
        """Whether ball j is before ball i, as [i, j] of (n, n).

        Args:
            centers_world: (n, 3) mm.
            radii_mm: (n,)
            share: which point of ball i counts: its centre (0), or any within so many radii.
        """
        away = centers_world - self.center
        far = np.linalg.norm(away, axis=1)
        depth = away @ (away / far[:, None]).T  # of ball j along the line to ball i, [j, i]
        off = np.sqrt(np.maximum((far**2)[:, None] - depth**2, 0.0))
        before = (off < radii_mm[:, None] + share * radii_mm * depth / far) & (depth < far)
        return np.asarray(before.T & ~np.eye(len(far), dtype=bool))

    def outline(self, center_world: ArrayLike, radius_mm: float, count: int = 72) -> Floats:
        """The outline (count, 2) in px of a sphere in the world; NaN where it has no image.

        Raises:
            DegenerateGeometryError: the camera is inside the sphere.
        """
        center = self.camera_from_world.apply(floats("center_world", center_world, 3))
        return self.intrinsics.outline(tangent_cone(center, radius_mm), count)


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras as arrays, one row per camera; a camera may stand in it more than once."""

    names: tuple[str, ...]  # (n,) of the cameras
    rows: RigRows  # of the cameras, in the same order

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Rig:
        """Stack `cameras`; the same cameras are stacked only once."""
        return _stacked(tuple(cameras))

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def uncertain(self) -> bool:
        """Whether anything about the cameras is stated to be uncertain."""
        return bool(np.any(self.rows.covariances))

    @property
    def centers(self) -> Floats:
        """Projection centres (n, 3) in the world, mm."""
        return self.rows.centers

    @property
    def focal_px(self) -> Floats:
        """Mean focal lengths (n,) in px."""
        return (self.rows.lenses[:, 0] + self.rows.lenses[:, 3]) / 2

    def take(self, rows: ArrayLike) -> Rig:
        """The cameras of some `rows`, in that order."""
        index = np.asarray(rows, dtype=np.int64)
        names = tuple(self.names[i] for i in index.tolist())
        return Rig(names, RigRows._make(each[index] for each in self.rows))

    def project(self, points_world: Floats) -> tuple[Floats, Floats]:
        """Project point i into camera i.

        Args:
            points_world: (n, 3) in mm, or one point (3,) for all cameras.

        Returns:
            Pixels (n, 2) and their Jacobians by the world point (n, 2, 3); NaN for
            points without an image.
        """
        from measure.model.projection import project_rows

        points = np.broadcast_to(points_world, (len(self), 3))
        return project_rows(self.rows, np.ascontiguousarray(points, dtype=np.float64))

    def rays(self, pixels: Floats) -> Rays:
        """World rays of pixel i (n, 2) in camera i; NaN where the lens has no inverse."""
        from measure.model.projection import ray_rows

        seen = np.ascontiguousarray(pixels, dtype=np.float64)
        return Rays(self.centers, ray_rows(seen, self.rows))


@lru_cache(maxsize=256)
def _stacked(cameras: tuple[Camera, ...]) -> Rig:
    """Cameras compare by identity: what is kept never stands for a camera that was changed."""
    lenses, unknown = [camera.intrinsics for camera in cameras], np.zeros((18, 18))
    known = [unknown if c.covariance is None else c.covariance for c in cameras]
    rows = RigRows(
        np.array([lens.row for lens in lenses]).reshape(-1, 16),
        np.array([lens.reach for lens in lenses], dtype=np.float64),
        np.array([c.world_from_camera.rotation for c in cameras]).reshape(-1, 3, 3),
        np.array([c.center for c in cameras]).reshape(-1, 3),
        np.array(known).reshape(-1, 18, 18),
    )
    return Rig(tuple(camera.name for camera in cameras), rows)
