"""Rests are found by the poses' own noise, and their covariances hold."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.errors import RunError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.metrology.poses import PoseTable, SharedErrors
from measure.metrology.rests import find_rests
from measure.model import Detection
from measure.results import RunWriter
from measure_lab import api
from tests.metrology.recordings import Errors, measured, poses_of, with_rests, write_run
from tests.results.conftest import BODY, CAMERAS, made_from

PLACES = np.array([[0.0, 0, 200], [60, 0, 200], [60.4, 0, 200], [-40, 30, 230]])
EXACT = SharedErrors((), BODY)


def rested(errors: Errors, rng: np.random.Generator, rest_s: float = 1.0):
    return find_rests(poses_of(with_rests(PLACES, rest_s), errors, rng), EXACT)


@pytest.mark.parametrize("errors", [Errors(), Errors(nearby=0.5), Errors(nearby=0.95)], ids=str)
def test_each_place_is_found_once_for_as_long_as_it_lasted(errors, rng):
    found = rested(errors, rng)
    assert len(found) == len(PLACES)
    for rest, place, start_s in zip(found.rests, PLACES, 1.4 * np.arange(4), strict=True):
        assert rest.start_s == pytest.approx(start_s - 0.05, abs=0.15)
        assert rest.end_s - rest.start_s == pytest.approx(1.0, abs=0.25)
        assert np.linalg.norm(rest.world_from_body.translation - place) < 0.15


@pytest.mark.parametrize("errors", [Errors(nearby=0.5), Errors(nearby=0.9)], ids=str)
def test_covariances_hold_of_all_rests_together(errors, rng):
    """Over draws of the errors the squared Mahalanobis distance is as large as its dimension."""
    squares, lengths = [], []
    for _ in range(15):
        found = rested(errors, rng, 0.8)
        pairs = zip(found.rests, PLACES, strict=True)
        off = np.concatenate(
            [r.world_from_body.difference(RigidTransform(np.eye(3), place)) for r, place in pairs]
        )
        squares.append(off @ np.linalg.solve(found.covariance, off) / len(off))
        moved = found.displacement(0, 3)
        true = np.linalg.norm(PLACES[3] - PLACES[0])
        lengths.append((moved.distance_mm - true) / moved.distance_sd_mm)
    assert 0.75 < np.mean(squares) < 1.3
    assert 0.6 < np.std(lengths) < 1.4


def test_more_poses_help_against_noise_and_not_against_what_is_alike(rng):
    def sd(errors: Errors, rest_s: float) -> float:
        found = rested(errors, rng, rest_s)
        return float(np.sqrt(np.trace(found.block(0, 0)[:3, :3])))

    assert sd(Errors(), 4.0) < 0.6 * np.sqrt(np.trace(np.diag([0.02, 0.02, 0.03]) ** 2))
    assert sd(Errors(nearby=0.95), 4.0) > 0.9 * sd(Errors(nearby=0.95), 1.0)


def test_what_neighbours_have_in_common_cancels_between_them(rng):
    found = rested(Errors(nearby=0.95), rng)
    near, far = found.displacement(1, 2), found.displacement(0, 3)
    assert near.distance_mm == pytest.approx(0.4, abs=0.03)
    assert near.distance_sd_mm < 0.3 * far.distance_sd_mm


def test_errors_of_cameras_are_shared_as_they_move_the_fitted_poses(rng):
    """Poses of places fitted with cameras that are off: their errors together fit the factors."""
    pose_covariance = np.diag([0.1] * 3 + [np.deg2rad(0.02)] * 3) ** 2
    exact = [replace(c, pose_covariance=pose_covariance) for c in CAMERAS]
    truth = RigidTransform.from_rotvec(rng.normal(0, 0.3, (3, 3)), PLACES[[0, 1, 3]] - [0, 0, 200])
    shared = SharedErrors(exact, BODY)
    wide = np.broadcast_to(np.diag([1e3] * 3 + [1.0] * 3), (3, 6, 6))
    factors = shared.factors(PoseTable(np.arange(3.0), truth, wide)).reshape(18, -1)
    moved_by = rng.multivariate_normal(np.zeros(6), pose_covariance, (40, len(exact)))
    squares, lengths = [], []
    stated = factors @ factors.T + 1e-10 * np.eye(18)
    for by in moved_by:
        off = [
            replace(c, world_from_camera=c.world_from_camera.perturb(d))
            for c, d in zip(exact, by, strict=True)
        ]
        errors = np.concatenate(
            [_refitted(truth[k], exact, off).difference(truth[k]) for k in range(3)]
        )
        squares.append(errors @ np.linalg.solve(stated, errors) / 18)
        lengths.append(errors[6:9] - errors[:3])
    assert 0.8 < np.mean(squares) < 1.2
    change = np.concatenate([-np.eye(3), np.zeros((3, 3)), np.eye(3)], axis=1)
    variance = np.trace(change @ stated[:9, :9] @ change.T) / 3
    assert np.mean(np.square(lengths)) == pytest.approx(variance, rel=0.4)


def _refitted(pose, exact, off):
    """The pose that least squares finds with cameras that are `off` from what `exact` ones see."""
    seen = [
        Detection(ball, camera.name, 0.0, pixel, 60.0, np.eye(2))
        for camera in exact
        for ball, pixel in zip(BODY.names, camera.project(pose.apply(BODY.centers)), strict=True)
    ]
    cameras = {camera.name: camera for camera in off}
    return fit_pose(pose, PoseObservations.of(seen, BODY, cameras, 0.0)).world_from_body


def test_a_body_that_never_rests_has_none_and_it_is_said_why(rng):
    t = np.arange(200)[:, None] / 30
    truth = RigidTransform(np.broadcast_to(np.eye(3), (200, 3, 3)), [40.0, 30, 200] * np.sin(t))
    found = find_rests(poses_of(truth, Errors(), rng), EXACT)
    assert not found.rests
    assert "never stands still" in found.listed()


def test_a_creeping_body_is_not_one_rest(rng):
    path = np.linspace([0, 0, 200], [3.0, 0, 200], 300)
    truth = RigidTransform(np.broadcast_to(np.eye(3), (300, 3, 3)), path)
    found = find_rests(poses_of(truth, Errors(nearby=0.9), rng), EXACT)
    assert not any(rest.end_s - rest.start_s > 3.0 for rest in found.rests)


def test_the_command_lists_rests_and_leaves_out_flagged_poses(tmp_path: Path, rng, capsys):
    poses = poses_of(with_rests(PLACES), Errors(nearby=0.5), rng)
    run = write_run(tmp_path / "run", poses, flagged=frozenset(range(36, 80)))
    assert main(["rests", str(run), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [rest["rest"] for rest in told["rests"]] == [0, 1, 2]
    first = next(d for d in told["displacements"] if (d["from"], d["to"]) == (0, 1))
    assert first["distance_mm"] == pytest.approx(60.4, abs=0.2)
    assert main(["rests", str(run), "--from", "1"]) == 0
    assert "from 1" in capsys.readouterr().out
    assert main(["rests", str(run), "--from", "7"]) == 2
    assert "there are 3 rests, 0 to 2" in capsys.readouterr().err
    assert main(["rests", str(run), "--shortest-s", "-1"]) == 2
    assert "--shortest-s -1" in capsys.readouterr().err
    with pytest.raises(RunError):
        api.rests(tmp_path / "none")


def test_of_several_bodies_one_is_named(tmp_path: Path, rng, capsys):
    twin = replace(BODY, name="twin")
    poses = poses_of(with_rests(PLACES), Errors(nearby=0.5), rng)
    away = RigidTransform.from_rotvec([0, 0, 0], [0, 0, 300]) @ poses.world_from_body
    with RunWriter(tmp_path / "run", made_from(), [BODY, twin], CAMERAS) as writer:
        for k in range(len(poses)):
            writer.append(
                *(
                    measured(k, float(poses.times_s[k]), place[k], poses.covariances[k], BODY.names)
                    for place in (poses.world_from_body, away)
                )
            )
        writer.finish()
    assert main(["rests", str(tmp_path / "run")]) == 2
    assert "choose one with --body" in capsys.readouterr().err
    assert main(["rests", str(tmp_path / "run"), "--body", "twin", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["rests"][0]["translation_mm"][2] == pytest.approx(500, abs=0.2)
