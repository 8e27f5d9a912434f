"""Moving detections of different times to one instant by the body's predicted motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.estimation.pose_fit import PoseObservations
from measure.geometry import RigidTransform, skew
from measure.geometry.linear_kernels import inverse_2x2, invert_scaled
from measure.geometry.rotation_kernels import apply_matrix, turned
from measure.model import BallView, Body, Camera, Detection, Motion, Pose
from measure.model.observations import State
from measure.model.rig import RigRows
from measure.model.rig_kernels import project_one

_SYSTEMATIC_PX = 0.3
"""Systematic error of a detection, added to its noise: it limits differences of their weights."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameSetObservations:
    """The n effective detections of one frame set, also as arrays."""

    detections: tuple[Detection, ...]  # n of them
    time_s: float  # the common instant
    times_s: tuple[float, ...]  # their own times, each once
    rows: PoseObservations | None  # the same as arrays; None if there are none
    # standard deviations of the images' stamps by camera, where they are known.
    time_sds_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def simultaneous(self) -> bool:
        """Whether they are all of one time, so that no motion matters."""
        return len(self.times_s) < 2

    @classmethod
    def of(
        cls,
        views: Sequence[BallView],
        time_s: float,
        body: Body,
        cameras: Mapping[str, Camera],
        time_sds_s: Mapping[str, float] | None = None,
    ) -> FrameSetObservations:
        """The effective ones of `views`."""
        seen = tuple([v.detection for v in views if v.effective and v.detection is not None])
        times_s = tuple(dict.fromkeys([d.time_s for d in seen]))
        stacked = PoseObservations.of(seen, body, cameras, time_s) if seen else None
        return cls(seen, time_s, times_s, stacked, time_sds_s or {})

    def at_instant(self, motion: Motion) -> list[Detection]:
        """The detections with their centres moved to the common instant by the predicted motion.

        Outline points are not moved. To first order errors of the predicted *pose* cancel in the
        displacement; only those of its velocity count.
        """
        s = self.rows
        if s is None or self.times_s == (self.time_s,):
            return list(self.detections)
        then = self._pixels(motion.world_from_body, motion.moved(s.lead_s + self.time_s))
        there = np.repeat(motion.moved(self.time_s)[None], len(s), axis=0)
        centers = s.pixels + (self._pixels(motion.world_from_body, there) - then)
        return [
            d if d.time_s == self.time_s else d.moved(center, self.time_s)
            for d, center in zip(self.detections, centers, strict=True)
        ]

    def residuals_px(self, pose: Pose, prior: Motion | None) -> dict[tuple[str, str], Floats]:
        """Detected less predicted centre (2,) px, by (ball, camera); at rest without a `prior`."""
        s = self.rows
        if s is None:
            return {}
        moved = np.zeros((len(s), 6))
        if prior is not None and self.times_s != (pose.time_s,):
            moved[:] = prior.moved(s.lead_s + (self.time_s - pose.time_s + prior.time_s))
        off = s.pixels - self._pixels(pose.world_from_body, moved)
        return {(d.ball, d.camera): row for d, row in zip(self.detections, off, strict=True)}

    def motion_covariance(self, pose: Pose, motion: Motion) -> Floats | None:
        """Covariance (6, 6) that uncertain velocity and acceleration add to a pose.

        An error of the motion displaces images of different times differently, and the pose goes
        to their weighted mean. None if it adds nothing.
        """
        s = self.rows
        if motion.velocity_covariance is None or self.simultaneous or s is None:
            return None
        square = motion.acceleration_square
        return motion_covariance(
            s.rig.rows,
            s.points_body,
            s.noise,
            s.lead_s,
            np.ascontiguousarray(pose.world_from_body.rotation),
            np.ascontiguousarray(pose.world_from_body.translation),
            np.ascontiguousarray(motion.velocity),
            np.ascontiguousarray(motion.velocity_covariance),
            np.zeros((6, 6)) if square is None else np.ascontiguousarray(square),
            _SYSTEMATIC_PX,
        )

    def stamp_covariance(self, pose: Pose, motion: Motion) -> Floats | None:
        """Covariance (6, 6) that errors of the stamps add to a pose; None if none are known.

        A late stamp displaces all balls of one image along their paths, and the pose by what that
        image weighs in its least squares.
        """
        s = self.rows
        if s is None or not any(self.time_sds_s.values()):
            return None
        arms = pose.world_from_body.rotate(s.points_body)
        _, by_point = s.rig.project(arms + pose.world_from_body.translation)
        by_pose = np.nan_to_num(np.concatenate([by_point, by_point @ -skew(arms)], axis=2))
        weight = np.linalg.inv(s.noise + _SYSTEMATIC_PX**2 * np.eye(2))
        square = np.einsum("nia,nij,njb->nab", by_pose, weight, by_pose)
        by_late = np.linalg.pinv(square.sum(axis=0), hermitian=True) @ square @ motion.velocity
        names, out = np.array(s.rig.names), np.zeros((6, 6))
        for name, sd_s in self.time_sds_s.items():
            displacement = by_late[names == name].sum(axis=0)
            out += sd_s**2 * np.outer(displacement, displacement)
        return out

    def _pixels(self, world_from_body: RigidTransform, moved: Floats) -> Floats:
        """Pixels (n, 2) of the balls if the body has moved by (n, 6) in each image."""
        assert self.rows is not None
        s = self.rows
        return moved_pixels(
            s.rig.rows,
            s.points_body,
            np.ascontiguousarray(world_from_body.rotation),
            np.ascontiguousarray(world_from_body.translation),
            moved,
        )


