"""Flags of poses that contradict the ball-views of their frame set taken together.

A robust fit suspends outliers and adapts to an error that all views of one ball share, so its
residuals stay small. What remains visible: the number of suspended views, and balls that
triangulation puts elsewhere. For errors that all balls of one camera share see `camera_bias`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.estimation.body_layout import distances_from_body
from measure.geometry import chi_square_quantile
from measure.model import BallPosition, BallView, Body, Camera, Pose
from measure.model.observations import Reason, stacked_positions

_ELSEWHERE = (Reason.JUMPED, Reason.INCONSISTENT, Reason.RECOVERING)
"""Reasons of a ball detected elsewhere than predicted, or lately."""
_MIN_CAMERAS = 2
_MIN_BALL_VIEWS = 5  # The same as a search requires (`AssociationSettings.min_views`)


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
    if len(variances) < _MIN_BALL_VIEWS:
        found += (f"only {len(variances)} sightings of balls: little would show a mistake",)
    return found


def single_view_balls(
    pose: Pose, views: Sequence[BallView], body: Body, cameras: Sequence[Camera]
) -> tuple[str, ...]:
    """Covariance (2, 2) px^2 of an offset by the uncertain calibration, body and motion."""
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
    for ball in dict.fromkeys(view.ball for view in views if view.reason in _ELSEWHERE):
        seen = [view for view in views if view.ball == ball]
        against = [v for v in seen if v.detection is not None and v.reason in _ELSEWHERE]
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
    distances = distances_from_body(
        np.ascontiguousarray(placed.rotation),
        np.ascontiguousarray(placed.translation),
        body.centers_of([position.ball for position in positions]),
        centers,
        covariances + body.center_covariance,
    )
    for position, (distance, gone_mm) in zip(positions, distances.tolist(), strict=True):
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
