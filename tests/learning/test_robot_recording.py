"""A simulated robot's reported, measured and corrected positions, read back from the recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measurements import BODY, CAMERAS, measurement
from rerun.chunk import RrdReader

from measure.cli import main
from measure.errors import ConfigError, EstimatorError
from measure.geometry import RigidTransform
from measure.results import Provenance, RunWriter
from measure.viewing import entities
from measure_learning import api as learning_api
from measure_learning.api.correcting import _nearest
from measure_learning.core.simulated import recording
from measure_learning.recording import KINDS
from measure_learning.robots import write_log
from measure_learning.simulator import simulate
from tests.viewing.reading import column, read_recording

SECONDS, FRAME_HZ, OFFSET_S = 20.0, 15.0, 1.5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose body is the simulated robot's tip, and the robot's log."""
    folder = tmp_path_factory.mktemp("robot")
    run = simulate(SECONDS, 7000, log_hz=50.0)
    track, log = recording(run, "r", 5, frame_hz=FRAME_HZ, clock_offset_s=OFFSET_S)
    write_log(folder / "robot.parquet", log)
    made = Provenance("/nowhere", "a", "calibration.toml", "b", "c", {"name": "precise"}, {})
    with RunWriter(folder / "run", made, [BODY], CAMERAS) as writer:
        for index, (time_s, place) in enumerate(
            zip(track.times_s, track.positions_mm, strict=True)
        ):
            one = measurement(index)
            pose = replace(
                one.pose, time_s=time_s, world_from_body=RigidTransform(np.eye(3), place)
            )
            writer.append(replace(one, time_s=time_s, pose=pose))
        writer.finish()
    return folder


def test_nearest_frame_set_to_a_state_is_found() -> None:
    random = np.random.default_rng(3)
    times, at = np.sort(random.uniform(0, 10, 50)), random.uniform(-1, 11, 300)
    at[0], at[1] = (times[3] + times[4]) / 2, times[7]
    naive = np.abs(times[None, :] - at[:, None]).argmin(axis=1)
    assert np.array_equal(times[_nearest(times, at)], times[naive])
    assert _nearest(times[:1], at).tolist() == [0] * 300
    # All differences between these would take 160 GB.
    assert _nearest(np.arange(20_000.0), np.arange(1_000_000.0) / 50).max() == 19_999


@pytest.fixture(scope="module")
def stored(folder: Path):
    path = learning_api.robot_recording(
        folder / "run", "raven", folder / "robot.parquet", learning_api.shipped_model()
    )
    return read_recording(path)


def _trace(stored, entity):
    values = column(stored[entity], "Scalars:scalars")
    return np.array([value[0] for value in values.values()])


def test_all_three_ways_and_their_coordinates_are_there(stored):
    for kind in KINDS:
        points = column(stored[entities.robot(kind)], "Points3D:positions")
        for number, axis in enumerate("xyz"):
            trace = _trace(stored, entities.robot_position(axis, kind))
            drawn = [p[0][number] for p in points.values() if p]
            assert trace[np.isfinite(trace)] == pytest.approx(drawn, abs=1e-3)
            assert len(drawn) > 0.9 * SECONDS * FRAME_HZ
    for entity in (entities.CORRECTED_SD, entities.UNFAMILIAR, entities.robot_error("reported")):
        names = {name for batch in stored[entity] for name in batch.schema.names}
        assert {entities.TIMELINE_FRAME, entities.TIMELINE_TIME} <= names


def test_correction_brings_reported_nearer_to_measured(stored):
    reported = _trace(stored, entities.robot_error("reported"))
    corrected = _trace(stored, entities.robot_error("corrected"))
    both = np.isfinite(reported) & np.isfinite(corrected)
    assert both.sum() > 0.9 * SECONDS * FRAME_HZ
    rms = [np.sqrt(np.mean(values[both] ** 2)) for values in (reported, corrected)]
    assert rms[1] < 0.6 * rms[0]


def test_a_model_of_a_pair_corrects_as_well(folder: Path, tmp_path: Path):
    log, model, out = folder / "robot.parquet", tmp_path / "pair.onnx", tmp_path / "out.csv"
    data = ["dataset", "--simulate-min", "2", "--restarts", "3", "-o", str(tmp_path / "d.parquet")]
    pair = ["--estimator", "ridge after kinematic", "--folds", "0", "-o", str(model)]
    assert main(data) == 0
    assert main(["train", str(tmp_path / "d.parquet"), *pair]) == 0
    assert main(["estimate", str(model), "--input", str(log), "-o", str(out)]) == 0
    path = learning_api.robot_recording(folder / "run", "raven", log, model)
    drawn = column(read_recording(path)[entities.robot("corrected")], "Points3D:positions")
    places = np.array([p[0] for p in drawn.values() if p])
    heads = out.read_text().partition("\n")[0].replace('"', "").split(",")
    tip = [heads.index(f"{axis}_mm") for axis in "xyz"]
    every = np.loadtxt(out, delimiter=",", skiprows=1, usecols=tip)
    assert len(places) > 0.9 * SECONDS * FRAME_HZ
    # Each correction is one of the log's, at a position between two of its states.
    assert np.median(np.linalg.norm(places[:, None] - every, axis=2).min(axis=1)) < 0.5


def test_the_times_are_the_cameras(stored, folder: Path):
    poses = (folder / "run" / "poses.csv").read_text().splitlines()[1:]
    by_frame = {int(line.split(",")[0]): float(line.split(",")[1]) for line in poses}
    for batch in stored[entities.UNFAMILIAR]:
        if "frame" not in batch.schema.names:
            continue
        times = np.asarray(batch["time"].to_numpy(zero_copy_only=False)).astype("int64") * 1e-9
        expected = [by_frame[frame] for frame in batch["frame"].to_pylist()]
        assert times == pytest.approx(expected, abs=1e-3)


def test_the_layout_is_the_estimators_own(stored, folder: Path):
    reader = RrdReader(folder / "run" / "robot.rrd")
    (layout,) = reader.blueprints()
    assert layout.application_id == "triball robot"


def test_without_a_model_nothing_is_corrected(folder: Path):
    path = learning_api.robot_recording(folder / "run", "raven", folder / "robot.parquet")
    assert np.isnan(_trace(read_recording(path), entities.robot_error("corrected"))).all()


def test_a_given_clock_offset_counts_and_the_shipped_model_has_a_name(folder: Path):
    log, model = folder / "robot.parquet", Path("shipped")
    path = learning_api.robot_recording(
        folder / "run", "raven", log, model, clock_offset_s=OFFSET_S
    )
    corrected = _trace(read_recording(path), entities.robot_error("corrected"))
    assert np.isfinite(corrected).mean() > 0.9
    with pytest.raises(EstimatorError, match=r"a clock that is -2\d\d\.\d ms off"):
        learning_api.robot_recording(folder / "run", "raven", log, clock_offset_s=OFFSET_S + 0.3)


def test_a_missing_log_is_said(folder: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(ConfigError, match="names no robot log"):
        learning_api.robot_recording(folder / "run", "raven")
    assert main(["view", str(folder / "run"), "--model", "m.onnx"]) == 2
    assert "--robot raven" in capsys.readouterr().err
