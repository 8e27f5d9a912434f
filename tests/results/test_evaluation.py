from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from measure.errors import RunError
from measure.geometry import RigidTransform
from measure.measuring import Measurement
from measure.model import Camera
from measure.results import Run, RunEvaluation, evaluate
from measure.results.evaluation import evaluation_tables
from measure.session import read_trajectory
from tests.results.conftest import CAMERAS, PERIOD_S, measurement, write_truth, written

COUNT = 60


def _run(folder: Path, make: Callable[[int], Measurement]) -> Run:
    return written(folder, map(make, range(COUNT)))


def _evaluate(folder: Path, make: Callable[[int], Measurement], **options: object) -> RunEvaluation:
    run = _run(folder / "run", make)
    truth = read_trajectory(write_truth(folder / "truth.csv", COUNT * PERIOD_S))
    return evaluate(run, truth, **options)  # type: ignore[arg-type]


def test_exact_measurements_have_no_error(tmp_path: Path) -> None:
    found = _evaluate(tmp_path, measurement)
    assert found.compared == COUNT
    # What is left is the truth's interpolation between samples at 240 Hz.
    assert found.body.max_3d_mm < 1e-5
    assert found.ball.max_3d_mm < 1e-4
    assert found.rotation.max_3d_deg < 1e-4
    assert found.rms_all_frames_mm == found.body.rms_3d_mm
    assert found.failure_rate == 0.0
    assert found.detection.pixels.max_2d_px < 1e-3


