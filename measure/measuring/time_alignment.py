"""Bringing what was seen at different times to one instant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.estimation.pose_fit import Sightings
from measure.geometry import RigidTransform
from measure.geometry.covariance_kernels import inverse_2x2
from measure.geometry.linear_kernels import invert_scaled
from measure.geometry.rotation_kernels import times, turned
from measure.model import BallView, Body, Camera, Detection, Motion, Pose
from measure.model.observations import State
from measure.model.rig_kernels import RigRows, project_one
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
        from measure.measuring.time_alignment import velocity_share

        s = self.sightings
        if motion.velocity_covariance is None or self.at_once or s is None:
            return None
        bend = motion.acceleration_square
        return velocity_share(
            s.rig.rows,
            s.points_body,
            s.noise,
            s.lead_s,
            np.ascontiguousarray(pose.world_from_body.rotation),
            np.ascontiguousarray(pose.world_from_body.translation),
            np.ascontiguousarray(motion.velocity),
            np.ascontiguousarray(motion.velocity_covariance),
            np.zeros((6, 6)) if bend is None else np.ascontiguousarray(bend),
            _COMMON_PX,
        )

    def _pixels(self, world_from_body: RigidTransform, moved: Floats) -> Floats:
        """Where (n, 2) the balls appear if the body has moved by (n, 6) in each picture."""
        from measure.measuring.time_alignment import carried_pixels

        assert self.sightings is not None
        s = self.sightings
        return carried_pixels(
            s.rig.rows,
            s.points_body,
            np.ascontiguousarray(world_from_body.rotation),
            np.ascontiguousarray(world_from_body.translation),
            moved,
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


_SINGULAR = 1e-9
"""Of equations, relative to the best determined unknown."""


@compiled
def carried_pixels(
    rig: RigRows,
    points_body: Floats,
    rotation: Floats,
    translation: Floats,
    moved: Floats,
) -> Floats:
    """Pixels (n, 2) of n points of a body; NaN for points without an image.

    Args:
        rig: the n cameras.
        points_body: (n, 3).
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        moved: (n, 6) how far the body has moved from there in each picture, mm and rad.
    """
    out, by_point, place = np.empty((len(rig.lenses), 2)), np.empty((2, 3)), np.empty(3)
    for i in range(len(rig.lenses)):
        arm = times(rotation, points_body[i])
        x, y, z = turned(moved[i, 3], moved[i, 4], moved[i, 5], arm)
        place[0] = x + translation[0] + moved[i, 0]
        place[1] = y + translation[1] + moved[i, 1]
        place[2] = z + translation[2] + moved[i, 2]
        project_one(rig, i, place, out[i], by_point)
    return out


@compiled
def velocity_share(
    rig: RigRows,
    points_body: Floats,
    noise: Floats,
    lead_s: Floats,
    rotation: Floats,
    translation: Floats,
    velocity: Floats,
    velocity_covariance: Floats,
    acceleration_square: Floats,
    common_px: float,
) -> Floats:
    """Covariance (6, 6) of a pose fitted to n points: see `Seen.velocity_share`.

    Points without an image say nothing.

    Args:
        rig: the n cameras.
        points_body: (n, 3).
        noise: (n, 2, 2) covariances of the pixels.
        lead_s: (n,) times of the pictures after the pose's.
        rotation: (3, 3) of world_from_body.
        translation: (3,) the same.
        velocity: (6,) mm/s and rad/s in the world.
        velocity_covariance: (6, 6) of that.
        acceleration_square: (6, 6) mean square of what changes it, mm/s^2 and rad/s^2.
        common_px: added to the pixels' standard deviations in quadrature.
    """
    normal, moved = np.zeros((6, 6)), np.zeros((6, 12))
    pixel, by_point, slopes = np.empty(2), np.empty((2, 3)), np.empty((2, 6))
    variance = common_px**2 * np.eye(2)
    for i in range(len(rig.lenses)):
        arm, lead = times(rotation, points_body[i]), lead_s[i]
        swung = np.cross(velocity[3:], arm)
        place = arm + translation + lead * (velocity[:3] + swung)
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
    lever = levers(normal, moved)
    swing, bend = lever[:, :6].copy(), lever[:, 6:].copy()
    return swing @ velocity_covariance @ swing.T + bend @ acceleration_square @ bend.T


@compiled
def levers(normal: Floats, moved: Floats) -> Floats:
    """What normal equations (6, 6) make of their right sides (6, 12); the least that they may.

    One ball alone leaves a turn open: its pose is the prediction's, whatever the velocity.
    """
    inverse = np.empty((6, 6))
    if invert_scaled(normal.copy(), inverse) < 1 / _SINGULAR:
        return inverse @ moved
    return np.linalg.lstsq(normal, moved, _SINGULAR)[0].astype(np.float64)
