"""Cameras that are moved while a pipeline measures, by detectors that know the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.calibration.keeping import CameraKeeper
from measure.geometry import RigidTransform, chi_square_quantile, squared_mahalanobis
from measure.measuring import Pipeline, Stages
from measure.measuring.tracking.predictive import PredictiveTracker
from measure.measuring.tracking.settings import PredictiveConfig
from measure_plugins.pose_solvers.kabsch import KabschConfig, KabschSolver
from measure_plugins.triangulators.reprojection import ReprojectionConfig, ReprojectionTriangulator
from tests.scenes import FOUR, RAVEN, TARGET, ring, strayed
from tests.tracking_rig import Oracle, frame_sets

KNOCK_S, HZ = 1.0, 30.0
TURN = np.radians(2.0) * np.array([0.6, 0.7, 0.39])
STEP_MM = np.array([6.0, 8.0, 0.0])
POSE_SD = np.diag(np.repeat([0.3, 6e-4], 3) ** 2)


class MovedOracle(Oracle):
    """Sees through the camera as it stands at the time of each picture."""

    stands = None  # gives that, by time and the camera as it stood first

    def detect(self, image, expected):
        first = self.camera
        try:
            self.camera = self.stands(image.time_s, first)
            return super().detect(image, expected)
        finally:
            self.camera = first


def knocked(name="cam1", share=1.0):
    def stands(time_s, camera):
        if camera.name != name or time_s < KNOCK_S:
            return camera
        pose = camera.world_from_camera
        step = [*pose.rotate(share * STEP_MM), *pose.rotate(share * TURN)]
        return replace(camera, world_from_camera=pose.perturb(step))

    return stands


def path(time_s):
    """A smooth motion at up to 60 mm/s and 0.5 rad/s."""
    shift = 25 * np.array([np.sin(2.4 * time_s), np.cos(1.7 * time_s), np.sin(1.1 * time_s)])
    rotvec = 0.3 * np.array([np.sin(1.5 * time_s), np.cos(1.2 * time_s), np.sin(0.7 * time_s)])
    return RigidTransform.from_rotvec(rotvec, TARGET + shift)


def measured(
    stands,
    count=4,
    body=RAVEN,
    sets=90,
    keeps=True,
    known=None,
    at=path,
    hz=HZ,
    drifts=False,
    **oracle,
):
    """Measurements, the keeper, and where the cameras truly stand at last."""
    stated = ring(count, pose_covariance=known)
    true = stated if known is None else strayed(stated, np.random.default_rng(4))
    detectors = {
        name: MovedOracle(body, camera, lambda time_s: [(body, at(time_s))], **oracle)
        for name, camera in true.items()
    }
    for detector in detectors.values():
        detector.stands = stands
    cameras = list(stated.values())
    stages = Stages(
        detectors,
        PredictiveTracker(PredictiveConfig(), body, cameras),
        ReprojectionTriangulator(ReprojectionConfig()),
        KabschSolver(KabschConfig(), body),
        per_image_timestamps=True,
        smoothing=True,
        remeasure_after_search=True,
    )
    pipeline = Pipeline(body, cameras, stages)
    if keeps:
        pipeline.keeper = CameraKeeper(body, cameras, drifts=drifts)
    return (
        list(pipeline.measure(frame_sets(stated, sets, hz))),
        pipeline.keeper,
        {name: stands(sets / hz, camera) for name, camera in true.items()},
    )


def errors(found):
    return np.array(
        [m.pose.world_from_body.difference(path(m.pose.time_s)) for m in found if m.pose]
    )


@pytest.mark.parametrize(
    ("body", "count", "known", "share"),
    [(RAVEN, 4, None, 1.0), (RAVEN, 4, POSE_SD, 1.0), (FOUR, 3, None, 1.0), (RAVEN, 4, None, 0.2)],
    ids=["exact", "uncertain", "three cameras", "little"],
)
def test_it_is_back_within_seconds_with_an_honest_covariance(body, count, known, share):
    found, keeper, true = measured(knocked(share=share), count, body, known=known)
    away, back = keeper.rig(len(found)).changes
    assert away.camera == back.camera == "cam1"
    assert away.since_s == pytest.approx(KNOCK_S, abs=0.5 / HZ)
    assert back.frame_set < (KNOCK_S + 1.8) * HZ
    off = true["cam1"].world_from_camera.difference(back.world_from_camera)
    assert off @ np.linalg.solve(back.covariance, off) < 22.5  # 1 in 1000
    if known is not None:
        assert np.all(np.diag(back.covariance) > np.diag(known))
    left_out = found[away.frame_set : back.frame_set]
    assert left_out
    assert all("cam1" not in m.pose.cameras and m.status == "ok" for m in left_out)
    assert all("cam1" in m.pose.cameras and m.status == "ok" for m in found[back.frame_set + 3 :])
    e = np.linalg.norm(errors(found)[:, :3], axis=1)
    before, after = (np.sqrt(np.mean(p**2)) for p in (e[:30], e[back.frame_set :]))
    assert after < 1.5 * before


def healthy(time_s, camera):
    return camera


@pytest.mark.parametrize(
    "hide",
    [None, lambda ball, camera, time_s: camera == "cam1" and 0.5 < time_s < 1.5],
    ids=["all seen", "hidden from one camera for a second"],
)
def test_a_healthy_rig_is_measured_as_without_a_keeper(hide):
    (with_it, keeper, _), (without, _, _) = (
        measured(healthy, sets=60, keeps=keeps, hide=hide) for keeps in (True, False)
    )
    assert keeper.rig(60).changes == ()
    for one, other in zip(with_it, without, strict=True):
        assert np.array_equal(one.pose.world_from_body.matrix, other.pose.world_from_body.matrix)
        assert np.array_equal(one.pose.covariance, other.pose.covariance)
        assert (one.status, one.doubts, one.frames) == (other.status, other.doubts, other.frames)


def test_a_camera_stays_away_while_the_body_rests_or_the_camera_moves():
    """What one picture shows many poses explain; and a camera that sways has none."""
    _, keeper, _ = measured(knocked(), sets=75, at=lambda _: path(0.0))
    assert keeper.rig(75).changes == ()

    def swaying(time_s, camera):
        if camera.name != "cam1" or time_s < KNOCK_S:
            return camera
        pose, angle = camera.world_from_camera, np.radians(3 + 2 * np.sin(4 * time_s))
        return replace(
            camera, world_from_camera=pose.perturb([0, 0, 0, *pose.rotate([angle, angle, 0])])
        )

    found, keeper, _ = measured(swaying, sets=75)
    assert all(change.world_from_camera is None for change in keeper.rig(75).changes)
    assert not any("cam1" in m.pose.cameras for m in found[40:])


def test_a_camera_that_was_pushed_and_came_back_stands_where_it_stood():
    def pushed(time_s, camera):
        there = KNOCK_S <= time_s < KNOCK_S + 0.8
        return knocked()(KNOCK_S if there else 0.0, camera)

    found, keeper, true = measured(pushed, sets=105)
    *_, back = keeper.rig(105).changes
    stood = true["cam1"].world_from_camera
    assert np.abs(back.world_from_camera.difference(stood)).max() < 1e-9
    assert back.covariance is None
    assert "cam1" in found[-1].pose.cameras


@pytest.mark.parametrize("turn_deg", [0.2, 0.0])
def test_a_camera_that_drifts_is_followed_and_a_healthy_one_left_alone(turn_deg):
    """From 8 s on for 24 s: the poses after it are as good as those before, and as they state."""

    def sagging(time_s, camera):
        if camera.name != "cam1":
            return camera
        angle = np.radians(turn_deg) * np.clip((time_s - 8) / 24, 0, 1)
        turn = camera.world_from_camera.rotate(angle * TURN / np.linalg.norm(TURN))
        return replace(camera, world_from_camera=camera.world_from_camera.perturb([0, 0, 0, *turn]))

    found, keeper, true = measured(sagging, sets=400, hz=8.0, drifts=True)
    changes = keeper.rig(400).changes
    assert bool(changes) == bool(turn_deg)
    assert all(c.camera == "cam1" and c.world_from_camera is not None for c in changes)
    assert all("cam1" in m.pose.cameras and m.status == "ok" for m in found[300:])
    off = errors(found)
    before, after = (np.sqrt(np.mean(e[:, :3] ** 2)) for e in (off[:64], off[300:]))
    assert after < 1.5 * before
    known = np.stack([m.pose.covariance for m in found[300:]])
    squares = squared_mahalanobis(off[300:], known)
    assert np.mean(squares < chi_square_quantile(0.95, 6)) > 0.9
    for change in changes[-1:]:
        left = true["cam1"].world_from_camera.difference(change.world_from_camera)
        assert left @ np.linalg.solve(change.covariance, left) < 22.5
