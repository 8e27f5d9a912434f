"""Moving detections of different times to one instant by the body's predicted motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Floats
from measure.estimation.pose_fit import PoseObservations
from measure.geometry import RigidTransform, chart_jacobian, propagate
from measure.limits import SINGULAR
from measure.model import BallView, Body, Camera, Detection, Motion, Pose

_SYSTEMATIC_PX = 0.3
"""Systematic error of a detection, added to its noise: it limits differences of their weights."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameSetObservations:
    """The n effective detections of one frame set, also as arrays."""

    detections: tuple[Detection, ...]  # n of them
    time_s: float  # the common instant
    times_s: tuple[float, ...]  # their own times, each once
    rows: PoseObservations | None  # the same as arrays; None if there are none
    cameras: Mapping[str, Camera]  # all of them, by name, as they stand at that instant
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
        return cls(seen, time_s, times_s, stacked, cameras, time_sds_s or {})

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
            d if d.time_s == self.time_s else replace(d, center_px=center, time_s=self.time_s)
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
        square, inverse = self._information(pose)
        by_velocity = inverse @ np.tensordot(s.lead_s, square, 1)
        out = propagate(by_velocity, motion.velocity_covariance)
        if motion.acceleration_square is not None:
            by_acceleration = inverse @ np.tensordot(s.lead_s**2 / 2, square, 1)
            out = out + propagate(by_acceleration, motion.acceleration_square)
        return out

    def stamp_covariance(self, pose: Pose, motion: Motion) -> Floats | None:
        """Covariance (6, 6) that errors of the stamps add to a pose; None if none are known.

        A late stamp displaces all balls of one image along their paths, and the pose by what that
        image weighs in its least squares.
        """
        s = self.rows
        if s is None or not any(self.time_sds_s.values()):
            return None
        square, inverse = self._information(pose)
        by_late = inverse @ square @ motion.velocity
        names, out = np.array(s.rig.names), np.zeros((6, 6))
        for name, sd_s in self.time_sds_s.items():
            displacement = by_late[names == name].sum(axis=0)
            out += sd_s**2 * np.outer(displacement, displacement)
        return out

    def _information(self, pose: Pose) -> tuple[Floats, Floats]:
        """What each observation tells of a pose (n, 6, 6), and the inverse (6, 6) of the sum.

        The pseudo-inverse: one ball alone leaves rotations undetermined, which are then the
        prediction's, whatever its velocity.
        """
        assert self.rows is not None
        s, arms = self.rows, pose.world_from_body.rotate(self.rows.points_body)
        _, by_point = s.rig.project(arms + pose.world_from_body.translation)
        by_pose = np.nan_to_num(by_point @ chart_jacobian(arms))
        weight = np.linalg.inv(s.noise + _SYSTEMATIC_PX**2 * np.eye(2))
        square = np.swapaxes(by_pose, 1, 2) @ weight @ by_pose
        return square, np.linalg.pinv(square.sum(axis=0), rcond=SINGULAR, hermitian=True)

    def _pixels(self, world_from_body: RigidTransform, moved: Floats) -> Floats:
        """Pixels (n, 2) of the balls if the body has moved by (n, 6) in each image."""
        assert self.rows is not None
        arms, way = world_from_body.rotate(self.rows.points_body), world_from_body.translation
        turned = RigidTransform.from_rotvec(moved[:, 3:], moved[:, :3]).apply(arms)
        return self.rows.rig.project(turned + way)[0]
