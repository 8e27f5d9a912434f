"""What two bodies in the same pictures say about the cameras, and so about each other.

Solved alone, each of two bodies trusts the cameras as its own balls ask for; together they see the
same cameras. Generalised least squares (Aitken 1936) of the centres of both, whose covariance holds
what an uncertain camera does to all of them, gives the step from the poses solved alone to those
solved together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from measure.arrays import Floats
from measure.estimation.pose_fit import PoseObservations
from measure.geometry import RigidTransform, propagate
from measure.measuring.measurement import Measurement
from measure.model import Body, Camera, Detection


class TogetherStep(NamedTuple):
    """From two poses solved alone to the same solved together, in their `perturb` charts."""

    step: Floats  # (12,) of the one pose, then of the other
    alone: Floats  # (12, 12) covariance of the poses solved alone, by pixels and cameras
    together: Floats  # (12, 12) the same of those solved together


def solved_together(
    pairs: Sequence[tuple[Body, Measurement]], cameras: Sequence[Camera]
) -> TogetherStep | None:
    """How the poses of bodies change if they are solved together.

    None if no uncertain camera sees them, or if the centres seen of one do not tell its pose: two
    balls leave it a turn, which its solver has from elsewhere.

    Args:
        pairs: each body and its measurement of the same frame set, with a pose.
        cameras: all cameras, with their covariances.
    """
    uncertain = [camera for camera in cameras if camera.covariance is not None]
    seen = [_seen(measured, uncertain) for _, measured in pairs]
    if not all(map(_tell_pose, seen)):
        return None
    linear = [
        _linearised(body, measured.pose.world_from_body, views, uncertain)
        for (body, measured), views in zip(pairs, seen, strict=True)
        if measured.pose is not None
    ]
    by_pose, noise = (block_diag(*parts) for parts in zip(*[o[1:3] for o in linear], strict=True))
    known = block_diag(*[c.covariance for c in uncertain if c.covariance is not None])
    by_camera = np.vstack([one.by_camera for one in linear])
    shared = propagate(by_camera, known)
    apart = block_diag(*[propagate(one.by_camera, known) for one in linear])
    residuals = np.concatenate([one.residuals for one in linear])
    alone, together = (_estimator(by_pose, noise + part) for part in (apart, shared))
    return TogetherStep(
        (together - alone) @ residuals,
        propagate(alone, noise + shared),
        propagate(together, noise + shared),
    )


class _CenterEquations(NamedTuple):
    """The n coordinates in pictures of a body's balls."""

    residuals: Floats  # (n,) detected less predicted, px
    by_pose: Floats  # (n, 6)
    noise: Floats  # (n, n) px^2
    by_camera: Floats  # (n, 18 c)


_Seen = list[tuple[Detection, Floats]]
"""Detections of a body with what they are off the prediction (2,), px."""


def _seen(measured: Measurement, cameras: Sequence[Camera]) -> _Seen:
    """The effective detections in `cameras`."""
    names, off = {camera.name for camera in cameras}, measured.residuals_px
    used = [view.detection for view in measured.views if view.effective and view.detection]
    return [(d, off[d.ball, d.camera]) for d in used if d.camera in names]


def _tell_pose(seen: _Seen) -> bool:
    """Whether centres alone determine a pose, with some left to contradict each other."""
    return len({d.ball for d, _ in seen}) > 2 and len(seen) > 3


def _linearised(
    body: Body, place: RigidTransform, seen: _Seen, cameras: Sequence[Camera]
) -> _CenterEquations:
    from measure.model.projection import by_cameras

    by_name = {camera.name: camera for camera in cameras}
    rows = [list(by_name).index(d.camera) for d, _ in seen]
    centers = PoseObservations.of([d for d, _ in seen], body, by_name, time_s=0.0)
    _, by_pose, _ = centers.residuals(place, np.zeros(6))
    by_camera = np.zeros((len(seen), 2, len(cameras), 18))
    points = place.apply(centers.points_body)
    by_camera[np.arange(len(seen)), :, rows] = by_cameras(centers.rig.rows, points)
    return _CenterEquations(
        np.concatenate([off for _, off in seen]),
        by_pose.reshape(-1, 6),
        block_diag(*centers.noise),
        by_camera.reshape(2 * len(seen), -1),
    )


def _estimator(by_unknown: Floats, covariance: Floats) -> Floats:
    """What generalised least squares multiplies residuals (n,) with: (k, n)."""
    weighted = np.linalg.solve(covariance, by_unknown).T
    return np.linalg.solve(weighted @ by_unknown, weighted)
