"""The tip of a turned tool: as exact as stated, refused where the motion cannot show it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, chi_square_quantile
from measure.metrology.poses import PoseTable, SharedErrors
from measure.session import read_body
from measure_lab.lengths import find_spin_axis, find_tip
from tests.metrology.recordings import Errors, pivoting, poses_of, write_run
from tests.results.conftest import BODY

TIP, POINT = np.array([5.0, -8, -150]), np.array([30.0, 20, 100])
EXACT = SharedErrors((), BODY)
DRAWS = 100


@pytest.mark.parametrize("errors", [Errors(), Errors(nearby=0.5), Errors(everywhere=0.9)], ids=str)
def test_the_tip_is_inside_its_region(errors, rng):
    truth, inside, off = pivoting(TIP, POINT, 40.0), 0, []
    for _ in range(DRAWS):
        found = find_tip(poses_of(truth, errors, rng), EXACT)
        error = found.tip_mm - TIP
        square = error @ np.linalg.solve(found.tip_covariance, error)
        inside += square <= chi_square_quantile(0.95, 3)
        off.append(error)
    assert inside >= 93
    # No bias: rotations that are noisy as well do not draw the tip towards the balls.
    assert np.linalg.norm(np.mean(off, axis=0)) < 4 * np.std(off) / np.sqrt(DRAWS)


def test_a_long_recording_with_independent_errors_gives_two_hundredths(rng):
    truth = pivoting(TIP, POINT, 40.0, 600)
    off = [find_tip(poses_of(truth, Errors(), rng), EXACT).tip_mm - TIP for _ in range(8)]
    assert np.sqrt(np.mean(np.sum(np.square(off), axis=1))) < 0.03


def test_too_little_turning_is_refused_in_degrees(rng):
    with pytest.raises(
        DegenerateGeometryError, match=r"turned by 1\d deg .* 1[5-9] deg are needed"
    ):
        find_tip(poses_of(pivoting(TIP, POINT, 8.0), Errors(), rng), EXACT)


def test_turning_about_one_axis_alone_is_refused(rng):
    turns = np.zeros((120, 3))
    turns[:, 0] = np.deg2rad(30) * np.sin(np.arange(120) / 9)
    R = RigidTransform.from_rotvec(turns).rotation
    with pytest.raises(DegenerateGeometryError, match="narrowest direction"):
        find_tip(poses_of(RigidTransform(R, POINT - R @ TIP), Errors(), rng), EXACT)


def test_poses_beside_the_pivoting_are_left_out_and_a_wandering_tip_is_refused(rng):
    poses = poses_of(pivoting(TIP, POINT, 40.0), Errors(), rng)
    place = poses.world_from_body
    lifted = place.translation + np.where(np.arange(120) > 100, 1.0, 0.0)[:, None] * [0, 0, 30.0]
    moved = RigidTransform(place.rotation, lifted)
    found = find_tip(PoseTable(poses.times_s, moved, poses.covariances), EXACT)
    assert found.left_out >= 19
    assert np.linalg.norm(found.tip_mm - TIP) < 0.3
    slid = place.translation + 20 * np.sin(np.arange(120) / 5)[:, None] * [1.0, 0.5, 0]
    with pytest.raises(DegenerateGeometryError, match=r"stays? where it is"):
        find_tip(
            PoseTable(poses.times_s, RigidTransform(place.rotation, slid), poses.covariances), EXACT
        )


def test_a_slipping_tip_widens_its_uncertainty(rng):
    poses = poses_of(pivoting(TIP, POINT, 40.0), Errors(), rng)
    slid = poses.world_from_body.translation + rng.normal(0, 0.3, (120, 3))
    slipping = RigidTransform(poses.world_from_body.rotation, slid)
    steady = find_tip(poses, EXACT)
    found = find_tip(PoseTable(poses.times_s, slipping, poses.covariances), EXACT)
    assert found.normalised > 4 > 2 > steady.normalised
    assert found.tip_sd_mm > 1.5 * steady.tip_sd_mm


def test_the_spin_axis(rng):
    axis = np.array([0.1, 0.05, 1.0]) / np.linalg.norm([0.1, 0.05, 1.0])
    turns = axis * np.deg2rad(60) * np.sin(np.arange(100) / 12)[:, None]
    truth = RigidTransform.from_rotvec(turns, np.broadcast_to(POINT, (100, 3)))
    squares = []
    for _ in range(30):
        found = find_spin_axis(poses_of(truth, Errors(), rng), EXACT, TIP)
        off = np.degrees(np.linalg.norm(np.cross(found.direction, axis)))
        squares.append((off / found.sd_deg) ** 2)
    assert found.turned_deg == pytest.approx(120, abs=1)
    assert found.sd_deg < 0.1
    assert np.mean(squares) < 1.5
    with pytest.raises(DegenerateGeometryError, match="about one axis"):
        find_spin_axis(poses_of(pivoting(TIP, POINT, 40.0), Errors(), rng), EXACT, TIP)


def test_the_command_writes_a_body_with_its_origin_at_the_tip(tmp_path: Path, rng, capsys):
    run = write_run(tmp_path / "run", poses_of(pivoting(TIP, POINT, 40.0), Errors(), rng))
    turns = np.array([0, 0, 1.0]) * np.sin(np.arange(60) / 8)[:, None]
    truth = RigidTransform.from_rotvec(turns, np.broadcast_to(POINT, (60, 3)))
    spin = write_run(tmp_path / "spin", poses_of(truth, Errors(), rng))
    out = tmp_path / "tool.toml"
    assert main(["pivot", str(run), "-o", str(out), "--spin", str(spin), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert np.allclose(told["tip_mm"], TIP, atol=0.3)
    assert told["tip_sd_mm"] < 0.2
    body = read_body(out)
    assert body.distances() == pytest.approx(BODY.distances())
    assert body.middle[2] == pytest.approx(BODY.middle[2] - TIP[2], abs=0.3)
    still = write_run(tmp_path / "still", poses_of(truth, Errors(), rng))
    assert main(["pivot", str(still)]) == 2
    assert "deg are needed" in capsys.readouterr().err
