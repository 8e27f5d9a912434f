"""Smoothing and velocities as a choice of the export, with covariances that hold."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from measure.cli import main
from measure.geometry import RigidTransform
from measure.metrology.noise import smooth_motion
from measure.metrology.poses import PoseTable, SharedErrors
from measure.simulation import random_motion
from tests.metrology.recordings import Errors, poses_of, write_run
from tests.results.conftest import BODY

EXACT = SharedErrors((), BODY)
TIMES = np.arange(120) / 30
MIDDLE = RigidTransform(np.eye(3), np.array([0.0, 0, 200]))


def judged(errors: Errors, seconds: float, rng: np.random.Generator):
    """Normalised squares of pose and velocity, and RMS errors raw, smooth and of the velocity."""
    path, step = random_motion(int(rng.integers(1000)), MIDDLE), 1e-4
    truth = path.at(TIMES)
    speed = path.at(TIMES + step).difference(path.at(TIMES - step)) / (2 * step)
    poses = poses_of(truth, errors, rng)
    found = smooth_motion(poses, EXACT, seconds)
    here = np.isfinite(found.velocities[:, 0])
    off = found.poses.world_from_body.difference(truth)[here]
    fast = (found.velocities - speed)[here]
    squares = [
        np.mean(np.sum(e * np.linalg.solve(P, e[..., None])[..., 0], axis=1)) / 6
        for e, P in ((off, found.poses.covariances[here]), (fast, found.covariances[here]))
    ]
    raw = poses.world_from_body.difference(truth)[here]
    return np.array([*squares, *(np.sqrt(np.mean(e[:, :3] ** 2)) for e in (raw, off, fast))])


@pytest.mark.parametrize(("errors", "seconds"), [(Errors(), 1.0), (Errors(nearby=0.7), 0.2)])
def test_covariances_hold_also_where_a_cubic_is_not_the_motion(errors, seconds, rng):
    pose, velocity, raw, smooth, _ = np.mean([judged(errors, seconds, rng) for _ in range(3)], 0)
    assert 0.2 < pose < 1.4
    assert 0.2 < velocity < 1.4
    if seconds < 1.0:
        assert smooth < (0.6 if errors.nearby == 0 else 1.0) * raw


def test_a_longer_window_gives_steadier_velocities(rng):
    fast = [judged(Errors(), seconds, rng)[4] for seconds in (0.12, 0.4)]
    assert fast[1] < 0.4 * fast[0]


def test_windows_reach_over_no_pause(rng):
    poses = poses_of(random_motion(3, MIDDLE).at(TIMES), Errors(), rng)
    late = PoseTable(
        np.where(TIMES < 2, TIMES, TIMES + 100), poses.world_from_body, poses.covariances
    )
    found = smooth_motion(late, EXACT, 0.3)
    alone = smooth_motion(late.take(slice(0, 60)), EXACT, 0.3)
    assert np.isnan(found.velocities[[0, 59, 60, -1]]).all()
    assert np.allclose(found.velocities[5:55], alone.velocities[5:55])


@pytest.fixture
def run(tmp_path: Path, rng) -> Path:
    poses = poses_of(random_motion(3, MIDDLE).at(TIMES), Errors(), rng)
    return write_run(tmp_path / "run", poses, flagged=frozenset({50}))


def rows_of(run: Path, *options: str) -> list[dict[str, str]]:
    out = run.parent / "out.csv"
    command = ["export", str(run), "-f", "csv", "-o", str(out), "--overwrite", *options]
    assert main(command) == 0
    with out.open() as file:
        return list(csv.DictReader(file))


def test_raw_is_the_default_and_flagged_poses_stay_raw(run):
    raw, smooth = rows_of(run), rows_of(run, "--smooth", "0.3", "--velocity")
    assert "vx_mm_s" not in raw[0]
    assert raw[50] == {name: smooth[50][name] for name in raw[50]}
    assert smooth[50]["vx_mm_s"] == smooth[0]["vx_mm_s"] == ""
    assert float(smooth[60]["position_sd_mm"]) < 0.7 * float(raw[60]["position_sd_mm"])
    speed = random_motion(3, MIDDLE)
    true = speed.at(TIMES[60] + 1e-4).difference(speed.at(TIMES[60] - 1e-4)) / 2e-4
    for name, expected in zip(("vx_mm_s", "vz_mm_s", "wy_rad_s"), true[[0, 2, 4]], strict=True):
        sd = float(smooth[60][f"cov_{name}_{name}"]) ** 0.5
        assert float(smooth[60][name]) == pytest.approx(expected, abs=4 * sd)


def test_velocities_without_smoothing_leave_the_poses(run):
    raw, moving = rows_of(run), rows_of(run, "--velocity")
    assert all(a.items() <= b.items() for a, b in zip(raw, moving, strict=True))
    assert moving[60]["wz_rad_s"]


def test_mcap_holds_velocities_in_metres(run, tmp_path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    out = tmp_path / "x.mcap"
    assert main(["export", str(run), "-f", "mcap", "-o", str(out), "--velocity"]) == 0
    with out.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        sent = [m for *_, m in reader.iter_decoded_messages(topics=["/body/twist"])]
    row = rows_of(run, "--velocity")[60]
    assert any(
        m.twist.twist.linear.x == pytest.approx(float(row["vx_mm_s"]) / 1000)
        and m.twist.covariance[0] == pytest.approx(float(row["cov_vx_mm_s_vx_mm_s"]) / 1e6)
        for m in sent
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-f", "tum", "--velocity"], "tum has no place for --velocity"),
        (["-f", "trc", "--smooth", "0.1"], "trc holds balls as located: --smooth is for csv"),
        (["-f", "csv", "--smooth", "-1"], "--smooth -1: give the seconds"),
    ],
)
def test_what_cannot_be_is_refused(options, message, run, capsys):
    assert main(["export", str(run), *options]) == 2
    assert message in capsys.readouterr().err
