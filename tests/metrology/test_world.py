"""A calibration in a world of the user's: an exact change of coordinates, covariances with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure import api
from measure.cli import main
from measure.errors import CalibrationError, ConfigError, RunError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.model import Detection
from measure.results import read_run
from measure.results.pose_table import poses_of as poses_in
from measure.session import Calibration, read_calibration, write_calibration
from tests.metrology.recordings import Errors, poses_of, with_rests, write_run
from tests.results.conftest import BODY, CAMERAS

PLACES = np.array([[10.0, 0, 20], [60, 5, 20], [15, 50, 25]])


@pytest.fixture
def uncertain(rng):
    """Cameras with covariances that differ by axis, and are correlated with the lens."""
    root = rng.normal(0, [[0.1]] * 3 + [[1e-4]] * 3, (6, 6))
    lens = np.diag([4.0, 4, 1, 1, *[1e-4] * 4, *[0.0] * 4])
    cross = 0.05 * root @ rng.normal(size=(6, 12)) * np.sqrt(np.diag(lens))
    return tuple(
        replace(
            c,
            intrinsics=replace(c.intrinsics, covariance=lens),
            pose_covariance=root @ root.T + np.diag([0.01] * 3 + [1e-8] * 3),
            pose_intrinsics_covariance=cross,
        )
        for c in CAMERAS
    )


@pytest.fixture
def made(tmp_path: Path, rng, uncertain) -> tuple[Path, Path]:
    truth = with_rests(PLACES)
    turned = RigidTransform.from_rotvec([0.3, -0.2, 0.7]) @ truth
    run = write_run(tmp_path / "run", poses_of(turned, Errors(nearby=0.8), rng), BODY, uncertain)
    joint = rng.normal(size=(42, 42))
    file = tmp_path / "calibration.toml"
    write_calibration(file, Calibration(uncertain, {"joint_covariance": joint @ joint.T}))
    return run, file


def seen_by(cameras, pose):
    return [
        Detection(ball, camera.name, 0.0, pixel, 60.0, np.eye(2))
        for camera in cameras
        for ball, pixel in zip(BODY.names, camera.project(pose.apply(BODY.centers)), strict=True)
    ]


def test_poses_of_the_same_pictures_are_the_old_ones_seen_from_the_new_world(made, tmp_path):
    run, file = made
    out = tmp_path / "new.toml"
    assert main(["world", str(file), "--run", str(run), "--at", "1.2", "-o", str(out)]) == 0
    cameras = read_calibration(out).cameras
    old = poses_in(read_run(run))
    at = old.world_from_body[36]
    for k in (0, 36, 60):
        pose = old.world_from_body[k]
        seen = PoseObservations.of(seen_by(CAMERAS, pose), BODY, {c.name: c for c in cameras}, 0.0)
        found = fit_pose(at.inverse() @ pose, seen).world_from_body
        assert np.allclose(found.difference(at.inverse() @ pose), 0, atol=1e-6)
        if k == 36:
            assert np.allclose(found.matrix, np.eye(4), atol=1e-6)


def test_covariances_turn_with_the_world(made, tmp_path, uncertain, rng):
    """Draws of the old cameras, moved one by one, scatter as the new file states."""
    found, place = api.world(made[1], made[0], rest=1)
    back = place.transform.inverse()
    for old, new in zip(uncertain, found.cameras, strict=True):
        draws = rng.multivariate_normal(np.zeros(18), old.covariance, 4000, check_valid="ignore")
        moved = back @ old.world_from_camera.perturb(draws[:, :6])
        off = np.column_stack([moved.difference(new.world_from_camera), draws[:, 6:]])
        scale = np.sqrt(np.diag(new.covariance)) + 1e-12
        differ = (np.cov(off.T) - new.covariance) / np.outer(scale, scale)
        assert np.abs(differ).max() < 0.12
    before = np.array(read_calibration(made[1]).provenance["joint_covariance"])
    after = np.array(found.provenance["joint_covariance"])
    assert np.linalg.eigvalsh(after) == pytest.approx(
        np.linalg.eigvalsh(before), rel=1e-6, abs=1e-6
    )
    turn = back.rotation
    assert np.allclose(after[14:17, 14:17], turn @ before[14:17, 14:17] @ turn.T)
    assert np.allclose(after[6:14, 6:14], before[6:14, 6:14])


def test_three_touched_points_make_a_frame(made):
    found, place = api.world(made[1], made[0], points=(0, 1, 2))
    rests = api.rests(made[0])
    touched = np.stack([rest.world_from_body.translation for rest in rests.rests])
    seen = place.transform.inverse().apply(touched)
    assert np.allclose(seen[0], 0, atol=1e-9)
    assert np.allclose(seen[1, 1:], 0, atol=1e-9)
    assert seen[1, 0] > 0 < seen[2, 1]
    assert seen[2, 2] == pytest.approx(0, abs=1e-9)
    assert 0.005 < np.sqrt(place.covariance[0, 0]) < 0.5
    assert len(found.cameras) == len(CAMERAS)
    with pytest.raises(RunError, match="on one line"):
        api.world(made[1], made[0], points=(0, 1, 0))


def test_mistakes_are_told(made, tmp_path, capsys):
    run, file = made
    with pytest.raises(ConfigError, match="give one"):
        api.world(file, run, 1.0, 1)
    with pytest.raises(RunError, match="there are 3 rests, 0 to 2"):
        api.world(file, run, rest=3)
    with pytest.raises(RunError, match=r"no unflagged pose at 99.000 s: it spans 0.000 to"):
        api.world(file, run, 99.0)
    other = tmp_path / "other.toml"
    write_calibration(
        other,
        Calibration(
            tuple(
                replace(c, world_from_camera=c.world_from_camera.perturb([1.0, 0, 0, 0, 0, 0]))
                for c in CAMERAS
            )
        ),
    )
    with pytest.raises(CalibrationError, match="another calibration"):
        api.world(other, run)
    own = tmp_path / "notes.toml"
    own.write_text("mine = 1\n")
    assert main(["world", str(file), "--run", str(run), "-o", str(own)]) == 2
    assert own.read_text() == "mine = 1\n"
    assert "no calibration" in capsys.readouterr().err
