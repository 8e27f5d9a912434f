"""Which pose of the arm would tell most of base and tool: a choice of an optimal design."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.geometry.covariance import posterior_covariance
from measure.metrology.poses import PoseTable
from measure_learning.core.frame_fit import FRAMES, FrameFit, LinearModel, Sightings, precision

_CANDIDATES = 3000
_FARTHER = 0.25  # share of a joint's range by which it may go beyond it
_LEAST_FARTHER_RAD, _LEAST_FARTHER_MM = float(np.deg2rad(15.0)), 20.0
_ROOM = 0.15  # share of the tip's ranges by which it may leave them: the cameras see no farther
_LEAST_ROOM_MM = 50.0
_MOST_TURN_RAD = float(np.deg2rad(20.0))  # beyond the turns seen: the balls must stay in sight


def next_pose(fit: FrameFit, seen: Sightings) -> dict[str, Any] | None:
    """The joints (deg and mm) of the pose that would help most, and by how much; None if unknown.

    Of poses near those that the cameras have seen; the one that makes the product of the variances
    of base and tool smallest, links being as uncertain as they are.
    """
    if seen.chain is None:
        return None
    joints = _candidates(seen)
    if not len(joints):
        return None
    C = posterior_covariance(fit.normal, precision(seen, fit.link_sd))
    near = LinearModel.of(fit, _at(joints, fit, seen))
    H, R = near.slopes, near.covariances * fit.noise
    CH = C @ np.swapaxes(H, 1, 2)
    gains = np.swapaxes(np.linalg.solve(H @ CH + R, np.swapaxes(CH, 1, 2)), 1, 2)
    less = np.einsum("npm,npm->np", gains, CH)[:, :FRAMES]
    before = np.diag(C)[:FRAMES]
    after = np.maximum(before - less, 0.0).reshape(-1, 4, 3).sum(axis=2)
    whole = before.reshape(4, 3).sum(axis=1)
    best = int(np.argmin(np.sum(np.log(after / whole), axis=1)))
    ratio = np.sqrt(after[best] / whole)
    scale = [1.0 if joint.prismatic else float(np.degrees(1.0)) for joint in seen.chain.joints]
    return {
        "joints": np.round(joints[best] * scale, 1),
        "units": ["mm" if joint.prismatic else "deg" for joint in seen.chain.joints],
        "base_sd_ratio": float(min(ratio[:2])),
        "tool_sd_ratio": float(min(ratio[2:])),
    }


def _candidates(seen: Sightings) -> Floats:
    """Joints (k, joints) a little beyond those seen, with the tool about where it was seen."""
    assert seen.chain is not None
    low, high = seen.joints.min(axis=0), seen.joints.max(axis=0)
    slides = np.array([joint.prismatic for joint in seen.chain.joints])
    least = np.where(slides, _LEAST_FARTHER_MM, _LEAST_FARTHER_RAD)
    farther = np.maximum(_FARTHER * (high - low), least)
    rng = np.random.default_rng(0)
    joints = rng.uniform(low - farther, high + farther, (_CANDIDATES, len(low)))
    poses, known = seen.chain.pose(joints), seen.chain.pose(seen.joints)
    near, far = known.translation.min(axis=0), known.translation.max(axis=0)
    room = np.maximum(_ROOM * (far - near), _LEAST_ROOM_MM)
    inside = ((poses.translation > near - room) & (poses.translation < far + room)).all(axis=1)
    u, _, v = np.linalg.svd(known.rotation.sum(axis=0))
    middle = u * [1.0, 1.0, np.sign(np.linalg.det(u @ v))] @ v
    turned = _angles(middle, known.rotation).max() + _MOST_TURN_RAD
    return np.asarray(joints[inside & (_angles(middle, poses.rotation) < turned)])


def _angles(middle: Floats, rotations: Floats) -> Floats:
    return np.linalg.norm(RigidTransform(middle.T @ rotations, np.zeros(3)).rotvec, axis=1)


def _at(joints: Floats, fit: FrameFit, seen: Sightings) -> Sightings:
    """Sightings at these joints: where the model puts the body, as sure as the others are."""
    assert seen.chain is not None
    n = len(joints)
    places = seen.chain.pose(joints)
    poses = fit.world_from_base @ places @ fit.body_from_flange.inverse()
    P = np.broadcast_to(np.median(seen.poses.covariances, axis=0), (n, 6, 6))
    return replace(
        seen,
        poses=PoseTable(np.zeros(n), poses, P),
        recording=np.zeros(n, dtype=np.int64),
        reported_mm=places.translation,
        joints=joints,
        rates=np.zeros_like(joints),
    )
