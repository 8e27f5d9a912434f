from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.errors import body_cost
from measure.calibration import Tolerances, fit_rig, fit_rig_by_paper
from measure.calibration.board_views import board_pose
from measure.calibration.extrinsics import START_MARK_SD_PX, fit_rig_with_boards
from measure.calibration.rig_problem import MarkerObservation
from measure.estimation.expected_accuracy import body_pose_sd
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, paper_body
from tests.calibration.rigs import markers, rig
from tests.studio import waved

LENS_SD = np.array([0.4, 0.4, 0.4, 0.4])
TARGET = np.array([0.0, 0.0, 250.0])


def poses() -> list[RigidTransform]:
    rng = np.random.default_rng(0)
    return [
        RigidTransform.from_rotvec(rng.uniform(-0.6, 0.6, 3), TARGET + rng.uniform(-40, 40, 3))
        for _ in range(10)
    ]


def cost_mm(estimated: tuple[Camera, ...], true: tuple[Camera, ...]) -> float:
    shifts = body_cost(estimated, true, paper_body(), poses())
    return float(np.sqrt(np.mean(np.sum(shifts**2, axis=1))))


def test_four_marks_have_one_pose_whatever_the_lens() -> None:
    """A lens that is not known well must not put the camera elsewhere."""
    rng, camera = np.random.default_rng(0), waved.rig()[0]
    points = np.array([[127, 127, 63], [-127, -127, 0], [127, -127, 63], [0, 127, 0.0]])
    seen, lens = camera.project(points), camera.intrinsics
    for _ in range(100):
        matrix, distortion = lens.matrix + np.diag([*rng.normal(0, 3, 2), 0]), np.zeros(5)
        distortion[0], matrix[:2, 2] = rng.normal(0, 0.02), matrix[:2, 2] + rng.normal(0, 3, 2)
        pose = board_pose(Intrinsics(lens.size_wh, matrix, distortion), points, seen)
        assert np.linalg.norm(pose.inverse().translation - camera.center) < 30


def test_exact_sights_give_the_exact_rig() -> None:
    exact = rig(np.random.default_rng(0), 0.0, 0.0)
    for camera, true in zip(
        fit_rig(exact.start, exact.observations).cameras, exact.true, strict=True
    ):
        error = camera.world_from_camera.difference(true.world_from_camera)
        np.testing.assert_allclose(error, 0, atol=1e-6)


def test_exact_marks_give_the_exact_rig_by_the_paper() -> None:
    exact = rig(np.random.default_rng(0), 0.3, 0.0)
    found = fit_rig_by_paper(exact.start, exact.observations).cameras
    for camera, true in zip(found, exact.true, strict=True):
        error = camera.world_from_camera.difference(true.world_from_camera)
        np.testing.assert_allclose(error, 0, atol=1e-6)


@pytest.mark.slow
def test_true_errors_lie_within_the_reported_covariances() -> None:
    of_cameras, of_body = [], []
    for seed in range(16):
        noisy = rig(np.random.default_rng(seed), marker_mm=0.1, lens_sd=LENS_SD)
        fit = fit_rig(noisy.start, noisy.observations)
        for camera, true in zip(fit.cameras, noisy.true, strict=True):
            error = true.world_from_camera.difference(camera.world_from_camera)
            assert camera.pose_covariance is not None
            of_cameras.append(error @ np.linalg.solve(camera.pose_covariance, error) / 6)
        shift = body_cost(fit.cameras, noisy.true, paper_body(), poses())
        sd, _ = body_pose_sd(fit.cameras, paper_body(), poses(), fit.covariance, fit.columns)
        of_body.append(np.mean(np.sum(shift**2, axis=1) / sd**2))
    assert 0.75 < np.mean(of_cameras) < 1.3
    assert 0.5 < np.mean(of_body) < 1.7


def test_true_errors_lie_within_the_papers_covariances() -> None:
    """Lenses, marks and marker places are all off; leaving one out makes these ten and more."""
    of_cameras, of_body = [], []
    for seed in range(40):
        noisy = rig(np.random.default_rng(seed), marker_mm=0.1, lens_sd=3 * LENS_SD)
        fit = fit_rig_by_paper(noisy.start, noisy.observations)
        for camera, true in zip(fit.cameras, noisy.true, strict=True):
            error = true.world_from_camera.difference(camera.world_from_camera)
            assert camera.pose_covariance is not None
            of_cameras.append(error @ np.linalg.solve(camera.pose_covariance, error) / 6)
        shift = body_cost(fit.cameras, noisy.true, paper_body(), poses()[:4])
        sd, _ = body_pose_sd(fit.cameras, paper_body(), poses()[:4], fit.covariance, fit.columns)
        of_body.append(np.mean(np.sum(shift**2, axis=1) / sd**2))
    assert 0.75 < np.mean(of_cameras) < 1.3
    assert 0.6 < np.mean(of_body) < 1.5


