from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.calibration import fit_rig
from measure.calibration.board_views import board_pose
from measure.calibration.extrinsics import fit_rig_with_boards
from measure.model import Intrinsics, MarkerObservation, Tolerances
from tests.calibration import rigs
from tests.studio import waved


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
    exact = rigs.rig(np.random.default_rng(0), 0.0, 0.0)
    for camera, true in zip(
        fit_rig(exact.start, exact.observations).cameras, exact.true, strict=True
    ):
        error = camera.world_from_camera.difference(true.world_from_camera)
        np.testing.assert_allclose(error, 0, atol=1e-6)


@pytest.mark.slow
def test_true_errors_lie_within_the_reported_covariances() -> None:
    of_cameras, of_body = rigs.squared_errors(fit_rig, 16, rigs.LENS_SD, rigs.poses())
    assert 0.75 < of_cameras < 1.3
    assert 0.5 < of_body < 1.7


def test_cameras_hold_the_cross_covariance_of_pose_and_lens() -> None:
    rigs.check_cross_covariance(fit_rig)


def test_standard_deviations_come_out_of_the_residuals() -> None:
    noisy = rigs.rig(np.random.default_rng(2), corner_sd_px=0.08, mark_sd_px=0.5)
    fit = fit_rig(noisy.start, noisy.observations)
    assert fit.corner_sd_px == pytest.approx(0.08, rel=0.1)
    assert fit.mark_sd_px == pytest.approx(0.5, rel=0.25)


def test_one_slip_of_the_hand_does_not_bend_the_rig() -> None:
    noisy = rigs.rig(np.random.default_rng(2))
    marks = dict(noisy.observations.marks)
    pixels = marks["cam0"].pixels.copy()
    pixels[3] += [40.0, -25.0]
    marks["cam0"] = MarkerObservation(marks["cam0"].ids, pixels)
    fit = fit_rig(noisy.start, replace(noisy.observations, marks=marks))
    assert rigs.cost_mm(fit.cameras, noisy.true) < 0.03
    assert np.argmax(np.linalg.norm(fit.mark_residuals["cam0"], axis=1)) == 3


def test_boards_that_were_not_held_exactly_lose_their_say() -> None:
    noisy, rng = rigs.rig(np.random.default_rng(3)), np.random.default_rng(4)
    boards = {}
    for name, board in noisy.observations.boards.items():
        slip = np.concatenate([rng.normal(0, 0.5, 3), rng.normal(0, 0.004, 3)])
        boards[name] = replace(board, world_from_board=board.world_from_board.perturb(slip))
    observations = replace(noisy.observations, boards=boards)
    fit, tolerances = fit_rig_with_boards(noisy.start, observations)
    assert 0.2 <= tolerances.board_mm <= 1.0
    assert rigs.cost_mm(fit.cameras, noisy.true) < 0.1
    assert rigs.cost_mm(fit_rig(noisy.start, observations).cameras, noisy.true) > 0.1


def test_exact_boards_keep_their_say() -> None:
    noisy = rigs.rig(np.random.default_rng(5))
    _, tolerances = fit_rig_with_boards(noisy.start, noisy.observations)
    assert tolerances.board_mm <= 0.05


def test_marker_tolerance_moves_markers_that_are_off() -> None:
    noisy = rigs.rig(np.random.default_rng(6), mark_sd_px=0.02, marker_mm=0.3)
    fit = fit_rig(noisy.start, replace(noisy.observations, tolerances=Tolerances(marker_mm=0.3)))
    moved = np.linalg.norm(
        fit.state.values["points"][: len(rigs.markers())] - rigs.markers(), axis=1
    )
    assert 0.2 < np.sqrt(np.mean(moved**2)) < 1.0
    assert fit.mark_sd_px < 0.1
