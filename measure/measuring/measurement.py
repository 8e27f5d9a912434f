"""The result of the pipeline for one frame set, and the detections that it is made of.

Detections of different times are moved to one instant by the body's predicted motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.estimation.expected_accuracy import tolerance_covariance
from measure.estimation.pose_fit import PoseObservations
from measure.geometry import RigidTransform, chart_jacobian, propagate
from measure.limits import SINGULAR
from measure.model import BallPosition, BallView, Body, Camera, Detection, Doubt, Motion, Pose

if TYPE_CHECKING:
    from measure.measuring.kept_rig import KeptRig

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


class Status(StrEnum):
    """How a frame set ended."""

    OK = "ok"
    FLAGGED = "flagged"
    LOST = "lost"
    SKIPPED = "skipped"


@dataclass(frozen=True, eq=False)
class Measurement:
    """One frame set, measured."""

    index: int  # number of the frame set in the session
    time_s: float  # the instant the positions and the pose hold for
    frames: dict[str, int]  # frame number of each camera's image, by camera name
    # the state of every ball in every camera, with its detection if there is one.
    views: tuple[BallView, ...]
    positions: tuple[BallPosition, ...]  # at most one per ball
    pose: Pose | None  # the body's pose, None unless `status` is OK or FLAGGED
    status: Status  # OK; FLAGGED (a pose with flags); LOST (no pose); SKIPPED (not tried)
    # why it is not OK, but for the flags of its pose; and notes, which leave that as it is.
    reasons: tuple[str, ...] = ()
    # by (ball, camera), detected minus predicted centre (2,) in px, for every effective view of a
    # frame set with a pose.
    residuals_px: dict[tuple[str, str], Floats] = field(default_factory=dict)
    # names of the cameras in which the whole frame was searched for some ball.
    searched: tuple[str, ...] = ()
    # cameras that show another camera's images, and are left out, with that one's name.
    copies: Mapping[str, str] = field(default_factory=dict)
    repeated: tuple[str, ...] = ()  # cameras that show their last image again
    # the cameras as they were used, where it is kept which were moved meanwhile.
    rig: KeptRig | None = None

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Why it is not OK, its pose's flags included, and notes."""
        flags = () if self.pose is None else self.pose.flags
        return tuple(map(Doubt.of, dict.fromkeys((*self.reasons, *flags))))

    @property
    def reason(self) -> str:
        """All of that in words; empty if there is nothing."""
        return "; ".join(self.doubts)

    def flagged(self, *flags: str) -> Measurement:
        """The same with more flags of its pose, if it has one."""
        if self.pose is None or not flags:
            return self
        pose = replace(self.pose, flags=(*self.pose.flags, *flags))
        return replace(self, pose=pose, status=Status.FLAGGED)

    def without_images(
        self, copies: Mapping[str, str], repeated: Sequence[str], damaged: Mapping[str, str]
    ) -> Measurement:
        """The same, saying whose images are left out and why: a pose without them is no worse."""
        same = replace(self, copies=dict(copies), repeated=tuple(repeated))
        return same.noted(
            *(Doubt("pictures-of-another", camera=n, whose=whose) for n, whose in copies.items()),
            *(Doubt("repeated-pictures", camera=name) for name in repeated),
            *(Doubt("damaged-picture", camera=n, file=str(file)) for n, file in damaged.items()),
        )

    def noted(self, *doubts: str) -> Measurement:
        """The same with more reasons, which leave its status as it is."""
        return replace(self, reasons=(*self.reasons, *doubts))

    def with_tolerance(self, body: Body) -> Measurement:
        """The same, with the body's tolerance added to the pose's covariance: no image shows it."""
        pose = self.pose
        if pose is None or not body.tolerance_mm:
            return self
        share = tolerance_covariance(body, pose.world_from_body, pose.balls)
        return replace(self, pose=replace(pose, covariance=pose.covariance + share))


@dataclass(frozen=True, eq=False, slots=True)
class Draft:
    """A measurement that may be solved again when later poses are known."""

    measurement: Measurement
    # flags of its pose that the tracker or the pipeline raised, not the solver.
    tracker_flags: tuple[str, ...]
    # the observations it rests on; None if the frame set was skipped.
    seen: FrameSetObservations | None = None

    def flagged(self, *flags: str) -> Draft:
        """The same with more flags of its pose, if it has one."""
        measured = self.measurement.flagged(*flags)
        return replace(self, measurement=measured, tracker_flags=(*self.tracker_flags, *flags))
