"""What a recording shows of its rig: ball-views at instants of known motion, and how they miss.

Each view is one ball in one picture: two coordinates of its centre and its apparent size. What is
expected of it depends on the body's pose at that instant, and on parameters of the rig that may be
off; `Evidence.linearised` gives both derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.geometry import RigidTransform, chart_jacobian
from measure.model import Body, Camera, Detection

TRACKED_PX, SEARCHED_PX = 0.3, 0.5
"""Usual error of a ball's centre, and of its radius, that its detector does not state: where it was
followed, and where whole pictures were searched."""
_AT_ONCE_S = 0.005
"""Pictures this close to an instant are brought to it by the velocity there."""
TURN, SHIFT, FOCAL, POINT, CLOCK, ROLL = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 7),
    slice(7, 9),
    slice(9, 10),
    slice(10, 11),
)
"""Of a camera's parameters: rad about its own axes, mm along them, logarithm of the focal length,
px of the principal point, s late, s of readout."""
PER_CAMERA = 11
SCALE, SPREAD, EDGE, ASIDE, SHARED = 0, 1, 2, 3, 5
"""Of what all cameras share: logarithms of the body's size and of its balls' distances, px by which
all outlines appear further out, and (two) by which colours lie beside the balls, as codecs that
halve colours place them; then each ball's logarithm of the radius, and its place."""


class Sighting(NamedTuple):
    """What was seen at one instant."""

    time_s: float
    world_from_body: RigidTransform  # near the truth
    velocity: Floats  # (6,) in the pose's `perturb` chart, per second
    detections: Sequence[Detection]  # at most one per camera and ball
    systematic_px: float | None = None  # of their error; None as the evidence says


class Linear(NamedTuple):
    """The views near one state, divided by their standard deviations."""

    residuals: Floats  # (n, 3) seen minus expected: two coordinates and the size
    by_pose: Floats  # (n, 3, 6) derivative of what is expected by the pose of its instant
    by_rig: Floats  # (n, 3, p) and by the parameters of the rig


class _Placed(NamedTuple):
    """The balls of m views of one camera when their pictures were taken."""

    points: Floats  # (m, 3) their centres in the world
    arms: Floats  # (m, 3) from the body's origin to them, in the world
    turns: Floats  # (m, 3, 3) from the body's axes to the world's
    speed: Floats  # (m, 3) mm/s
    lines: Floats  # (m,) the row they appear in, from -0.5 at the top to 0.5 at the bottom
    radii: Floats  # (m,) mm


