"""Cameras that are moved while a body is measured: noticed, left out, and brought back.

A camera that sees no ball where the others do is looked at as a whole. If it shows the balls as it
would from another place, it was moved, and is left out. Once one pose of it explains what it has
shown for a while, it stands still: that pose is refined on those pictures with all other cameras
held (`refine_rig`), gets the covariance of that, and the camera counts again. A camera that drifts
is not left out (`DriftWatch`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.calibration.drifting import DriftWatch
from measure.calibration.refining.freeing import FreedRig, loosened
from measure.calibration.refining.procedure import SUSPICIOUS_PX, UNTRIED_VARIANCE_FACTOR
from measure.calibration.refining.recording import recording_of
from measure.calibration.refining.refine import refine_rig
from measure.errors import CalibrationError, DegenerateGeometryError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform, chi_square_quantile, squared_mahalanobis
from measure.limits import CLEAR_RATIO
from measure.measuring import Measurement
from measure.measuring.kept_rig import HOLDING, CameraChange, KeptRig
from measure.measuring.tracking.motion_filter import MotionState
from measure.measuring.tracking.search_windows import predict_windows
from measure.model import BallView, Body, Camera, Detection, Expectation, FrameSet, Motion, Rig
from measure.model.doubts import Doubt
from measure.model.observations import Reason, State

_BLIND_SETS = 5  # Frame sets without a ball where it should be, from which a camera is looked at
_FEW_LOOKS, _FEWEST_LOOKS, _MANY_LOOKS = 3, 5, 30
"""The latest that a rough pose rests on; and of those that one pose must explain before a camera
counts as moved, the least and the largest number."""
_MOTION_PX = 10.0  # By which balls must have moved in them: other things of their colours do not
_ENOUGH_BALLS, _FEWEST_BALLS = 2, 3
"""In a picture: to find out where to look for the others, and to tell where a camera stands."""
_PAUSES_S = (0.1, 1.0)
"""From one search of a whole picture to the next: at first, and after many that found nothing."""
_WINDOWS_S = (4.0, 2.0, 1.0)
"""How long a camera must have stood still, and shown the balls; the longest that fits is taken."""
_AGAIN_S = 0.25  # From one try to bring a camera back to the next
_STILL_PX = 1.0  # Median miss of one pose up to which a camera stood still meanwhile
_MISS_PX = 3.0  # The same where some looks are of whole pictures
_ASIDE_PX, _TURN_SHARE, _SIZE_RATIO = 8.0, 0.25, 1.3
"""How far the other balls may lie from where they are with the first: so much, and a share of
their distance (a roll of 14 deg); and by what factor a ball may appear larger."""
_REACH_PX = 15.0  # Of a window by a rough pose
_LOST_LOOKS = 5  # Windows in a row without a ball after which whole pictures are searched
_AGREE = 0.999  # Confidence within which a camera stands where it stood before


class _Look(NamedTuple):
    """The balls that a camera shows in one picture."""

    time_s: float
    points: Floats  # (n, 3) where they are by the other cameras, mm
    detections: tuple[Detection, ...]  # n of them
    measured: Measurement  # by the others


@dataclass
class _Suspect:
    """A camera that sees no ball where the others do."""

    since_s: float
    blind_sets: int = 0
    looks: list[_Look] = field(default_factory=list)
    rough: Camera | None = None  # where it may stand now
    due_s: float = -np.inf  # of the next look at a whole picture, or the next try to bring it back
    pause_s: float = _PAUSES_S[0]
    lost_looks: int = 0


class CameraKeeper:
    """Keeps the rig of one body's pipeline; see `Keeper`.

    Args:
        cameras: as calibrated; at least three.
        follows: whether a camera that was moved is left out and brought back; else it is noticed.
        earlier: the changes that a run has kept, which is resumed at frame set `start`.
        drifts: whether a camera that drifts is followed.
    """

    def __init__(
        self,
        body: Body,
        cameras: Sequence[Camera],
        follows: bool = True,
        earlier: Sequence[CameraChange] = (),
        start: int = 0,
        drifts: bool = False,
    ) -> None:
        self._body, self._start = body, start
        self._rigs = [KeptRig(tuple(cameras), follows=follows)]
        for change in earlier:
            self._rigs.append(self._rigs[-1].changed(change))
        self._drift = DriftWatch(body, self._rigs[-1].cameras) if drifts else None
        self._suspects = {name: _Suspect(-np.inf, _BLIND_SETS) for name in self._rigs[-1].away}
        self._noticed: set[str] = set()  # cameras that are not asked about any more
        self._motion: Motion | None = None  # of the body at the last frame set

    def rig(self, frame_set: int) -> KeptRig:
        """The rig to measure a frame set with."""
        if frame_set >= self._start:
            return self._rigs[-1]
        return next(
            rig
            for rig in reversed(self._rigs)
            if all(change.frame_set <= frame_set for change in rig.changes)
        )

    def looks(
        self, frame_set: FrameSet, measured: Measurement, motion: Motion | None
    ) -> Mapping[str, Sequence[Expectation]]:
        """Cameras that may have been moved, and where in their pictures the balls may be."""
        pose, wanted = measured.pose, dict[str, Sequence[Expectation]]()
        self._motion = None
        if pose is None:
            return wanted
        velocity = np.zeros(6) if motion is None else motion.velocity
        self._motion = moving = Motion(pose.world_from_body, pose.time_s, velocity)
        rig, past = self.rig(frame_set.index), frame_set.index < self._start
        for camera in rig.cameras:
            name, image = camera.name, frame_set.images.get(camera.name)
            if image is None or name in self._noticed:
                continue
            if len({*pose.cameras} - {name}) < HOLDING:
                continue
            if name not in rig.away and (past or not self._is_blind(camera, measured, moving)):
                self._suspects.pop(name, None)
                continue
            suspect = self._suspects.setdefault(name, _Suspect(measured.time_s))
            suspect.blind_sets += 1
            if suspect.rough is not None:
                wanted[name] = self._windows(suspect.rough, moving, image.time_s)
            elif (
                suspect.blind_sets > _BLIND_SETS
                and measured.time_s >= suspect.due_s
                and len(_elsewhere(name, measured)) < _FEWEST_BALLS
            ):
                wanted[name] = ()
        return wanted

    def note(self, measured: Measurement, found: Mapping[str, Sequence[Detection]]) -> Measurement:
        """Take what cameras show that may have been moved; those left out show that they are."""
        rig = self.rig(measured.index)
        away = rig.away
        if self._drift is not None and measured.index >= self._start:
            step = self._drift.add(measured, rig.cameras)
            self._rigs += [rig.changed(step)] if step is not None else []
        for camera in rig.cameras if self._motion is not None else ():
            suspect = self._suspects.get(camera.name)
            if suspect is None or suspect.blind_sets <= _BLIND_SETS:
                continue
            self._look(camera, suspect, measured, found.get(camera.name))
            if measured.index + 1 < self._start:
                continue
            if camera.name not in away:
                self._judge_moved(camera, suspect, measured)
            elif suspect.rough is not None and measured.time_s >= suspect.due_s:
                suspect.due_s = measured.time_s + _AGAIN_S
                self._bring_back(camera, suspect, measured)
        return _left_out(measured, away, found)

    def _is_blind(self, camera: Camera, measured: Measurement, moving: Motion) -> bool:
        """Whether a camera should see the body, and sees it nowhere or mostly elsewhere."""
        own = [view for view in measured.views if view.camera == camera.name]
        agreeing = sum(view.effective for view in own)
        if agreeing and len(_elsewhere(camera.name, measured)) <= agreeing:
            return False
        pixels = camera.project(moving.world_from_body.apply(self._body.centers))
        return int(np.count_nonzero(camera.intrinsics.contains(pixels))) >= _FEWEST_BALLS

    def _windows(self, rough: Camera, moving: Motion, time_s: float) -> Sequence[Expectation]:
        """Where balls are to be expected by a rough pose."""
        none = np.zeros(6)
        state = MotionState.begin(moving.at(time_s), 1e-6 * np.eye(6), time_s, none)
        windows = predict_windows(state, {rough.name: time_s}, none, self._body, [rough])
        return windows.expectations(0.0, _REACH_PX, _SIZE_RATIO - 1)[rough.name]

    def _look(
        self,
        camera: Camera,
        suspect: _Suspect,
        measured: Measurement,
        found: Sequence[Detection] | None,
    ) -> None:
        """Find where it may stand by a whole picture, then remember what its windows show."""
        if suspect.rough is None:
            elsewhere = _elsewhere(camera.name, measured)
            if found is None and len(elsewhere) < _FEWEST_BALLS:
                return
            seen = self._matched(camera, elsewhere if found is None else found)
            if len(seen) >= _ENOUGH_BALLS:
                suspect.rough = _turned(camera, self._points(seen), seen)
                suspect.pause_s, suspect.lost_looks = _PAUSES_S[0], 0
            else:
                suspect.pause_s = min(2 * suspect.pause_s, _PAUSES_S[1])
            suspect.due_s = measured.time_s + suspect.pause_s
            return
        seen = list(found or ())
        if len(seen) < (_ENOUGH_BALLS if len(suspect.looks) >= _FEW_LOOKS else _FEWEST_BALLS):
            suspect.lost_looks += 1
            if suspect.lost_looks >= _LOST_LOOKS:
                suspect.rough, suspect.looks = None, []
            return
        suspect.lost_looks = 0
        look = _Look(measured.time_s, self._points(seen), tuple(seen), measured)
        since_s = measured.time_s - 2 * _WINDOWS_S[0]
        suspect.looks = [*(x for x in suspect.looks if x.time_s > since_s), look]
        if len(suspect.looks) >= _FEW_LOOKS:
            rough, miss_px = _resected(suspect.rough, suspect.looks[-_FEW_LOOKS:])
            if miss_px < _MISS_PX:
                suspect.rough = rough

    def _points(self, seen: Sequence[Detection]) -> Floats:
        """Where balls (n, 3) are by the other cameras when their pictures were taken."""
        assert self._motion is not None
        centers = self._body.centers
        at = [self._motion.at(d.time_s).apply(centers[self._body.index(d.ball)]) for d in seen]
        return np.stack(at)

    def _matched(self, camera: Camera, found: Sequence[Detection]) -> list[Detection]:
        """The balls among candidates, at most one of each, as they lie to each other."""
        assert self._motion is not None
        centers = self._motion.world_from_body.apply(self._body.centers)
        pixels = camera.project(centers)
        radii = camera.intrinsics.focal_px * self._body.radii
        radii = radii / np.linalg.norm(centers - camera.center, axis=1)
        of_ball = [
            [
                d
                for d in found
                if d.ball == name and 1 / _SIZE_RATIO < d.radius_px / radii[k] < _SIZE_RATIO
            ]
            for k, name in enumerate(self._body.names)
        ]
        best, least = list[Detection](), (0, -np.inf)
        for k, some in enumerate(of_ball):
            for first in some:
                shift, chosen, cost = first.center_px - pixels[k], [first], 0.0
                for j, others in enumerate(of_ball):
                    if j == k or not others:
                        continue
                    there = pixels[j] + shift
                    near = min(others, key=lambda d: float(np.linalg.norm(d.center_px - there)))
                    off = float(np.linalg.norm(near.center_px - there))
                    apart = float(np.linalg.norm(pixels[j] - pixels[k]))
                    if off < _ASIDE_PX + _TURN_SHARE * apart:
                        chosen.append(near)
                        cost += off
                if (len(chosen), -cost) > least:
                    best, least = chosen, (len(chosen), -cost)
        return best

    def _judge_moved(self, camera: Camera, suspect: _Suspect, measured: Measurement) -> None:
        """Leave a camera out that stands elsewhere than it did."""
        latest = suspect.looks[-_MANY_LOOKS:]
        if suspect.rough is None or len(latest) < _FEWEST_LOOKS or _motion_px(latest) < _MOTION_PX:
            return
        rough, miss_px = _resected(suspect.rough, latest)
        before, now = _misses_px(camera, latest), _misses_px(rough, latest)
        if miss_px > _STILL_PX:
            return
        if not np.median(before) > CLEAR_RATIO * max(float(np.median(now)), SUSPICIOUS_PX):
            return
        change = CameraChange(camera.name, measured.index + 1, suspect.since_s)
        self._rigs.append(self._rigs[-1].changed(change))
        if not self._rigs[-1].follows:
            self._noticed.add(camera.name)
            self._suspects.pop(camera.name)

    def _bring_back(self, camera: Camera, suspect: _Suspect, measured: Measurement) -> None:
        """Use a camera again if one pose explains what it has shown long enough."""
        assert suspect.rough is not None
        for window_s in _WINDOWS_S:
            since_s = measured.time_s - window_s
            looks = [look for look in suspect.looks if look.time_s > since_s]
            if not looks or len(looks) == len(suspect.looks) or _motion_px(looks) < _MOTION_PX:
                continue  # it was not seen for so long, or the balls rested
            rough, miss_px = _resected(suspect.rough, looks)
            if miss_px > _STILL_PX:
                continue
            known = self._refined(rough, looks)
            if known is None:
                continue
            change = CameraChange(
                camera.name,
                measured.index + 1,
                looks[0].time_s,
                known.world_from_camera,
                known.pose_covariance,
            )
            if (same := self._as_before(camera, known)) is not None:
                change = replace(change, world_from_camera=same.world_from_camera)
                change = replace(change, covariance=same.pose_covariance)
            self._rigs.append(self._rigs[-1].changed(change))
            self._suspects.pop(camera.name)
            return

    def _as_before(self, before: Camera, now: Camera) -> Camera | None:
        """The camera as it stood, if it stands there again."""
        assert now.pose_covariance is not None
        known = now.pose_covariance
        if before.pose_covariance is not None:
            known = known + before.pose_covariance
        step = now.world_from_camera.difference(before.world_from_camera)
        alike = squared_mahalanobis(step, known) < chi_square_quantile(_AGREE, 6)
        return before if alike else None

    def _refined(self, rough: Camera, looks: Sequence[_Look]) -> Camera | None:
        """The camera with its pose and the covariance of that; None if that is not known yet."""
        seen = [_seen_by_all(look) for look in looks]
        used = {v.camera for one in seen for v in one.views}
        first = [rough if c.name == rough.name else c for c in self._rigs[-1].cameras]
        first = [c for c in first if c.name in used]
        free, joint = loosened(first, (rough.name,), moved=True)
        try:
            recording = recording_of(seen, self._body, least_motion_mm=0.0)
            refinement = refine_rig(
                free, self._body, recording, None, joint, UNTRIED_VARIANCE_FACTOR
            )
        except CalibrationError:
            return None
        missed = {name: after for name, (_, after) in refinement.rms_px.items()}
        own = missed.pop(rough.name)
        if own > CLEAR_RATIO * max(*missed.values(), SUSPICIOUS_PX / 2):
            return None
        freed = FreedRig((rough.name,), True, free, joint, refinement)
        cameras, _ = freed.as_stated(refinement, first, _stated(first))
        return next(c for c in cameras if c.name == rough.name)


def _elsewhere(camera: str, measured: Measurement) -> list[Detection]:
    """What it shows of balls at other places than where they should be."""
    return [
        view.detection
        for view in measured.views
        if view.camera == camera and view.detection is not None
        if view.reason in (Reason.INCONSISTENT, Reason.JUMPED, Reason.RECOVERING)
    ]


def _resected(near: Camera, looks: Sequence[_Look]) -> tuple[Camera, float]:
    """The camera where it shows balls best, and its median miss in px; infinite if undetermined.

    A camera that is moved about the balls sees what it would see of balls moved about it.
    """
    seen = [d for look in looks for d in look.detections]
    unmoved = replace(near, world_from_camera=RigidTransform.identity(), pose_covariance=None)
    observations = PoseObservations(
        Rig.of([unmoved] * len(seen)),
        np.concatenate([look.points for look in looks]),
        np.zeros(len(seen), dtype=np.int64),
        np.stack([d.center_px for d in seen]),
        np.stack([d.covariance_px for d in seen]) + SUSPICIOUS_PX**2 * np.eye(2),
        np.zeros(len(seen)),
    )
    try:
        fit = fit_pose(near.camera_from_world, observations)
    except DegenerateGeometryError:
        return near, np.inf
    found = replace(near, world_from_camera=fit.world_from_body.inverse())
    return found, float(np.median(_misses_px(found, looks)))


def _turned(camera: Camera, points: Floats, seen: Sequence[Detection]) -> Camera:
    """The camera turned about its centre so that it shows balls (n, 3) best (Wahba 1965)."""
    rays = camera.intrinsics.unproject(np.stack([d.center_px for d in seen]))
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    away = points - camera.center
    away = away / np.linalg.norm(away, axis=1)[:, None]
    U, _, Vt = np.linalg.svd(away.T @ rays)
    turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return replace(camera, world_from_camera=RigidTransform(turn, camera.center))


def _motion_px(looks: Sequence[_Look]) -> float:
    """How far balls have moved in the pictures, the one that moved least."""
    seen = [d for look in looks for d in look.detections]
    ways = [
        np.ptp([d.center_px for d in seen if d.ball == ball], axis=0)
        for ball in {d.ball for d in seen}
    ]
    return min(float(np.linalg.norm(way)) for way in ways)


def _misses_px(camera: Camera, looks: Sequence[_Look]) -> Floats:
    """How far from where a camera should show them balls lie (n,); infinite without an image."""
    pixels = camera.project(np.concatenate([look.points for look in looks]))
    seen = np.stack([d.center_px for look in looks for d in look.detections])
    return np.nan_to_num(np.linalg.norm(seen - pixels, axis=1), nan=np.inf)


def _seen_by_all(look: _Look) -> Measurement:
    """The measurement by the others with the views of the camera in question beside theirs."""
    pose = look.measured.pose
    assert pose is not None
    name = look.detections[0].camera
    views = [view for view in look.measured.views if view.effective and view.camera != name]
    views += [BallView(d.ball, name, State.EFFECTIVE, detection=d) for d in look.detections]
    return replace(look.measured, views=tuple(views), pose=replace(pose, flags=()))


def _stated(cameras: Sequence[Camera]) -> Floats | None:
    """What calibration states of all cameras (p, p), each by itself; None if of one nothing."""
    from scipy.linalg import block_diag

    blocks = []
    for camera in cameras:
        if camera.covariance is None:
            return None
        blocks.append(camera.covariance[np.ix_(camera.free, camera.free)])
    return np.asarray(block_diag(*blocks), dtype=np.float64)


def _left_out(
    measured: Measurement, away: Sequence[str], found: Mapping[str, Sequence[Detection]]
) -> Measurement:
    """The measurement, which shows of cameras left out what they saw, and that they are."""
    if not away:
        return measured
    seen = {(d.camera, d.ball): d for some in found.values() for d in reversed(some)}
    views = tuple(
        BallView(v.ball, v.camera, State.SUSPENDED, Reason.MOVED, seen.get((v.camera, v.ball)))
        if v.camera in away
        else v
        for v in measured.views
    )
    return replace(measured, views=views).noted(*(Doubt("moved", camera=n) for n in away))
