"""Where cameras stand to each other, by the body that they see at once; nothing is known before.

The cameras are placed one after the other, each where most sightings agree (random sample
consensus, Fischler and Bolles 1981). What is drawn are three sightings of one camera together with
places that the balls have at these instants by the cameras placed before; while only one camera is
placed, each instant has several such places, the mirrored ones among them, and the best of them
counts. The first pair is the one that agrees most, and every further camera is the one that agrees
most with all before: two cameras that never see the body at once are linked through others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count, permutations

import cv2
import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.by_body.single_view import REACH, View, body_poses, resections
from measure.calibration.refining.recording import refuse_rest
from measure.errors import CalibrationError, DegenerateGeometryError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.limits import FEWEST
from measure.model import Body, Camera, Detection, Intrinsics
from measure.processes import Progress, quiet

_TRIALS = 100  # Draws of each kind
_MORE_TRIALS = 300
"""Draws for a camera that never sees three balls at once: of two places a ball may have at each
instant, and now and then a wrong sighting, 1 draw in 8 to 27 is good."""
_POLISHED = 3  # Rounds of fitting a camera to all that agrees
_RIVAL = 0.75  # By how many sightings a place may be less agreed on than the best of an instant
_EXTRA_PX = 2.0  # Error of single sightings beyond what is stated: half-hidden balls


@dataclass(frozen=True, eq=False)
class Instant:
    """What may be balls at one time, by camera."""

    time_s: float
    detections: Mapping[str, Sequence[Detection]]


@dataclass(frozen=True, eq=False)
class LinkedInstant:
    """The body at one time, and the sightings that agree on it."""

    time_s: float
    world_from_body: RigidTransform
    seen: tuple[Detection, ...]


@dataclass(frozen=True, eq=False)
class LinkedRig:
    """Cameras with their first poses, in the frame of the first of them."""

    cameras: tuple[Camera, ...]
    instants: tuple[LinkedInstant, ...]  # those at which two cameras agree at least

    @property
    def sightings(self) -> int:
        """How many sightings agree."""
        return sum(len(instant.seen) for instant in self.instants)


@dataclass(frozen=True, eq=False)
class _Seen:
    """An instant with bearings."""

    time_s: float
    views: Mapping[str, View]


def link(
    lenses: Mapping[str, Intrinsics],
    body: Body,
    seen: Sequence[Instant],
    progress: Progress = quiet,
) -> LinkedRig:
    """Place all cameras; CalibrationError: one sees too little, or too little with the others."""
    cameras = len(lenses)
    tries = cameras * (cameras - 1) + (cameras - 1) * (cameras - 2) // 2
    tried = count(1)

    def placed(name: str, places: Sequence[Floats]) -> tuple[RigidTransform, float]:
        found = _placed(name, places, body, instants)
        progress(next(tried), tries)
        return found

    instants = [
        _Seen(one.time_s, {n: View.of(d, body, lenses[n]) for n, d in one.detections.items()})
        for one in seen
    ]
    poses = {name: [_poses(one, name, body) for one in instants] for name in lenses}
    _check_seen(lenses, body, instants, poses)
    group = _first_pair(lenses, body, instants, poses, placed)
    refuse_rest(
        RigidTransform.stack([some[0] for some in group.bodies if len(some) == 1]),
        least_motion_mm(body),
    )
    while waiting := [name for name in lenses if name not in group.placed]:
        places = group.places()
        found = {name: placed(name, places) for name in waiting}
        name = max(found, key=lambda one: found[one][1])
        if found[name][1] < FEWEST:
            raise CalibrationError(_unlinked(name, [*group.placed], found[name][1]))
        group = group.with_camera(name, found[name][0])
    return group.rig()


def least_motion_mm(body: Body) -> float:
    """The least motion by which cameras are placed: starts cannot tell less of it from none."""
    return REACH * float(body.radii.mean())


def _poses(instant: _Seen, name: str, body: Body) -> list[RigidTransform]:
    return body_poses(instant.views[name], body) if name in instant.views else []


@dataclass(frozen=True, eq=False)
class _Group:
    """Cameras placed so far; the frame is that of the first one placed."""

    lenses: Mapping[str, Intrinsics]
    body: Body
    instants: Sequence[_Seen]
    poses: Mapping[str, list[list[RigidTransform]]]  # camera_from_body, by camera and instant
    placed: Mapping[str, RigidTransform]  # group_from_camera
    # by instant, group_from_body: one where cameras agree, the rivals where they leave some.
    bodies: Sequence[Sequence[RigidTransform]]

    def places(self) -> list[Floats]:
        """By instant, where the balls may be (m, k, 3) in the group's frame."""
        return [
            np.array([pose.apply(self.body.centers) for pose in rivals]).reshape(
                len(rivals), len(self.body.balls), 3
            )
            for rivals in self.bodies
        ]

    def with_camera(self, name: str, camera_from_group: RigidTransform) -> _Group:
        placed = {**self.placed, name: camera_from_group.inverse()}
        group = replace(self, placed=placed)
        return replace(group, bodies=[group.body_at(k) for k in range(len(self.instants))])

    def body_at(self, number: int) -> list[RigidTransform]:
        """Where the body is at an instant by all cameras placed; rivals where they leave some."""
        rivals = list(self.bodies[number])
        for name, pose in self.placed.items():
            rivals += [pose @ own for own in self.poses[name][number]]
        if not rivals:
            return []
        agreed = np.array([self._agreement(number, rival) for rival in rivals])
        best = int(np.argmax(agreed))
        seen = self._seen(number, rivals[best])
        if len({d.camera for d in seen}) > 1:
            return [self._fitted(number, rivals[best], seen)]
        return [r for r, a in zip(rivals, agreed, strict=True) if a >= agreed[best] - _RIVAL]

    def _agreement(self, number: int, pose: RigidTransform) -> float:
        places, views = pose.apply(self.body.centers), self.instants[number].views
        return sum(
            float(views[name].agreement(at.inverse().apply(places), self.body.radii).sum())
            for name, at in self.placed.items()
            if name in views
        )

    def _seen(self, number: int, pose: RigidTransform) -> list[Detection]:
        """The sightings that agree with a pose of the body."""
        places, views = pose.apply(self.body.centers), self.instants[number].views
        return [
            detection
            for name, at in self.placed.items()
            if name in views
            for detection in views[name].agreeing(at.inverse().apply(places), self.body.radii)
        ]

    def _fitted(
        self, number: int, pose: RigidTransform, seen: Sequence[Detection]
    ) -> RigidTransform:
        cameras = {n: Camera(n, self.lenses[n], at) for n, at in self.placed.items()}
        rows = PoseObservations.of(
            seen, self.body, cameras, self.instants[number].time_s, _EXTRA_PX
        )
        try:
            fitted = fit_pose(pose, rows).world_from_body
        except DegenerateGeometryError:
            return pose
        better = self._agreement(number, fitted) >= self._agreement(number, pose)
        return fitted if better else pose

    def rig(self) -> LinkedRig:
        """The cameras in the frame of the session's first, and what two of them see at least."""
        world = self.placed[next(iter(self.lenses))].inverse()
        cameras = tuple(Camera(n, lens, world @ self.placed[n]) for n, lens in self.lenses.items())
        linked = []
        for number, (instant, rivals) in enumerate(zip(self.instants, self.bodies, strict=True)):
            seen = self._seen(number, rivals[0]) if len(rivals) == 1 else []
            if len({d.camera for d in seen}) > 1 and len({d.ball for d in seen}) > 2:
                pose = world @ rivals[0]
                linked.append(LinkedInstant(instant.time_s, pose, tuple(seen)))
        return LinkedRig(cameras, tuple(linked))


