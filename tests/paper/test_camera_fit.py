"""Equation 3, on rigs whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.calibration import fit_rig
from measure_paper.camera_fit import MARK_SD_PX, fit_rig_by_paper
from tests.calibration import rigs


def test_exact_marks_give_the_exact_rig() -> None:
    exact = rigs.rig(np.random.default_rng(0), 0.3, 0.0)
    found = fit_rig_by_paper(exact.start, exact.observations).cameras
    for camera, true in zip(found, exact.true, strict=True):
        error = camera.world_from_camera.difference(true.world_from_camera)
        np.testing.assert_allclose(error, 0, atol=1e-6)


def test_true_errors_lie_within_the_covariances() -> None:
    """Lenses, marks and marker places are all off; leaving one out makes these ten and more."""
    of_cameras, of_body = rigs.squared_errors(
        fit_rig_by_paper, 40, 3 * rigs.LENS_SD, rigs.poses()[:4]
    )
    assert 0.75 < of_cameras < 1.3
    assert 0.6 < of_body < 1.5


def test_cameras_hold_the_cross_covariance_of_pose_and_lens() -> None:
    rigs.check_cross_covariance(fit_rig_by_paper)


def test_three_marks_say_nothing_about_their_own_error() -> None:
    noisy = rigs.rig(np.random.default_rng(1))
    marks = {
        name: replace(sight, ids=sight.ids[[0, 3, 8]], pixels=sight.pixels[[0, 3, 8]])
        for name, sight in noisy.observations.marks.items()
    }
    fit = fit_rig_by_paper(noisy.start, replace(noisy.observations, marks=marks))
    assert fit.mark_sd_px == MARK_SD_PX
    for camera in fit.cameras:
        assert np.sqrt(np.trace(camera.pose_covariance[:3, :3])) > 0.1


def test_the_joint_fit_beats_it_on_the_same_noise() -> None:
    joint, paper = [], []
    for seed in range(6):
        noisy = rigs.rig(np.random.default_rng(seed), lens_sd=rigs.LENS_SD / 4)
        joint.append(rigs.cost_mm(fit_rig(noisy.start, noisy.observations).cameras, noisy.true))
        paper.append(
            rigs.cost_mm(fit_rig_by_paper(noisy.start, noisy.observations).cameras, noisy.true)
        )
    assert np.sqrt(np.mean(np.square(joint)) / np.mean(np.square(paper))) < 0.7
