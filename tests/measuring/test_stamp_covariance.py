"""Errors of the stamps of moving bodies are in the covariance of their poses."""

from __future__ import annotations

import numpy as np

from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.measuring.measurement import FrameSetObservations
from measure.model import BallView, Motion, Pose
from measure.model.observations import State
from tests.scenes import RAVEN, TARGET, ring, see

CAMERAS = ring()
VELOCITY = np.array([150.0, -80.0, 60.0, 0.5, 0.8, -0.6])
SDS_S = {"cam1": 0.004, "cam3": 0.002}
START = RigidTransform.from_rotvec([0.2, 0.1, -0.3], TARGET)


def observed(errors_s, rng=None):
    """What cameras see whose stamps say 0, taken that much later."""
    seen = []
    for name, camera in CAMERAS.items():
        pose = START.perturb(VELOCITY * errors_s.get(name, 0.0))
        seen += see({name: camera}, RAVEN, pose, 0.1, rng)
    return seen


def test_the_covariance_is_the_scatter_of_poses():
    rng = np.random.default_rng(4)
    off = []
    for _ in range(300):
        seen = observed({name: rng.normal(scale=sd) for name, sd in SDS_S.items()})
        rows = PoseObservations.of(seen, RAVEN, CAMERAS, 0.0, 0.3)
        fit = fit_pose(START, rows, VELOCITY, 1e3)
        off.append(fit.world_from_body.difference(START))
    views = [BallView(d.ball, d.camera, State.EFFECTIVE, detection=d) for d in observed({})]
    pose = Pose(0.0, START, np.eye(6), 0.0, 0.0, tuple(CAMERAS), ())
    motion = Motion(START, 0.0, VELOCITY)
    known = FrameSetObservations.of(views, 0.0, RAVEN, CAMERAS, SDS_S)
    stated = known.stamp_covariance(pose, motion)
    scatter = np.cov(np.array(off).T)
    for part in (slice(0, 3), slice(3, 6)):
        ratio = np.trace(scatter[part, part]) / np.trace(stated[part, part])
        assert 0.75 < ratio < 1.3
    assert (
        FrameSetObservations.of(views, 0.0, RAVEN, CAMERAS).stamp_covariance(pose, motion) is None
    )
