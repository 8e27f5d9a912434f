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
from measure.estimation.rig_model import Placed, linearise_view
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
        return cls(
            body,
            cameras,
            np.array([s.time_s for s in sightings]),
            RigidTransform.stack([s.world_from_body for s in sightings]),
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
            poses=self.poses[np.flatnonzero(kept)],
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
        own, first = rig[PER_CAMERA * index : PER_CAMERA * (index + 1)], PER_CAMERA * index
        balls, every, height = self.balls[rows], np.arange(len(rows)), stated.intrinsics.size_wh[1]
        # The row they appear in, from -0.5 at the top to 0.5 at the bottom.
        lines = (self.seen[rows, 1] - (height - 1) / 2) / height
        late_s = self.lead_s[rows] + own[CLOCK] + own[ROLL] * lines
        centers, radii = self._balls(rig, balls)
        at = self._placed(self.instants[rows], late_s, poses, centers)
        camera = altered(stated, own)
        seen = linearise_view(camera, at, radii)
        out = np.zeros((len(rows), 3, self.size))
        mine = out[:, :, first : first + PER_CAMERA]
        mine[:, :, : CLOCK.start] = seen.by_camera @ _by_own_axes(camera)
        mine[:, :, CLOCK] = seen.by_time
        mine[:, :, ROLL] = seen.by_time * lines[:, None, None]
        scale, spread, edge, aside = map(self.shared, (SCALE, SPREAD, EDGE, ASIDE))
        out[:, :, spread] = out[:, :, scale] = np.einsum("nij,nj->ni", seen.by_point, centers)
        out[:, 2, scale] += 1.0
        out[:, 2, edge] = np.exp(-seen.expected[:, 2])
        out[:, :2, aside : aside + 2] = np.eye(2)
        out[every, 2, self.radius(0) + balls] = 1.0
        places = np.array(self.place(0)) + 3 * balls[:, None]
        out[every[:, None], :, places] = np.swapaxes(seen.by_point, 1, 2)
        common = [edge, aside, aside + 1]
        return seen.expected + out[:, :, common] @ rig[common], seen.by_pose, out

    def _placed(
        self, instants: Ints, late_s: Floats, poses: RigidTransform, centers: Floats
    ) -> Placed:
        """Places (n, 3) in the body so much later than instants (n,), by the velocity there.

        That is the velocity at the instant that is nearest to that time.
        """
        due = self.times_s[instants] + late_s
        middles = (self.times_s[1:] + self.times_s[:-1]) / 2
        near = np.where(np.abs(late_s) < _AT_ONCE_S, instants, np.searchsorted(middles, due))
        velocity = self.velocities[near]
        then = self.poses[near].perturb(velocity * (due - self.times_s[near])[:, None])
        placed = then @ self.poses[instants].inverse() @ poses[instants]
        arms = placed.rotate(centers)
        speed = np.einsum("nij,nj->ni", chart_jacobian(arms), velocity)
        return Placed(placed.translation + arms, arms, placed.rotation, speed)

    def _balls(self, rig: Floats, balls: Ints) -> tuple[Floats, Floats]:
        """Places (m, 3) in the body and radii (m,) of balls."""
        scale, spread = rig[self.shared(SCALE)], rig[self.shared(SPREAD)]
        count = len(self.body.balls)
        grown = rig[self.radius(0) : self.radius(0) + count]
        moved = rig[self.radius(0) + count :].reshape(count, 3)
        centers = (self.body.centers + moved) * np.exp(scale + spread)
        return centers[balls], (self.body.radii * np.exp(grown + scale))[balls]


_OF_VIEWS = ("instants", "views", "balls", "seen", "whitening", "lead_s")


def altered(camera: Camera, change: Floats) -> Camera:
    """A camera with so much added to its parameters."""
    if not np.any(change[: CLOCK.start]):
        return camera
    own = change[: CLOCK.start].copy()
    own[FOCAL] = np.expm1(own[FOCAL])
    return camera.perturb(_by_own_axes(camera) @ own)


def _by_own_axes(camera: Camera) -> Floats:
    """How its pose and intrinsics (18,), see `Camera.perturb`, follow its parameters (9,)."""
    out = np.zeros((18, CLOCK.start))
    out[3:6, TURN] = out[:3, SHIFT] = camera.world_from_camera.rotation
    out[6:8, FOCAL] = np.diag(camera.intrinsics.matrix)[:2, None]
    out[8:10, POINT] = np.eye(2)
    return out