def test_rms_and_sd_are_those_of_the_table(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    errors = rng.normal(0, [0.3, 0.1, 0.05, 1e-3, 2e-3, 3e-3], (COUNT, 6))
    errors[:, 0] += 0.4
    found = _evaluate(tmp_path, lambda i: measurement(i, errors[i]))
    body, length = found.body, np.linalg.norm(errors[:, :3], axis=1)
    for k, axis in enumerate("xyz"):
        assert body.rms_mm[axis] == pytest.approx(np.sqrt(np.mean(errors[:, k] ** 2)), abs=1e-5)
        assert body.sd_mm[axis] == pytest.approx(np.std(errors[:, k]), abs=1e-5)
        assert body.rms_mm[axis] ** 2 == pytest.approx(
            body.mean_mm[axis] ** 2 + body.sd_mm[axis] ** 2, abs=1e-9
        )
    assert body.rms_3d_mm == pytest.approx(math.hypot(*body.rms_mm.values()), abs=1e-9)
    assert body.sd_3d_mm == pytest.approx(length.std(), abs=1e-5)
    assert body.max_3d_mm == pytest.approx(length.max(), abs=1e-5)
    angle = np.rad2deg(np.linalg.norm(errors[:, 3:], axis=1))
    assert found.rotation.rms_3d_deg == pytest.approx(np.sqrt(np.mean(angle**2)), rel=1e-4)


def test_missing_poses_are_counted_not_passed_over(tmp_path: Path) -> None:
    error = np.array([0.3, 0, 0, 0, 0, 0])
    found = _evaluate(tmp_path, lambda i: measurement(i, error, lost=i % 4 == 0))
    assert found.frame_sets == COUNT
    assert found.compared == 45
    assert found.without_pose == 15
    assert found.failure_rate == 0.25
    assert found.rms_all_frames_mm == float("inf")
    assert found.body.rms_3d_mm == pytest.approx(0.3, abs=1e-5)
    assert any("15 frame sets have no pose" in note for note in found.notes)


def test_a_run_without_any_pose(tmp_path: Path) -> None:
    found = _evaluate(tmp_path, lambda i: measurement(i, lost=True))
    assert (found.compared, found.without_pose, found.failure_rate) == (0, COUNT, 1.0)
    assert found.body is None
    assert found.rms_all_frames_mm == float("inf")


def test_flagged_poses_are_told_apart(tmp_path: Path) -> None:
    import dataclasses

    from measure.measuring import Status

    def make(i: int) -> Measurement:
        bad = i % 3 == 0
        made = measurement(i, np.array([5.0 if bad else 0.1, 0, 0, 0, 0, 0]))
        return dataclasses.replace(made, status=Status.FLAGGED) if bad else made

    found = _evaluate(tmp_path, make)
    assert found.body_ok.count == 40
    assert found.body_ok.max_3d_mm == pytest.approx(0.1, abs=1e-4)
    assert found.body.max_3d_mm == pytest.approx(5.0, abs=1e-4)
    assert any("20 poses are flagged" in note for note in found.notes)


def test_honest_covariances_cover_and_proud_ones_do_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(0, 1, (6, 6)) * np.array([0.1] * 3 + [1e-3] * 3)[:, None]
    covariance = root @ root.T
    errors = rng.normal(0, 1, (COUNT, 6)) @ root.T
    honest = _evaluate(tmp_path / "a", lambda i: measurement(i, errors[i], covariance))
    proud = _evaluate(tmp_path / "b", lambda i: measurement(i, errors[i], covariance / 9))
    for kind in ("position_consistency", "pose_consistency"):
        fair, over = getattr(honest, kind), getattr(proud, kind)
        assert fair.count == COUNT
        assert fair.inside_95 > 0.85
        assert 0.75 < fair.normalised_squared_error < 1.3
        assert over.inside_95 < 0.6
        assert over.normalised_squared_error == pytest.approx(
            9 * fair.normalised_squared_error, rel=1e-6
        )


def test_a_moved_world_is_an_absolute_error_but_no_relative_one(tmp_path: Path) -> None:
    world = RigidTransform.from_rotvec([0.01, -0.02, 0.005], [2.0, 1.0, -1.0])

    def make(i: int) -> Measurement:
        exact = measurement(i)
        moved = world @ exact.pose.world_from_body
        return measurement(i, moved.difference(exact.pose.world_from_body))

    found = _evaluate(tmp_path, make)
    assert found.body.rms_3d_mm > 2.0
    assert found.aligned.body.max_3d_mm < 1e-4
    assert found.aligned.rotation.max_3d_deg < 1e-4
    assert found.aligned.turn_deg == pytest.approx(np.rad2deg(np.linalg.norm([0.01, 0.02, 0.005])))


def test_detection_alone_in_px_and_mm(tmp_path: Path) -> None:
    shift = np.array([0.3, -0.4])
    found = _evaluate(tmp_path, lambda i: measurement(i, pixel_error=shift))
    assert found.body.max_3d_mm < 1e-4  # the poses themselves are exact
    alone = found.detection
    assert alone.pixels.count == COUNT * 9
    assert alone.pixels.rms_2d_px == pytest.approx(0.5, abs=1e-3)
    assert alone.pixels.mean_px["u"] == pytest.approx(0.3, abs=1e-3)
    # About half a pixel at 580 mm and f = 1400 px.
    assert 0.1 < alone.ball.rms_3d_mm < 0.35
    assert 0.1 < alone.body.rms_3d_mm < 0.35
    assert found.localisation is None


def _moved(camera: Camera) -> Camera:
    if camera.name != "cam1":
        return camera
    pose = camera.world_from_camera.perturb([0.5, 0, 0, 0, 0, np.deg2rad(0.1)])
    return Camera(camera.name, camera.intrinsics, pose)


def test_localisation_alone(tmp_path: Path) -> None:
    """The run believes the unmoved cameras; in truth one stands elsewhere."""
    found = _evaluate(tmp_path, measurement, true_cameras=[_moved(c) for c in CAMERAS])
    alone = found.localisation
    assert alone.body is not None
    assert 0.2 < alone.ball.rms_3d_mm < 1.5
    same = _evaluate(tmp_path / "same", measurement, true_cameras=CAMERAS).localisation
    assert same.ball.max_3d_mm < 1e-6
    with pytest.raises(RunError, match="the true cameras lack 'cam0'"):
        _evaluate(tmp_path / "lack", measurement, true_cameras=CAMERAS[1:])


def test_quaternions_in_another_order_are_doubted(tmp_path: Path) -> None:
    run = _run(tmp_path / "run", measurement)
    path = write_truth(tmp_path / "truth.csv", COUNT * PERIOD_S)
    assert not [n for n in evaluate(run, read_trajectory(path)).notes if "rotations" in n]
    _change(path, lambda row: [*row[:4], *row[5:], row[4]])
    (note,) = [n for n in evaluate(run, read_trajectory(path)).notes if "rotations" in n]
    assert "quaternions in the order of their headings" in note


def _change(path: Path, column: Callable[[list[float]], list[float]]) -> None:
    head, *rows = path.read_text().splitlines()
    changed = [column([float(v) for v in row.split(",")]) for row in rows]
    path.write_text("\n".join([head, *(",".join(f"{v:.12f}" for v in r) for r in changed)]) + "\n")


def test_a_wrong_truth_is_refused(tmp_path: Path) -> None:
    run = _run(tmp_path / "run", lambda i: measurement(i, np.array([0.1, 0, 0, 0, 0, 0])))
    path = tmp_path / "truth.csv"
    write_truth(path, COUNT * PERIOD_S)
    evaluate(run, read_trajectory(path))
    _change(path, lambda r: [r[0] + 1000, *r[1:]])
    with pytest.raises(RunError, match=r"at no time together with .*run \(0\.000 to 1\.967 s\)"):
        evaluate(run, read_trajectory(path))
    write_truth(path, COUNT * PERIOD_S)
    _change(path, lambda r: [r[0], *(v / 1000 for v in r[1:4]), *r[4:]])
    with pytest.raises(RunError, match="the truth must be in mm"):
        evaluate(run, read_trajectory(path))
    write_truth(path, COUNT * PERIOD_S)
    _change(path, lambda r: [r[0], *(v + 100 for v in r[1:4]), *r[4:]])
    found = evaluate(run, read_trajectory(path))
    assert any("is this the truth of this session?" in note for note in found.notes)


@pytest.mark.parametrize(
    ("axes", "cure"),
    [
        ([1, -2, 3], "its y axis points the other way: negate y, qx and qz"),
        ([1, 3, 2], "take its x, z, y for x, y, z"),
    ],
)
def test_a_left_handed_truth_is_named_and_compared_as_it_stands(
    tmp_path: Path, axes: list[int], cure: str
) -> None:
    run = _run(tmp_path / "run", measurement)
    path = write_truth(tmp_path / "truth.csv", COUNT * PERIOD_S)
    assert not [n for n in evaluate(run, read_trajectory(path)).notes if "left-handed" in n]

    def mirror(row: list[float]) -> list[float]:
        place = [math.copysign(1, k) * row[abs(k)] for k in axes]
        turn = [-math.copysign(1, k) * row[4 + abs(k)] for k in axes]
        return [row[0], *place, row[4], *turn]

    _change(path, mirror)
    found = evaluate(run, read_trajectory(path))
    (note,) = [n for n in found.notes if "left-handed" in n]
    assert cure in note
    assert found.body.median_3d_mm > 1
    with pytest.raises(RunError, match=f"left-handed.*{cure}"):
        evaluate(run, read_trajectory(path), find_offset=True)


def test_a_run_between_two_rows_of_the_truth_is_no_comparison(tmp_path: Path) -> None:
    run = _run(tmp_path / "run", measurement)
    path = write_truth(tmp_path / "truth.csv", COUNT * PERIOD_S)
    _change(path, lambda r: [300 * r[0] - 1, 10 * r[1], *r[2:]])
    with pytest.raises(RunError, match=r"lies between \d rows of .* are 1.25 s apart: that is no"):
        evaluate(run, read_trajectory(path))
    _change(path, lambda r: [r[0], 20.0, 30.0, 200.0, 1.0, 0.0, 0.0, 0.0])  # a body that rests
    assert evaluate(run, read_trajectory(path)).compared == COUNT


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1.0, "alike"), (3.0, "3 times: on the safe side"), (0.5, "0.5 times: too small")],
)
def test_stated_deviations_against_errors_are_put_in_words(
    tmp_path: Path, factor: float, words: str
) -> None:
    rng = np.random.default_rng(2)
    sd = np.sqrt(np.diag(measurement(0).pose.covariance))
    errors = rng.normal(size=(COUNT, 6))
    errors *= sd / factor / np.sqrt(np.mean(errors[:, :3] ** 2))
    found = _evaluate(tmp_path, lambda i: measurement(i, errors[i]))
    (table,) = [t for t in evaluation_tables(found) if t.title.startswith("Do the reported")]
    (row,) = [r for r in table.rows if r[0] == "body position"]
    assert row[-1] == words


def test_frames_beyond_the_truth_are_left_out_and_counted(tmp_path: Path) -> None:
    run = _run(tmp_path / "run", measurement)
    truth = read_trajectory(write_truth(tmp_path / "truth.csv", 1.0))
    found = evaluate(run, truth)
    assert found.compared + found.outside_truth == COUNT
    assert 25 < found.outside_truth < 32
    assert found.body.max_3d_mm < 1e-4
