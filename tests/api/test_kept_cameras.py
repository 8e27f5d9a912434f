"""Cameras that are moved while a body is measured: left out, and brought back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from measure import api
from measure.api import RunOptions
from measure.checking import Finding
from measure.cli import main
from measure.host import Registry
from measure.results import Run, read_run
from measure.session import read_calibration, read_trajectory
from tests.simulated.knocked import TURN_DEG, knocked_session

SETS, SINCE, HZ = 48, 12, 15.0
pytestmark = pytest.mark.slow
ALL = ("cam0", "cam1", "cam2", "cam3")
QUIET = ("--no-recording", "--images", "none")


@pytest.fixture(scope="module")
def knocked(renders: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of four cameras of which one is turned by 2 deg at .8 s."""
    folder = tmp_path_factory.mktemp("knocked") / "session"
    return knocked_session(renders / "still", folder, SETS, SINCE, ALL, HZ)


@pytest.fixture(scope="module")
def followed(knocked: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its run."""
    out = tmp_path_factory.mktemp("followed") / "run"
    assert main(["run", str(knocked), "--out", str(out), *QUIET]) == 0
    return out


def errors(run: Run, session: Path) -> np.ndarray:
    """Measured less true poses (n, 6), in the pose's chart."""
    assert run.has_pose.all()
    truth = read_trajectory(session / "truth.csv")
    return run.world_from_body.difference(truth.at(run.times_s))


def used(run: Run, camera: str) -> np.ndarray:
    return np.array([camera in names for names in run.poses["cameras"].to_pylist()])


def test_a_knocked_camera_comes_back(followed, knocked):
    run, calibrated = read_run(followed), read_calibration(knocked / "calibration.toml")
    left_out, back = run.camera_changes
    assert (left_out.camera, back.camera) == ("cam1", "cam1")
    assert left_out.world_from_camera is None
    assert left_out.since_s == pytest.approx(SINCE / HZ, abs=0.5 / HZ)
    assert back.frame_set <= SINCE + 3 * HZ
    away = slice(SINCE, back.frame_set)
    seen, status = used(run, "cam1"), np.array(run.poses["status"].to_pylist())
    assert seen[:SINCE].all()
    assert not seen[away].any()
    assert seen[back.frame_set + 3 :].all()  # good for some frame sets first
    assert np.mean(status[away] == "ok") > 0.9
    assert np.mean(status[back.frame_set :] == "ok") > 0.9
    off = errors(run, knocked)
    before, after = (
        np.sqrt(np.mean(np.sum(part[:, :3] ** 2, axis=1)))
        for part in (off[:SINCE], off[back.frame_set :])
    )
    assert after < 1.5 * before
    squares = np.einsum("ni,ni->n", off, np.linalg.solve(run.covariances, off[:, :, None])[..., 0])
    # The covariance says as much as before: of this recording it says too little in all of it.
    assert np.mean(squares[SINCE:]) < 1.2 * np.mean(squares[:SINCE])
    stood = calibrated.camera("cam1").world_from_camera
    turn = (stood.inverse() @ back.world_from_camera).rotvec
    step = back.world_from_camera.difference(stood)[:3]
    sds = np.sqrt(np.diag(back.covariance))
    assert np.linalg.norm(np.degrees(turn) - TURN_DEG) < 3 * np.degrees(np.linalg.norm(sds[3:]))
    assert np.linalg.norm(step) < 3 * np.linalg.norm(sds[:3])  # it was turned about its centre


def test_summary_and_report_say_from_when_to_when(followed, capsys):
    run = read_run(followed)
    (said,) = [f for f in run.summary.findings if f.code == "moved-at"]
    assert (said.level, said.subject) == ("note", "cam1")
    assert said.estimate == pytest.approx(2.0, abs=3 * said.sd)
    assert said.since_s == pytest.approx(SINCE / HZ, abs=0.5 / HZ)
    assert "left out until" in said.text
    assert not [f for f in run.summary.findings if f.level == "wrong" and "cam1" in f.text]
    assert main(["report", str(followed)]) == 0
    page = (followed / "report.html").read_text("utf-8")
    assert all(part in page for part in ("Cameras that were moved", "Where cameras stood"))


def test_a_run_that_is_resumed_knows_where_its_cameras_stand(followed, knocked, tmp_path):
    """It was ended after the camera came back."""
    whole = read_run(followed)
    kept = (whole.camera_changes[1].frame_set + SETS) // 2
    out, registry = tmp_path / "run", Registry.discover()

    def killed(done: int, _: int | None) -> None:
        if done == kept:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        api.run(knocked, out, api.load_profile(), registry, RunOptions(recording=False), killed)
    options = RunOptions(recording=False, resume=True)
    api.run(knocked, out, api.load_profile(), registry, options)
    again = read_run(out)
    assert [c.frame_set for c in again.camera_changes] == [
        c.frame_set for c in whole.camera_changes
    ]
    apart = again.world_from_body.difference(whole.world_from_body)
    assert np.median(np.linalg.norm(apart[kept:, :3], axis=1)) < 0.03  # a third of their SD


def moved(session: Path, out: Path, keep: str) -> tuple[Run, list[Finding]]:
    """What a run with this choice says of the camera that was moved; it is left out then."""
    assert main(["run", str(session), "--out", str(out), "--keep-calibration", keep, *QUIET]) == 0
    run = read_run(out)
    assert not used(run, "cam1")[SINCE:].any()
    return run, [f for f in run.summary.findings if f.code == "moved-at" and f.subject == "cam1"]


def test_a_camera_is_only_named_where_it_is_not_to_be_followed(knocked, tmp_path):
    run, (said,) = moved(knocked, tmp_path / "run", "warn")
    assert [c.world_from_camera for c in run.camera_changes] == [None]
    assert said.level == "wrong"
    assert "--keep-calibration follow" in said.remedy


def test_who_asks_for_nothing_is_told_of_no_change(renders, tmp_path):
    session = knocked_session(renders / "still", tmp_path / "s", 24, SINCE, ALL, HZ)
    run, said = moved(session, tmp_path / "run", "off")
    assert run.camera_changes == ()
    assert not any("follow" in f.remedy for f in said)


def test_two_cameras_are_not_followed(renders, tmp_path, capsys):
    session = knocked_session(renders / "still", tmp_path / "s", 24, SINCE, ("cam0", "cam1"), HZ)
    tables = []
    for more in ([], ["--keep-calibration", "follow"]):
        out = tmp_path / f"run{len(more)}"
        assert main(["run", str(session), "--out", str(out), *QUIET, *more]) == 0
        tables.append((out / "poses.csv").read_bytes())
    told = capsys.readouterr().out
    assert told.count("of two that disagree nobody can tell which was moved") == 1
    assert tables[0] == tables[1]


def test_a_healthy_recording_is_measured_as_ever(renders, tmp_path):
    """Of the noisy one, with other things of the balls' colours."""
    tables: list[list[pa.Table]] = []
    for keep in ("follow", "off"):
        options = RunOptions(recording=False, keep_calibration=keep)
        out, registry = tmp_path / keep, Registry.discover()
        api.run(renders / "clutter", out, api.load_profile(), registry, options)
        run = read_run(out)
        assert run.camera_changes == ()
        tables.append([run.poses, run.balls, run.detections])
    for one, other in zip(*tables, strict=True):
        assert one.equals(other)
