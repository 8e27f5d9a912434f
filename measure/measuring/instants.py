"""Bringing what was seen at different times to one instant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring.pose_fit import Sightings
from measure.model import BallView, Body, Camera, Detection, Motion, Pose
from measure.model.camera import MIN_DEPTH_MM
from measure.model.observations import State
from measure.records import record

_COMMON_PX = 0.3
"""What a detection is off by besides its noise: it makes all of them count about alike."""


@record
class Seen:
    """The n believed detections of one frame set, also as arrays, stacked once.

    Attributes:
        detections: n of them.
        time_s: the instant they are brought to.
        instants: their own times, each once.
        sightings: the same as arrays; None if there are none.
    """

    detections: tuple[Detection, ...]
    time_s: float
    instants: tuple[float, ...]
    sightings: Sightings | None

    @property
    def at_once(self) -> bool:
        """Whether they are of one instant: whatever the motion, they need not be moved."""
        return len(self.instants) < 2

    @classmethod
    def of(
        cls,
        views: Sequence[BallView],
        time_s: float,
        body: Body,
        cameras: Mapping[str, Camera],
    ) -> Seen:
        """What of `views` is effective."""
        seen = tuple([v.detection for v in views if v.effective and v.detection is not None])
        instants = tuple(dict.fromkeys([d.time_s for d in seen]))
        stacked = Sightings.of(seen, body, cameras, time_s) if seen else None
        return cls(seen, time_s, instants, stacked)

    def carried(self, motion: Motion) -> list[Detection]:
        """The detections as they would have been at the instant, by the body's predicted motion.

        Only the centres are moved; outline points stay as they were seen. To first order the error
        of the prediction's *position* cancels, only that of its velocity counts.
        """
        s = self.sightings
        if s is None or self.instants == (self.time_s,):
            return list(self.detections)
        then = self._pixels(motion.world_from_body, motion.moved(s.lead_s + self.time_s))
        there = np.repeat(motion.moved(self.time_s)[None], len(s), axis=0)
        centers = s.pixels + (self._pixels(motion.world_from_body, there) - then)
        return [
            d if d.time_s == self.time_s else d.moved(center, self.time_s)
            for d, center in zip(self.detections, centers, strict=True)
        ]

    def residuals_px(self, pose: Pose, prior: Motion | None) -> dict[tuple[str, str], Floats]:
        """Detected minus predicted sphere centre (2,) in px of everything seen, by (ball, camera).

        Args:
            pose: the measured one.
            prior: how the body moves; at rest without.
        """
        s = self.sightings
        if s is None:
            return {}
        moved = np.zeros((len(s), 6))
        if prior is not None and self.instants != (pose.time_s,):
            moved[:] = prior.moved(s.lead_s + (self.time_s - pose.time_s + prior.time_s))
        off = s.pixels - self._pixels(pose.world_from_body, moved)
        return {(d.ball, d.camera): row for d, row in zip(self.detections, off, strict=True)}

    def velocity_share(self, pose: Pose, motion: Motion) -> Floats | None:
        """What an uncertain velocity, and none that changes, add to a pose's covariance (6, 6).

        A motion that is wrong carries the pictures of different times to different places, and the
        pose to their weighted mean. None if it adds nothing.
        """
        from measure.measuring.instant_kernels import velocity_share

        s = self.sightings
        if motion.velocity_covariance is None or self.at_once or s is None:
            return None
        bend = motion.acceleration_square
        return velocity_share(
            s.rig.lenses,
            s.rig.reach,
            s.rig.rotation,
            s.rig.centers,
            s.points_body,
            s.noise,
            s.lead_s,
            np.ascontiguousarray(pose.world_from_body.rotation),
            np.ascontiguousarray(pose.world_from_body.translation),
            np.ascontiguousarray(motion.velocity),
            np.ascontiguousarray(motion.velocity_covariance),
            np.zeros((6, 6)) if bend is None else np.ascontiguousarray(bend),
            _COMMON_PX,
            MIN_DEPTH_MM,
        )

    def _pixels(self, world_from_body: RigidTransform, moved: Floats) -> Floats:
        """Where (n, 2) the balls appear if the body has moved by (n, 6) in each picture."""
        from measure.measuring.instant_kernels import carried_pixels

        assert self.sightings is not None
        s = self.sightings
        return carried_pixels(
            s.rig.lenses,
            s.rig.reach,
            s.rig.rotation,
            s.rig.centers,
            s.points_body,
            np.ascontiguousarray(world_from_body.rotation),
            np.ascontiguousarray(world_from_body.translation),
            moved,
            MIN_DEPTH_MM,
        )


def warm_up(body: Body, camera: Camera) -> None:
    """Compile the loops, or load them, by carrying balls that nobody sees to one instant."""
    seen = [
        Detection(ball.name, camera.name, float(i), np.zeros(2), 1.0, np.eye(2))
        for i, ball in enumerate(body.balls)
    ]
    views = [BallView(d.ball, d.camera, State.EFFECTIVE, detection=d) for d in seen]
    pose = Pose(0.0, RigidTransform.identity(), np.eye(6), 0.0, 0.0, (), ())
    moving = Motion(pose.world_from_body, 0.0, np.zeros(6), velocity_covariance=np.eye(6))
    all_seen = Seen.of(views, 0.0, body, {camera.name: camera})
    all_seen.carried(moving)
    all_seen.residuals_px(pose, moving)
    all_seen.velocity_share(pose, moving)