@pytest.mark.parametrize("fitted", [fit_rig, fit_rig_by_paper])
def test_cameras_hold_the_cross_covariance_of_pose_and_lens(fitted) -> None:
    """Each camera by itself says nearly what all say together; pose and lens apart, far more."""
    noisy = rig(np.random.default_rng(3), lens_sd=LENS_SD)
    fit = fitted(noisy.start, noisy.observations)
    together, _ = body_pose_sd(fit.cameras, paper_body(), poses(), fit.covariance, fit.columns)
    single, _ = body_pose_sd(fit.cameras, paper_body(), poses())
    assert np.all((single / together > 0.5) & (single / together < 1.5))
    apart = tuple(replace(camera, pose_intrinsics_covariance=None) for camera in fit.cameras)
    assert np.all(body_pose_sd(apart, paper_body(), poses())[0] > 3 * together)


def test_three_marks_say_nothing_about_their_own_error() -> None:
    noisy = rig(np.random.default_rng(1))
    marks = {
        name: replace(sight, ids=sight.ids[[0, 3, 8]], pixels=sight.pixels[[0, 3, 8]])
        for name, sight in noisy.observations.marks.items()
    }
    fit = fit_rig_by_paper(noisy.start, replace(noisy.observations, marks=marks))
    assert fit.mark_sd_px == START_MARK_SD_PX
    for camera in fit.cameras:
        assert np.sqrt(np.trace(camera.pose_covariance[:3, :3])) > 0.1


def test_joint_beats_the_paper_on_the_same_noise() -> None:
    joint, paper = [], []
    for seed in range(6):
        noisy = rig(np.random.default_rng(seed), lens_sd=LENS_SD / 4)
        joint.append(cost_mm(fit_rig(noisy.start, noisy.observations).cameras, noisy.true))
        paper.append(cost_mm(fit_rig_by_paper(noisy.start, noisy.observations).cameras, noisy.true))
    assert np.sqrt(np.mean(np.square(joint)) / np.mean(np.square(paper))) < 0.7


def test_standard_deviations_come_out_of_the_residuals() -> None:
    noisy = rig(np.random.default_rng(2), corner_sd_px=0.08, mark_sd_px=0.5)
    fit = fit_rig(noisy.start, noisy.observations)
    assert fit.corner_sd_px == pytest.approx(0.08, rel=0.1)
    assert fit.mark_sd_px == pytest.approx(0.5, rel=0.25)


def test_one_slip_of_the_hand_does_not_bend_the_rig() -> None:
    noisy = rig(np.random.default_rng(2))
    marks = dict(noisy.observations.marks)
    pixels = marks["cam0"].pixels.copy()
    pixels[3] += [40.0, -25.0]
    marks["cam0"] = MarkerObservation(marks["cam0"].ids, pixels)
    fit = fit_rig(noisy.start, replace(noisy.observations, marks=marks))
    assert cost_mm(fit.cameras, noisy.true) < 0.03
    assert np.argmax(np.linalg.norm(fit.mark_residuals["cam0"], axis=1)) == 3


def test_boards_that_were_not_held_exactly_lose_their_say() -> None:
    noisy, rng = rig(np.random.default_rng(3)), np.random.default_rng(4)
    boards = {}
    for name, board in noisy.observations.boards.items():
        slip = np.concatenate([rng.normal(0, 0.5, 3), rng.normal(0, 0.004, 3)])
        boards[name] = replace(board, world_from_board=board.world_from_board.perturb(slip))
    observations = replace(noisy.observations, boards=boards)
    fit, tolerances = fit_rig_with_boards(noisy.start, observations)
    assert 0.2 <= tolerances.board_mm <= 1.0
    assert cost_mm(fit.cameras, noisy.true) < 0.1
    assert cost_mm(fit_rig(noisy.start, observations).cameras, noisy.true) > 0.1


def test_exact_boards_keep_their_say() -> None:
    noisy = rig(np.random.default_rng(5))
    _, tolerances = fit_rig_with_boards(noisy.start, noisy.observations)
    assert tolerances.board_mm <= 0.05


def test_marker_tolerance_moves_markers_that_are_off() -> None:
    noisy = rig(np.random.default_rng(6), mark_sd_px=0.02, marker_mm=0.3)
    fit = fit_rig(noisy.start, replace(noisy.observations, tolerances=Tolerances(marker_mm=0.3)))
    moved = np.linalg.norm(fit.state.markers - markers(), axis=1)
    assert 0.2 < np.sqrt(np.mean(moved**2)) < 1.0
    assert fit.mark_sd_px < 0.1