def warm_up(body: Body, camera: Camera) -> None:
    """Compile the loops, or load them, by moving balls out of view to one instant."""
    seen = [
        Detection(ball.name, camera.name, float(i), np.zeros(2), 1.0, np.eye(2))
        for i, ball in enumerate(body.balls)
    ]
    views = [BallView(d.ball, d.camera, State.EFFECTIVE, detection=d) for d in seen]
    pose = Pose(0.0, RigidTransform.identity(), np.eye(6), 0.0, 0.0, (), ())
    moving = Motion(pose.world_from_body, 0.0, np.zeros(6), velocity_covariance=np.eye(6))
    all_seen = FrameSetObservations.of(views, 0.0, body, {camera.name: camera})
    all_seen.at_instant(moving)
    all_seen.residuals_px(pose, moving)
    all_seen.motion_covariance(pose, moving)


_SINGULAR = 1e-9
"""Inverse condition number below which scaled normal equations are taken for singular."""


@compiled
def moved_pixels(
    rig: RigRows, points_body: Floats, rotation: Floats, translation: Floats, moved: Floats
) -> Floats:
    """Pixels (n, 2) of n points of a body; NaN for points without an image.

    Args:
        rig: the n cameras.
        points_body: (n, 3).
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        moved: (n, 6) displacement of the body from there in each image, mm and rad.
    """
    out, by_point, place = np.empty((len(rig.lenses), 2)), np.empty((2, 3)), np.empty(3)
    for i in range(len(rig.lenses)):
        arm = apply_matrix(rotation, points_body[i])
        x, y, z = turned(moved[i, 3], moved[i, 4], moved[i, 5], arm)
        place[0] = x + translation[0] + moved[i, 0]
        place[1] = y + translation[1] + moved[i, 1]
        place[2] = z + translation[2] + moved[i, 2]
        project_one(rig, i, place, out[i], by_point)
    return out


@compiled
def motion_covariance(
    rig: RigRows,
    points_body: Floats,
    noise: Floats,
    lead_s: Floats,
    rotation: Floats,
    translation: Floats,
    velocity: Floats,
    velocity_covariance: Floats,
    acceleration_square: Floats,
    systematic_px: float,
) -> Floats:
    """Covariance (6, 6) of a pose fitted to n points: see `FrameSetObservations.motion_covariance`.

    Points without an image are left out.

    Args:
        rig: the n cameras.
        points_body: (n, 3).
        noise: (n, 2, 2) covariances of the pixels.
        lead_s: (n,) times of the images after the pose's.
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        velocity: (6,) mm/s and rad/s in the world.
        velocity_covariance: (6, 6) of that.
        acceleration_square: (6, 6) mean square of the acceleration, mm/s^2 and rad/s^2.
        systematic_px: added to the pixels' standard deviations in quadrature.
    """
    normal, moved = np.zeros((6, 6)), np.zeros((6, 12))
    pixel, by_point, slopes = np.empty(2), np.empty((2, 3)), np.empty((2, 6))
    variance = systematic_px**2 * np.eye(2)
    for i in range(len(rig.lenses)):
        arm, lead = apply_matrix(rotation, points_body[i]), lead_s[i]
        velocity_arm = np.cross(velocity[3:], arm)
        place = arm + translation + lead * (velocity[:3] + velocity_arm)
        project_one(rig, i, place, pixel, by_point)
        if np.isnan(pixel[0]):
            continue
        slopes[:, :3] = by_point
        for u in range(2):
            slopes[u, 3:] = np.cross(arm, by_point[u])
        weight = inverse_2x2(noise[i] + variance)
        for a in range(6):
            right = weight[0, 0] * slopes[0, a] + weight[1, 0] * slopes[1, a]
            down = weight[0, 1] * slopes[0, a] + weight[1, 1] * slopes[1, a]
            for b in range(6):
                share = right * slopes[0, b] + down * slopes[1, b]
                normal[a, b] += share
                moved[a, b] += lead * share
                moved[a, 6 + b] += lead * lead / 2 * share
    by_motion = least_norm_solution(normal, moved)
    by_velocity, by_acceleration = by_motion[:, :6].copy(), by_motion[:, 6:].copy()
    return (
        by_velocity @ velocity_covariance @ by_velocity.T
        + by_acceleration @ acceleration_square @ by_acceleration.T
    )


@compiled
def least_norm_solution(normal: Floats, moved: Floats) -> Floats:
    """The least-squares solution (6, 12) of normal equations (6, 6), of least norm if singular.

    One ball alone leaves rotations undetermined: they are the prediction's, whatever the velocity.
    """
    inverse = np.empty((6, 6))
    if invert_scaled(normal.copy(), inverse) < 1 / _SINGULAR:
        return inverse @ moved
    return np.linalg.lstsq(normal, moved, _SINGULAR)[0].astype(np.float64)