def _first_pair(
    lenses: Mapping[str, Intrinsics],
    body: Body,
    instants: Sequence[_Seen],
    poses: Mapping[str, list[list[RigidTransform]]],
    placed: Callable[[str, Sequence[Floats]], tuple[RigidTransform, float]],
) -> _Group:
    """The two cameras that agree on most sightings, the first of them as the group's frame."""
    tried = []
    for one, other in permutations(lenses, 2):
        alone = _Group(lenses, body, instants, poses, {one: RigidTransform.identity()}, poses[one])
        tried.append((alone, other, *placed(other, alone.places())))
    alone, other, pose, agreed = max(tried, key=lambda one: one[3])
    if agreed < FEWEST:
        raise CalibrationError(
            f"no two cameras agree on where the body is: {agreed:.0f} of the sightings at most, "
            f"and {FEWEST} are needed; is the body file that of the body in the pictures, do two "
            "cameras see it at once, and are their clocks one?"
        )
    return alone.with_camera(other, pose)


def _placed(
    name: str, places: Sequence[Floats], body: Body, instants: Sequence[_Seen]
) -> tuple[RigidTransform, float]:
    """The camera pose camera_from_group on which most sightings agree, and how many do."""
    shared = [
        (some, one.views[name])
        for some, one in zip(places, instants, strict=True)
        if len(some) and name in one.views and len(one.views[name].detections)
    ]
    best, most = RigidTransform.identity(), 0.0
    if not shared:
        return best, most
    guesses = _drawn(shared, np.random.default_rng(len(shared)))
    if not guesses:
        return best, most
    agreed = _agreements(RigidTransform.stack(guesses), shared, body).sum(axis=1)
    best, most = guesses[int(np.argmax(agreed))], float(agreed.max())
    for _ in range(_POLISHED):
        better = _polished(best, shared, body)
        if better is None:
            break
        now = float(_agreements(RigidTransform.stack([better]), shared, body).sum())
        if now <= most:
            break
        best, most = better, now
    return best, most


