"""Two runs compared: what differs is found, and by how many standard deviations."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.errors import RunError
from measure.metrology.poses import PoseTable
from measure.simulation import random_motion
from measure_lab import api as lab
from tests.metrology.recordings import Errors, poses_of, write_run
from tests.metrology.test_smoothing import MIDDLE, TIMES


@pytest.fixture
def poses(rng) -> PoseTable:
    return poses_of(random_motion(3, MIDDLE).at(TIMES), Errors(nearby=0.7), rng)


def moved(poses: PoseTable, by, rng: np.random.Generator) -> PoseTable:
    """The same poses moved by `by` (6,), with a little noise of their own."""
    noise = rng.normal(0, [0.003, 0.003, 0.003, 1e-5, 1e-5, 1e-5], (len(poses), 6))
    return PoseTable(poses.times_s, poses.world_from_body.perturb(by + noise), poses.covariances)


def figures(found) -> dict[str, tuple[float, float]]:
    return {figure.what: (figure.difference, figure.sds) for figure in found.figures}


def test_a_shift_between_two_settings_is_found_by_its_axis(poses, tmp_path, rng):
    shift = np.array([0.01, 0, 0, 0, 0, np.deg2rad(0.02)])
    one = write_run(tmp_path / "one", poses)
    other = write_run(
        tmp_path / "other", moved(poses, shift, rng), profile={"name": "paper", "tone": "linear"}
    )
    found = lab.compare(one, other)
    assert found.same_session
    assert found.paired == len(poses)
    told = figures(found)
    assert told["x_mm"][0] == pytest.approx(0.01, abs=0.002)
    assert told["turn_z_deg"][0] == pytest.approx(0.02, abs=0.002)
    assert min(told["x_mm"][1], told["turn_z_deg"][1]) > 10
    assert max(abs(told[name][1]) for name in ("y_mm", "z_mm", "turn_x_deg", "turn_y_deg")) < 4
    stated = {figure.what: figure.stated_sd for figure in found.figures}
    assert stated["x_mm"] == pytest.approx(0.02 * np.sqrt(2), rel=1e-6)
    assert found.settings["profile.tone"] == ("unset", "linear")
    assert not any("started" in key or "path" in key for key in found.settings)


def test_frame_sets_flagged_in_either_are_counted_and_left_out(poses, tmp_path):
    one = write_run(tmp_path / "one", poses, flagged=frozenset(range(10)))
    other = write_run(tmp_path / "other", poses, flagged=frozenset(range(5, 12)))
    found = lab.compare(one, other)
    assert found.paired == len(poses) - 12
    assert found.states == {"ok": (110, 113), "flagged": (10, 7)}
    assert all(figure.difference == 0 for figure in found.figures)


def test_two_sessions_are_compared_by_their_statistics(poses, tmp_path, rng, capsys):
    wide = PoseTable(poses.times_s, poses.world_from_body, 4 * poses.covariances)
    one = write_run(tmp_path / "one", poses)
    other = write_run(tmp_path / "other", wide, session_digest="e")
    assert main(["compare", str(one), str(other), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert not told["same_session"]
    assert told["paired"] == 0
    by_name = {figure["what"]: figure for figure in told["figures"]}
    assert "x_mm" not in by_name
    assert by_name["position_sd_mm"]["second"] == pytest.approx(
        2 * by_name["position_sd_mm"]["first"]
    )
    assert main(["compare", str(one), str(other)]) == 0
    assert len(capsys.readouterr().out.splitlines()) < 40


def test_a_run_without_poses_is_refused(poses, tmp_path: Path):
    one = write_run(tmp_path / "one", poses)
    none = write_run(tmp_path / "none", poses, flagged=frozenset(range(len(poses))))
    with pytest.raises(RunError, match="none holds no unflagged pose"):
        lab.compare(one, none)
