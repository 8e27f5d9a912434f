"""Flags of a solved pose: soft ones lower its status, hard ones also keep it out of the filter.

A robust fit suspends outliers and adapts to an error that all views of one ball share, so its
residuals stay small. What remains visible: the number of suspended views, and balls that
triangulation puts elsewhere. For errors that all balls of one camera share see `camera_bias`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.estimation.body_layout import layout_flags
from measure.estimation.multiview import calibration_noise
from measure.geometry import chi_square_quantile, squared_mahalanobis
from measure.measuring.association.associate import MIN_VIEWS, Association
from measure.measuring.tracking.predictive.motion_filter import MotionState
from measure.model import BallPosition, BallView, Body, Camera, Detection, Pose, Rig
from measure.model.observations import Reason, stacked_positions

_MIN_SCORE = 0.5  # Score of a candidate that is taken for a ball
_MAX_CONTRADICTING_SHARE = 0.5
_RMS_SIGMAS = 2.0
_MOTION_CONFIDENCE = 0.9999
_MIN_ELSEWHERE = 2
_ELSEWHERE = (Reason.INCONSISTENT, Reason.JUMPED)
"""Reasons of a ball detected at another place than predicted."""


def hard_flags(
    pose: Pose,
    positions: Sequence[BallPosition],
    views: Sequence[BallView],
    body: Body,
    cameras: Sequence[Camera],
    tolerance_mm: float,
    max_rms_px: float,
) -> tuple[str, ...]:
    """Flags of a wrong pose: ball distances, reprojection errors, contradicting cameras.

    Args:
        views: with effective and suspended detections.
        tolerance_mm: error of a distance between balls that is never flagged.
        max_rms_px: reprojection error that is never flagged, besides the stated uncertainty of
            detections and calibration.
    """
    found: tuple[str, ...] = ()
    if len(positions) >= 2:
        found += layout_flags(
            body,
            [position.ball for position in positions],
            *stacked_positions(tuple(positions)),
            tolerance_mm,
        )
    if pose.rms_px > max_rms_px and pose.rms_px > math.hypot(
        max_rms_px, _RMS_SIGMAS * _noise(views, cameras, pose.world_from_body.apply(body.middle))
    ):
        found += (f"reprojection errors of {pose.rms_px:.1f} px",)
    contradicting = contradicting_cameras(views)
    if contradicting:
        used = {view.camera for view in views if view.effective} | set(contradicting)
        if len(contradicting) >= _MAX_CONTRADICTING_SHARE * len(used):
            names = ", ".join(contradicting)
            found += (f"cameras {names} contradict the others: nobody can tell who errs",)
    return found


def _noise(views: Sequence[BallView], cameras: Sequence[Camera], place: Floats) -> float:
    """RMS stated error, over both axes, of the effective detections about a place (3,), px."""
    variances = np.trace(calibration_noise(Rig.of(cameras), place), axis1=1, axis2=2)
    by_camera = dict(zip([camera.name for camera in cameras], variances.tolist(), strict=True))
    noise = [
        2 * v.detection.variance_px2 + by_camera[v.camera]
        for v in views
        if v.effective and v.detection
    ]
    return math.sqrt(sum(noise) / max(len(noise), 1))


def soft_flags(pose: Pose, views: Sequence[BallView], max_sd_mm: float) -> tuple[str, ...]:
    """Flags of a pose that is less certain than usual, or of cameras to check."""
    found: tuple[str, ...] = ()
    effective = [view for view in views if view.effective]
    used = sorted({view.camera for view in effective})
    if len(used) == 1:
        found += (f"one camera only ({used[0]}): its distance rests on outline sizes",)
    if len({view.ball for view in effective}) < 3:
        found += ("fewer than three balls in sight",)
    if not pose.position_sd_mm <= max_sd_mm:
        found += (f"position known to {pose.position_sd_mm:.1f} mm only",)
    return found + tuple(
        f"camera {name} contradicts the others on every ball: check its calibration"
        for name in contradicting_cameras(views)
    )


def disagreeing_cameras(
    found: Association,
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
) -> tuple[str, ...]:
    """Cameras that see two or more balls well, but none where the body found should appear."""
    assert found.world_from_body is not None
    centers = found.world_from_body.apply(body.centers)
    agreeing = {d.camera for d in found.detections}
    out = []
    for camera in cameras:
        if camera.name in agreeing:
            continue
        in_view = int(np.sum(camera.intrinsics.contains(camera.project(centers))))
        good = {d.ball for d in detections.get(camera.name, ()) if d.score >= _MIN_SCORE}
        if len(good) >= 2 and (in_view >= 2 or in_view == 0):
            out.append(camera.name)
    return tuple(out)


def disagreement_flags(names: Sequence[str]) -> tuple[str, ...]:
    """A flag for each of the cameras that `disagreeing_cameras` names."""
    return tuple(
        f"camera {name} sees balls, but none where the others do: `measure check` tells why"
        for name in names
    )


def unstable_initialisation(views: Sequence[BallView], times_s: Sequence[float]) -> tuple[str, ...]:
    """A flag if images of different times contradict each other about a body just found.

    Its velocity is still unknown. Where two or more detections lie elsewhere than predicted, the
    others may have been moved to the common instant by a wrong velocity as well.
    """
    elsewhere = sum(v.reason in _ELSEWHERE and v.detection is not None for v in views)
    if elsewhere < _MIN_ELSEWHERE or len(set(times_s)) < 2:
        return ()
    return (f"just found, and {elsewhere} sightings lie elsewhere: it may move too fast to tell",)


def implausible_motion(
    lost: MotionState | None, found: MotionState, acceleration_sd: Floats
) -> tuple[str, ...]:
    """A flag if a body was found further from where it was lost than it can have moved.

    Args:
        lost: the motion when the body was last seen; None if it never was.
        acceleration_sd: (6,) as in `MotionState.at`.
    """
    if lost is None:
        return ()
    expected = lost.at(found.time_s, acceleration_sd)
    step = found.world_from_body.difference(expected.world_from_body)
    noise = expected.covariance[:6, :6] + found.covariance[:6, :6]
    if step @ np.linalg.solve(noise, step) < chi_square_quantile(_MOTION_CONFIDENCE, 6):
        return ()
    moved = np.linalg.norm(found.world_from_body.translation - lost.world_from_body.translation)
    text = f"found {moved:.0f} mm from where it was {found.time_s - lost.time_s:.2f} s before"
    return (f"{text}, further than it can have moved: this may be another body",)


def unconfirmed_balls(
    views: Sequence[BallView], body: Body, confirmed: set[str]
) -> tuple[str, ...]:
    """Flags of balls that no two cameras have seen at once since the body was found.

    Three balls alone fit a body whose fourth is elsewhere, and the mirror image, equally well.

    Args:
        confirmed: names of balls that two cameras have seen; this function adds to them.
    """
    if len(body.balls) <= 3:
        return ()
    for ball in body.names:
        if sum(view.ball == ball and view.effective for view in views) >= 2:
            confirmed.add(ball)
    return tuple(
        f"ball {ball} has not been seen where the body file puts it: hidden, or a wrong file?"
        for ball in body.names
        if ball not in confirmed
    )


def too_uncertain(pose: Pose, body: Body) -> bool:
    """Whether the standard deviation of the balls' places exceeds the smallest ball's radius.

    Windows would then be as large as the image and contain several balls: a search is faster and
    safer.
    """
    variances = pose.covariance.diagonal().tolist()
    move_mm2, turn2 = sum(variances[:3]), sum(variances[3:])
    return math.sqrt(move_mm2 + turn2 * body.reach_mm**2) > min(b.radius_mm for b in body.balls)


def contradicting_cameras(views: Sequence[BallView]) -> list[str]:
    """Cameras with two or more detections, all of them elsewhere than predicted."""
    out = []
    for name in dict.fromkeys(view.camera for view in views if view.reason in _ELSEWHERE):
        seen = [v for v in views if v.camera == name and v.detection is not None]
        elsewhere = [v for v in seen if v.reason in _ELSEWHERE]
        if len(seen) >= 2 and len(elsewhere) == len(seen):
            out.append(name)
    return out


_ELSEWHERE_LATELY = (Reason.JUMPED, Reason.INCONSISTENT, Reason.RECOVERING)
"""Reasons of a ball detected elsewhere than predicted, or lately."""
_MIN_CAMERAS = 2


def consistency_flags(
    pose: Pose,
    views: Sequence[BallView],
    positions: Sequence[BallPosition],
    body: Body,
    view_bias_px: float,
    confidence: float,
) -> tuple[str, ...]:
    """Flags of a pose, a line each.

    Args:
        views: with effective and suspended detections.
        view_bias_px: standard deviation of a ball-view's own bias besides its noise.
        confidence: probability of the gates.
    """
    variances = {
        (v.ball, v.camera): v.detection.variance_px2
        for v in views
        if v.effective and v.detection is not None
    }
    found = tuple(_balls_seen_elsewhere(views))
    found += tuple(
        _balls_located_elsewhere(pose, positions, variances, body, view_bias_px, confidence)
    )
    if len(variances) < MIN_VIEWS:
        found += (f"only {len(variances)} sightings of balls: little would show a mistake",)
    return found


def single_view_balls(
    pose: Pose, views: Sequence[BallView], body: Body, cameras: Sequence[Camera]
) -> tuple[str, ...]:
    """Flags of balls that one camera alone sees, though others look where they should be."""
    count = dict.fromkeys(body.names, 0)
    for view in views:
        count[view.ball] += view.effective
    # With three balls in two cameras each, the rotation rests on none of the others.
    if 1 not in count.values() or sum(n > 1 for n in count.values()) > 2:
        return ()
    centers = pose.world_from_body.apply(body.centers)
    found = []
    for ball in (name for name in body.names if count[name] == 1):
        missing = {v.camera for v in views if v.ball == ball and v.reason is Reason.NOT_FOUND}
        blind = [
            camera.name
            for camera in cameras
            if camera.name in missing and _in_sight(camera, body, centers, body.index(ball))
        ]
        if len(blind) >= _MIN_CAMERAS:
            found.append(
                f"ball {ball} is seen by one camera only, and not by {', '.join(blind)}: hidden, "
                "or not where the body file puts it?"
            )
    return tuple(found)


def _in_sight(camera: Camera, body: Body, centers: Floats, ball: int) -> bool:
    """Whether a ball lies in the image and its centre is hidden by no other ball of the body."""
    if not camera.intrinsics.contains(camera.project(centers[ball][None]))[0]:
        return False
    away = centers - camera.center
    line = away[ball] / np.linalg.norm(away[ball])
    depth = away @ line
    off = np.linalg.norm(away - depth[:, None] * line, axis=1)
    return not np.any((off < body.radii) & (depth < depth[ball]))


def _balls_seen_elsewhere(views: Sequence[BallView]) -> Iterable[str]:
    """Balls detected elsewhere by two cameras, or by as many as detect them where predicted."""
    for ball in dict.fromkeys(view.ball for view in views if view.reason in _ELSEWHERE_LATELY):
        seen = [view for view in views if view.ball == ball]
        against = [v for v in seen if v.detection is not None and v.reason in _ELSEWHERE_LATELY]
        effective = sum(view.effective for view in seen)
        if len(against) >= _MIN_CAMERAS or (against and len(against) >= effective):
            cameras = ", ".join(view.camera for view in against)
            yield (
                f"ball {ball} is seen elsewhere by {cameras}: "
                "a wrong body file, another ball, or a camera that was moved?"
            )


def _balls_located_elsewhere(
    pose: Pose,
    positions: Sequence[BallPosition],
    variances: Mapping[tuple[str, str], float],
    body: Body,
    view_bias_px: float,
    confidence: float,
) -> Iterable[str]:
    """Balls whose triangulated positions differ from where the body in its pose puts them."""
    if not positions:
        return
    gate, placed = chi_square_quantile(confidence, 3), pose.world_from_body
    centers, covariances = stacked_positions(tuple(positions))
    balls = body.centers_of([position.ball for position in positions])
    off = centers - placed.apply(balls)
    distances = squared_mahalanobis(off, covariances + body.center_covariance).tolist()
    gone = np.linalg.norm(off, axis=1).tolist()
    for position, distance, gone_mm in zip(positions, distances, gone, strict=True):
        if distance > gate and distance > gate * _bias_factor(position, variances, view_bias_px):
            yield (
                f"ball {position.ball} is {gone_mm:.1f} mm from where the body puts it: "
                "a wrong body file, or a camera that was moved?"
            )


def _bias_factor(
    position: BallPosition, variances: Mapping[tuple[str, str], float], view_bias_px: float
) -> float:
    """Factor on a position's covariance for the biases of its views."""
    own = [
        variances[position.ball, name]
        for name in position.cameras
        if (position.ball, name) in variances
    ]
    return 1 + view_bias_px**2 * sum(1 / v for v in own) / len(own) if own else 1.0