_Shared = Sequence[tuple[Floats, View]]
"""Of instants, where the balls may be (m, k, 3), and what the camera sees."""


def _drawn(shared: _Shared, random: np.random.Generator) -> list[RigidTransform]:
    """Poses camera_from_group by three sightings at one instant each, and at three instants."""
    out = []
    whole = [(p, v) for p, v in shared if len(np.unique(v.balls)) > 2]
    for trial in range(2 * _TRIALS if whole else _MORE_TRIALS):
        if trial % 2 and whole:
            places, view = whole[random.integers(len(whole))]
            rivals = places[random.integers(len(places))]
            balls = random.permutation(np.unique(view.balls))[:3]
            rows = [random.choice(np.flatnonzero(view.balls == ball)) for ball in balls]
            out += resections(rivals[balls], view.axes[rows])
        elif len(shared) > 2:
            points, axes = [], []
            for number in random.choice(len(shared), 3, replace=False):
                places, view = shared[number]
                row = random.integers(len(view.balls))
                points.append(places[random.integers(len(places)), view.balls[row]])
                axes.append(view.axes[row])
            out += resections(np.array(points), np.array(axes))
    return out


def _agreements(camera_from_group: RigidTransform, shared: _Shared, body: Body) -> Floats:
    """How many balls of each instant (h, n) poses (h,) agree on, of its rivals the best."""
    out = np.zeros((len(camera_from_group.translation), len(shared)))
    for number, (places, view) in enumerate(shared):
        there = np.einsum("hij,mkj->hmki", camera_from_group.rotation, places)
        there = there + camera_from_group.translation[:, None, None]
        out[:, number] = view.agreement(there, body.radii).sum(axis=2).max(axis=1)
    return out


def _polished(
    camera_from_group: RigidTransform, shared: _Shared, body: Body
) -> RigidTransform | None:
    """The pose fitted to all sightings that agree with it; None if they are too few."""
    points, flat = [], []
    for places, view in shared:
        there = camera_from_group.apply(places.reshape(-1, 3)).reshape(places.shape)
        agreed = view.agreement(there, body.radii)
        best = int(np.argmax(agreed.sum(axis=1)))
        for ball in np.flatnonzero(agreed[best]):
            own = np.flatnonzero(view.balls == ball)
            axis = view.axes[own[np.argmax(view.axes[own] @ there[best, ball])]]
            if axis[2] > 0:
                points.append(places[best, ball])
                flat.append(axis[:2] / axis[2])
    if len(points) < 4:
        return None
    turn, shift = cv2.solvePnPRefineLM(
        np.array(points),
        np.array(flat),
        np.eye(3),
        None,
        camera_from_group.rotvec[:, None].copy(),
        camera_from_group.translation[:, None].copy(),
    )
    return RigidTransform.from_rotvec(turn.ravel(), shift.ravel())


def _check_seen(
    lenses: Mapping[str, Intrinsics],
    body: Body,
    instants: Sequence[_Seen],
    poses: Mapping[str, list[list[RigidTransform]]],
) -> None:
    balls: Ints = np.zeros(len(body.balls), dtype=np.int64)
    for name in lenses:
        views = [one.views[name] for one in instants if name in one.views]
        for view in views:
            balls += np.bincount(np.unique(view.balls), minlength=len(balls))
        seen = sum(len(view.detections) > 0 for view in views)
        if seen < FEWEST:
            raise CalibrationError(
                f"camera {name}: sees a ball of the body in {seen} of {len(instants)} pictures, "
                f"and {FEWEST} are needed: is the body in its view, and are the body file's "
                "colours those of the balls?"
            )
    if np.sum(balls > 0) < 3:
        missing = [ball.name for ball, count in zip(body.balls, balls, strict=True) if not count]
        raise CalibrationError(
            f"no camera sees {' or '.join(missing)}: are the body file's colours those of the "
            "balls in the pictures? `measure detect` shows what is found"
        )
    if not any(some for own in poses.values() for some in own):
        raise CalibrationError(
            "in no picture three balls lie as the body file says: is it that of the body in the "
            "pictures? `measure detect` shows what is found"
        )


def _unlinked(name: str, placed: Sequence[str], agreed: float) -> str:
    return (
        f"camera {name}: {agreed:.0f} of its sightings agree with the cameras "
        f"{', '.join(placed)}, and {FEWEST} are needed: wave the body where this camera and one of "
        "these see it at once"
    )