@dataclass(frozen=True, eq=False)
class Evidence:
    """n ball-views at k instants."""

    body: Body
    cameras: Sequence[Camera]
    times_s: Floats  # (k,) increasing
    poses: RigidTransform  # (k,) near the truth
    velocities: Floats  # (k, 6)
    instants: Ints  # (n,)
    views: Ints  # (n,) index of the camera
    balls: Ints  # (n,) index of the ball
    seen: Floats  # (n, 3) two coordinates in px and the logarithm of the radius in px
    whitening: Floats  # (n, 3, 3) inverse of a square root of their covariance
    lead_s: Floats  # (n,) stamp of the picture after the instant
    systematic_px: float  # of their error, what is alike from one to the next
    # by camera (k, 2), when its stamps, and no other's, have a gap, and how much of one.
    gaps_s: Mapping[str, Floats] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        sightings: Sequence[Sighting],
        body: Body,
        cameras: Sequence[Camera],
        systematic_px: float = TRACKED_PX,
        gaps_s: Mapping[str, Floats] | None = None,
    ) -> Evidence | None:
        """Stack what was seen; None without anything."""
        index = {camera.name: i for i, camera in enumerate(cameras)}
        rows = [(k, d) for k, s in enumerate(sightings) for d in s.detections if d.camera in index]
        if not rows:
            return None
        radii = np.array([d.radius_px for _, d in rows])
        whitening = np.zeros((len(rows), 3, 3))
        alike_px = np.array([sightings[k].systematic_px or systematic_px for k, _ in rows])
        noise = np.stack([d.covariance_px for _, d in rows])
        noise = noise + alike_px[:, None, None] ** 2 * np.eye(2)
        whitening[:, :2, :2] = np.linalg.inv(np.linalg.cholesky(noise))
        size_px = np.hypot(alike_px, np.sqrt([d.variance_px2 for _, d in rows]))
        whitening[:, 2, 2] = radii / size_px
        centers = np.stack([d.center_px for _, d in rows])
        poses = [s.world_from_body for s in sightings]
        return cls(
            body,
            cameras,
            np.array([s.time_s for s in sightings]),
            RigidTransform(
                np.stack([p.rotation for p in poses]), np.stack([p.translation for p in poses])
            ),
            np.stack([s.velocity for s in sightings]),
            np.array([k for k, _ in rows]),
            np.array([index[d.camera] for _, d in rows]),
            np.array([body.index(d.ball) for _, d in rows]),
            np.column_stack([centers, np.log(radii)]),
            whitening,
            np.array([d.time_s - sightings[k].time_s for k, d in rows]),
            systematic_px,
            gaps_s or {},
        )

    def __len__(self) -> int:
        return len(self.views)

    def part(self, kept: Bools) -> Evidence:
        """Of some instants (k,) alone."""
        rows = kept[self.instants]
        own = {name: getattr(self, name)[rows] for name in _OF_VIEWS}
        own["instants"] = (np.cumsum(kept) - 1)[own["instants"]]
        return replace(
            self,
            times_s=self.times_s[kept],
            poses=_each(self.poses, np.flatnonzero(kept)),
            velocities=self.velocities[kept],
            **own,
        )

    @property
    def size(self) -> int:
        """The number of parameters of the rig."""
        return PER_CAMERA * len(self.cameras) + SHARED + 4 * len(self.body.balls)

    def gap_s(self, camera: str, instant: int) -> float:
        """By how much a camera's stamps jump before an instant, after the two before that."""
        first, last = self.times_s[max(instant - 2, 0)], self.times_s[instant]
        gaps = self.gaps_s.get(camera, np.zeros((0, 2)))
        return float(np.max(gaps[(gaps[:, 0] >= first) & (gaps[:, 0] <= last), 1], initial=0.0))

    def of_camera(self, camera: int, what: slice) -> list[int]:
        """The columns of some of a camera's parameters."""
        return list(range(PER_CAMERA * camera, PER_CAMERA * (camera + 1)))[what]

    def shared(self, what: int) -> int:
        """The column of a parameter that all cameras share."""
        return PER_CAMERA * len(self.cameras) + what

    def radius(self, ball: int) -> int:
        """The column of a ball's radius."""
        return self.shared(SHARED) + ball

    def place(self, ball: int) -> list[int]:
        """The columns of a ball's place in the body."""
        first = self.shared(SHARED) + len(self.body.balls) + 3 * ball
        return [first, first + 1, first + 2]

    def hardly_seen(self, balls: bool = False) -> list[str]:
        """Cameras, or balls, with less than half as many views as most: they are elsewhere."""
        names = self.body.names if balls else [camera.name for camera in self.cameras]
        seen = np.bincount(self.balls if balls else self.views, minlength=len(names))
        return [n for n, count in zip(names, seen, strict=True) if count < np.median(seen) / 2]

    def flow(self) -> Floats:
        """By camera (c,), how far a second moves what it sees, in standard deviations, RSS."""
        here = np.zeros((1, self.size))
        by_rig = self.linearised(self.poses, here, np.zeros(len(self), np.int64)).by_rig
        own = by_rig[np.arange(len(self)), :, PER_CAMERA * self.views + CLOCK.start]
        return np.sqrt(np.bincount(self.views, np.sum(own**2, axis=1), len(self.cameras)))

    def linearised(self, poses: RigidTransform, rigs: Floats, states: Ints) -> Linear:
        """The views about poses (k,) and parameters (m, p), those of `states` (n,) for each."""
        expected, by_pose = np.zeros((len(self), 3)), np.zeros((len(self), 3, 6))
        by_rig = np.zeros((len(self), 3, self.size))
        for index, camera in enumerate(self.cameras):
            for state, rig in enumerate(rigs):
                rows = np.flatnonzero((self.views == index) & (states == state))
                if len(rows):
                    parts = self._of_camera(index, camera, rows, poses, rig)
                    expected[rows], by_pose[rows], by_rig[rows] = parts
        residuals = np.einsum("nij,nj->ni", self.whitening, self.seen - expected)
        bad = ~np.isfinite(residuals).all(axis=1)  # no image, or behind the camera
        by_pose[bad] = by_rig[bad] = 0.0
        linear = Linear(residuals, self.whitening @ by_pose, self.whitening @ by_rig)
        for part in linear:
            part[bad] = 0.0
        return linear

    def _of_camera(
        self, index: int, stated: Camera, rows: Ints, poses: RigidTransform, rig: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """What one camera is expected to see (m, 3), and its derivatives."""
        own = rig[PER_CAMERA * index : PER_CAMERA * (index + 1)]
        camera, at = altered(stated, own), self._placed(stated, rows, poses, rig, own)
        pixels, by_world, by_pose, by_lens = camera.project_with_jacobians(at.points)
        away = at.points - camera.center
        nearer = -away / np.sum(away**2, axis=1)[:, None]  # by which the size grows with the point
        radius_px = _outline_px(by_world, at.radii, away)
        edge = self.shared(EDGE)
        size = np.log(radius_px) + rig[edge] / radius_px
        by_point = np.concatenate([by_world, nearer[:, None]], axis=1)
        out = np.zeros((len(rows), 3, self.size))
        axes, first = camera.world_from_camera.rotation, PER_CAMERA * index
        mine = out[:, :, first : first + PER_CAMERA]
        mine[:, :2, TURN] = by_pose[:, :, 3:] @ axes
        mine[:, :2, SHIFT] = by_pose[:, :, :3] @ axes
        mine[:, 2, SHIFT] = -nearer @ axes
        mine[:, :2, FOCAL] = by_lens[:, :, :2] @ np.diag(camera.intrinsics.matrix)[:2, None]
        mine[:, 2, FOCAL] = 1.0
        mine[:, :2, POINT] = by_lens[:, :, 2:4]
        mine[:, :, CLOCK] = by_point @ at.speed[:, :, None]
        mine[:, :, ROLL] = mine[:, :, CLOCK] * at.lines[:, None, None]
        out[:, :, self.shared(SPREAD)] = np.einsum("nij,nj->ni", by_point, at.arms)
        out[:, :, self.shared(SCALE)] = out[:, :, self.shared(SPREAD)]
        out[:, 2, self.shared(SCALE)] += 1.0
        out[:, 2, edge] = 1 / radius_px
        balls = self.balls[rows]
        aside = self.shared(ASIDE)
        pixels = pixels + rig[aside : aside + 2]
        out[:, :2, aside : aside + 2] = np.eye(2)
        out[np.arange(len(rows)), 2, self.radius(0) + balls] = 1.0
        for ball in range(len(self.body.balls)):
            its = balls == ball
            columns = self.place(ball)
            out[its, :, columns[0] : columns[-1] + 1] = by_point[its] @ at.turns[its]
        return np.column_stack([pixels, size]), by_point @ chart_jacobian(at.arms), out

    def _placed(
        self, camera: Camera, rows: Ints, poses: RigidTransform, rig: Floats, own: Floats
    ) -> _Placed:
        """The balls of some views when their pictures were taken."""
        instants = self.instants[rows]
        height = camera.intrinsics.size_wh[1]
        lines = (self.seen[rows, 1] - (height - 1) / 2) / height
        moved, twist = self._moved(instants, self.lead_s[rows] + own[CLOCK] + own[ROLL] * lines)
        placed = moved @ _each(poses, instants)
        centers, radii = self._arms(rig, self.balls[rows])
        arms = placed.rotate(centers)
        speed = np.einsum("nij,nj->ni", chart_jacobian(arms), twist)
        return _Placed(placed.translation + arms, arms, placed.rotation, speed, lines, radii)

    def _moved(self, instants: Ints, lead_s: Floats) -> tuple[RigidTransform, Floats]:
        """How the body has moved some time after instants (m,), and its velocity (m, 6) then.

        By the velocity at the instant that is nearest to that time.
        """
        due = self.times_s[instants] + lead_s
        middles = (self.times_s[1:] + self.times_s[:-1]) / 2
        near = np.searchsorted(middles, due)
        near = np.where(np.abs(lead_s) < _AT_ONCE_S, instants, near)
        velocity = self.velocities[near]
        then = _each(self.poses, near).perturb(velocity * (due - self.times_s[near])[:, None])
        before = _each(self.poses, instants)
        turn = then.rotation @ np.swapaxes(before.rotation, 1, 2)
        way = then.translation - np.einsum("nij,nj->ni", turn, before.translation)
        return RigidTransform(turn, way), velocity

    def _arms(self, rig: Floats, balls: Ints) -> tuple[Floats, Floats]:
        """Places (m, 3) in the body and radii (m,) of balls."""
        scale, spread = rig[self.shared(SCALE)], rig[self.shared(SPREAD)]
        count = len(self.body.balls)
        grown = rig[self.radius(0) : self.radius(0) + count]
        moved = rig[self.radius(0) + count :].reshape(count, 3)
        centers = (self.body.centers + moved) * np.exp(scale + spread)
        return centers[balls], (self.body.radii * np.exp(grown + scale))[balls]


def _each(poses: RigidTransform, index: Ints) -> RigidTransform:
    return RigidTransform(poses.rotation[index], poses.translation[index])


def _outline_px(by_world: Floats, radii: Floats, away: Floats) -> Floats:
    """Mean radii (m,) of outlines of spheres so far `away` (m, 3); NaN for those without."""
    enlarged = np.linalg.svd(np.nan_to_num(by_world), compute_uv=False)[:, :2].mean(axis=1)
    sine = np.minimum(radii / np.linalg.norm(away, axis=1), _WIDEST_SINE)
    radius_px = enlarged * radii / np.sqrt(1 - sine**2)
    return np.where(radius_px > 0, radius_px, np.nan)


_OF_VIEWS = ("instants", "views", "balls", "seen", "whitening", "lead_s")
_WIDEST_SINE = 0.9  # Of a ball's half-angle: nearer ones are nowhere


def altered(camera: Camera, change: Floats) -> Camera:
    """A camera with so much added to its parameters."""
    if not np.any(change[:9]):
        return camera
    axes = camera.world_from_camera.rotation
    step = np.concatenate([axes @ change[SHIFT], axes @ change[TURN]])
    matrix = camera.intrinsics.matrix.copy()
    matrix[:2, :2] *= np.exp(change[FOCAL])
    matrix[:2, 2] += change[POINT]
    lens = replace(camera.intrinsics, matrix=matrix)
    return replace(
        camera, intrinsics=lens, world_from_camera=camera.world_from_camera.perturb(step)
    )
