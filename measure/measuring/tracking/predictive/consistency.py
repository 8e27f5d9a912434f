"""What the sightings of one frame set, taken together, say against the pose fitted to them.

A fit leaves out what it does not believe, and gives way to what is wrong with all of a ball: its
residuals stay small. What then stands out is sightings left out in number, and balls that rays
alone put elsewhere. For what is wrong with all of a camera see `aside`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from measure.arrays import Floats
from measure.estimation.body_layout import distances_from_body
from measure.geometry import chi_square_quantile
from measure.model import BallPosition, BallView, Body, Camera, Pose
from measure.model.observations import Reason, stacked_positions

_DISBELIEVED = (Reason.JUMPED, Reason.INCONSISTENT, Reason.RECOVERING)
_MANY = 2
_LEAST_SIGHTINGS = 5
"""As many as a search must find before it calls something the body."""


def inconsistencies(
    pose: Pose,
    views: Sequence[BallView],
    positions: Sequence[BallPosition],
    body: Body,
    view_bias_px: float,
    confidence: float,
) -> tuple[str, ...]:
    """Reasons to doubt a pose, a line each.

    Args:
        pose: the pose.
        views: what was seen, and what of it is believed.
        positions: the balls' centres.
        body: as its file says.
        view_bias_px: standard deviation of what a sighting is off by besides its noise.
        confidence: what is less likely than this is doubted.
    """
    variances = {
        (v.ball, v.camera): v.detection.variance_px2
        for v in views
        if v.effective and v.detection is not None
    }
    found = tuple(_disbelieved(views))
    found += tuple(_balls_aside(pose, positions, variances, body, view_bias_px, confidence))
    if len(variances) < _LEAST_SIGHTINGS:
        found += (f"only {len(variances)} sightings of balls: little would show a mistake",)
    return found


def unbacked(
    pose: Pose, views: Sequence[BallView], body: Body, cameras: Sequence[Camera]
) -> tuple[str, ...]:
    """Balls that one camera alone shows, though others should, and on which the rotation rests.

    Two balls and a third somewhere on one line of sight fit bodies that are quite different ones.
    """
    count = dict.fromkeys(body.names, 0)
    for view in views:
        count[view.ball] += view.effective
    # Three balls make a pose.
    if 1 not in count.values() or sum(n > 1 for n in count.values()) > 2:
        return ()
    centers = pose.world_from_body.apply(body.centers)
    found = []
    for ball in (name for name in body.names if count[name] == 1):
        lacking = {v.camera for v in views if v.ball == ball and v.reason is Reason.NOT_FOUND}
        blind = [
            camera.name
            for camera in cameras
            if camera.name in lacking and _in_sight(camera, body, centers, body.index(ball))
        ]
        if len(blind) >= _MANY:
            found.append(
                f"ball {ball} is seen by one camera only, and not by {', '.join(blind)}: hidden, "
                "or not where the body file puts it?"
            )
    return tuple(found)


def _in_sight(camera: Camera, body: Body, centers: Floats, ball: int) -> bool:
    """Whether a ball lies in the picture, and its middle behind no other ball of the body."""
    if not camera.intrinsics.contains(camera.project(centers[ball][None]))[0]:
        return False
    away = centers - camera.center
    line = away[ball] / np.linalg.norm(away[ball])
    along = away @ line
    off = np.linalg.norm(away - along[:, None] * line, axis=1)
    before = (off < body.radii) & (along < along[ball])
    return not np.any(before)


def _disbelieved(views: Sequence[BallView]) -> Iterable[str]:
    """Balls that more cameras see elsewhere than where the pose puts them, or that two do."""
    for ball in dict.fromkeys(view.ball for view in views if view.reason in _DISBELIEVED):
        seen = [view for view in views if view.ball == ball]
        against = [v for v in seen if v.detection is not None and v.reason in _DISBELIEVED]
        backing = sum(view.effective for view in seen)
        if len(against) >= _MANY or (against and len(against) >= backing):
            cameras = ", ".join(view.camera for view in against)
            yield (
                f"ball {ball} is seen elsewhere by {cameras}: "
                "a wrong body file, another ball, or a camera that was moved?"
            )


def _balls_aside(
    pose: Pose,
    positions: Sequence[BallPosition],
    variances: Mapping[tuple[str, str], float],
    body: Body,
    view_bias_px: float,
    confidence: float,
) -> Iterable[str]:
    """Balls that are not where the body puts them, by rays alone."""
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
        if distance > gate and distance > gate * _widening(position, variances, view_bias_px):
            yield (
                f"ball {position.ball} is {gone_mm:.1f} mm from where the body puts it: "
                "a wrong body file, or a camera that was moved?"
            )


def _widening(
    position: BallPosition, variances: Mapping[tuple[str, str], float], view_bias_px: float
) -> float:
    """Factor on a position's covariance for what its views are off by besides noise."""
    own = [
        variances[position.ball, name]
        for name in position.cameras
        if (position.ball, name) in variances
    ]
    return 1 + view_bias_px**2 * sum(1 / v for v in own) / len(own) if own else 1.0
