"""What was seen of a body where its pose is known: the evidence that searches and runs give."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.checking.evidence import SEARCHED_PX, TRACKED_PX, Evidence, Sighting
from measure.checking.search import SearchSample, with_velocities
from measure.geometry import RigidTransform, chi_square_quantile, squared_mahalanobis
from measure.measuring.measurement import Measurement
from measure.measuring.pose_spline import REACH, motion_at
from measure.model import Body, Camera, Detection, Pose
from measure.model.observations import Reason

MOST_INSTANTS, _FEWEST = 60, 5
_MOTION_CONFIDENCE = 0.9999
_APART_S = 0.5  # From what was followed, which says more of the time near it
_AGREEING = 2  # Balls of a camera, or cameras of a ball, that must agree with the pose
_LIKELY_RATIO = 1.6
"""Largest factor of an outline's size that a far zoomed camera may show of a ball."""


def evidence_of(
    searched: Sequence[SearchSample],
    found: Sequence[Mapping[str, Sequence[Detection]]],
    measured: Sequence[Measurement],
    body: Body,
    cameras: Sequence[Camera],
    gaps_s: Mapping[str, Floats] | None = None,
    most: int = MOST_INSTANTS,
) -> Evidence | None:
    """What was seen of the body where its pose is known: measured in a row, else searched.

    Args:
        searched: frame sets in which all was searched, and `found` what was found there.
        measured: frame sets measured one after the other.
        gaps_s: by camera, when its stamps, and no other's, have a gap.
        most: largest number of instants, of frame sets measured.
    """
    whole = [
        Sighting(
            sample.time_s,
            sample.world_from_body,
            sample.velocity,
            _seen_there(sample, every, body, cameras),
        )
        for sample, every in zip(with_velocities(searched), found, strict=True)
        if sample.world_from_body is not None
    ]
    tracked = [m for m in measured if m.pose is not None]
    if len(tracked) < max(len(whole) / 2, _FEWEST):
        return Evidence.of(whole, body, cameras, SEARCHED_PX, gaps_s)
    near = {round(s.time_s, 4): s.detections for s in whole}
    chosen = np.unique(np.linspace(0, len(tracked) - 1, most).round().astype(int)).tolist()
    completed = [
        Sighting(tracked[k].time_s, *motion, list(_preferred(tracked[k], near)))
        for k, motion in zip(chosen, _motions(tracked, chosen), strict=True)
    ]
    # What was searched before and after tells of what changes slowly.
    first_s, last_s = tracked[0].time_s - _APART_S, tracked[-1].time_s + _APART_S
    beyond = [s._replace(systematic_px=SEARCHED_PX) for s in whole]
    beyond = [s for s in beyond if not first_s < s.time_s < last_s]
    together = sorted([*completed, *beyond], key=lambda s: s.time_s)
    return Evidence.of(together, body, cameras, TRACKED_PX, gaps_s)


def followed_evidence(
    measurements: Iterable[Measurement],
    body: Body,
    cameras: Sequence[Camera],
    systematic_px: float = TRACKED_PX,
) -> Evidence | None:
    """All that was seen well of the body in frame sets measured one after the other."""
    posed = [m for m in measurements if m.pose is not None]
    sightings = [
        Sighting(
            one.time_s, *motion, [v.detection for v in one.views if v.effective and v.detection]
        )
        for one, motion in zip(posed, _motions(posed, range(len(posed))), strict=True)
    ]
    return Evidence.of(sightings, body, cameras, systematic_px)


def _motions(
    posed: Sequence[Measurement], chosen: Iterable[int]
) -> Iterator[tuple[RigidTransform, Floats]]:
    """Poses and velocities of some of those with a pose, by the poses around them.

    Zero where the noise of the poses explains the velocity: it holds no information on clocks.
    """
    poses = [m.pose for m in posed if m.pose is not None]
    gate = chi_square_quantile(_MOTION_CONFIDENCE, 6)
    for k in chosen:
        before, after = poses[max(k - REACH, 0) : k], poses[k + 1 : k + 1 + REACH]
        motion, velocity = motion_at(poses[k], before, after), np.zeros(6)
        if motion is not None and motion.velocity_covariance is not None:
            own, noise = motion.velocity, motion.velocity_covariance
            if squared_mahalanobis(own, noise) < gate:  # a slow body's shows over a longer time
                own, noise = _steady(poses[k], before, after)
            if squared_mahalanobis(own, noise) >= gate:
                velocity = own
        yield poses[k].world_from_body, velocity


def _steady(pose: Pose, before: Sequence[Pose], after: Sequence[Pose]) -> tuple[Floats, Floats]:
    """The velocity (6,) about a pose and its covariance (6, 6), by the line through all of them."""
    knots = [*before, pose, *after]
    times_s = np.array([knot.time_s for knot in knots])
    weights = times_s - times_s.mean()
    weights /= weights @ weights
    steps = np.stack([k.world_from_body.difference(pose.world_from_body) for k in knots])
    noise = np.einsum("k,kij->ij", weights**2, np.stack([k.covariance for k in knots]))
    return weights @ steps, noise


def _preferred(one: Measurement, near: Mapping[float, Sequence[Detection]]) -> Iterator[Detection]:
    """Of each ball and camera what was followed, else what was searched, else followed in doubt."""
    whole = {(d.camera, d.ball): d for d in near.get(round(one.time_s, 4), ())}
    for view in one.views:
        found = whole.pop((view.camera, view.ball), None)
        if view.effective or (found is None and view.reason is not Reason.COLOR):
            found = view.detection
        if found is not None:
            yield found
    yield from whole.values()


def _seen_there(
    sample: SearchSample,
    every: Mapping[str, Sequence[Detection]],
    body: Body,
    cameras: Sequence[Camera],
) -> list[Detection]:
    """What agrees with the pose, and what is near it where a camera or a ball hardly agrees.

    Near is the candidate nearest to where a ball should be, or the best of its size in the camera.
    """
    seen = {(d.camera, d.ball): d for d in sample.agreeing}
    by_camera, by_ball = (Counter(pair[i] for pair in seen) for i in (0, 1))
    lost = {camera.name for camera in cameras if by_camera[camera.name] < _AGREEING}
    near = [d for d in sample.nearest if d.camera in lost or by_ball[d.ball] < _AGREEING]
    seen |= {(d.camera, d.ball): d for d in near}
    assert sample.world_from_body is not None
    centers = sample.world_from_body.apply(body.centers)
    for camera in (camera for camera in cameras if camera.name in lost):
        away = np.linalg.norm(centers - camera.center, axis=1)
        for k, ball in enumerate(body.balls):
            radius_px = camera.intrinsics.focal_px * ball.radius_mm / away[k]
            own = [d for d in every.get(camera.name, ()) if d.ball == ball.name]
            alike = [d for d in own if 1 / _LIKELY_RATIO < d.radius_px / radius_px < _LIKELY_RATIO]
            if alike and (camera.name, ball.name) not in seen:
                seen[camera.name, ball.name] = max(alike, key=lambda d: d.score)
    return list(seen.values())
