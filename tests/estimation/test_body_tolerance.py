"""A body whose balls sit a little beside their places: its poses say so, and are not doubted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.checking import expected_accuracy
from measure.checking.body import LocatedBalls, check_body
from measure.estimation.body_layout import layout_flags
from measure.estimation.expected_accuracy import tolerance_covariance, tolerance_sd
from measure.geometry import RigidTransform, align_points
from measure.session import read_body, write_body
from tests.measurements import measurement
from tests.scenes import FOUR, RAVEN, ring
from tests.tracking_rig import run

POSE = RigidTransform.from_rotvec([0.3, -0.5, 1.1], [10.0, -20.0, 250.0])
SD_MM = 0.2


@pytest.mark.parametrize("body", [RAVEN, FOUR])
def test_tolerance_covariance_is_the_scatter_of_poses(body) -> None:
    stated = tolerance_covariance(replace(body, tolerance_mm=SD_MM), POSE, body.names)
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(4000):
        shifted = body.centers + rng.normal(0, SD_MM, body.centers.shape)
        found = align_points(POSE.apply(shifted), body.centers)
        errors.append(POSE.difference(found))
    scatter = np.cov(np.array(errors).T)
    sharp = np.linalg.inv(np.linalg.cholesky(stated))
    assert np.allclose(sharp @ scatter @ sharp.T, np.eye(6), atol=0.12)


def test_rotation_about_the_line_of_two_balls_gets_zero() -> None:
    body = replace(RAVEN, tolerance_mm=SD_MM)
    share = tolerance_covariance(body, POSE, ("green", "red"))
    line = POSE.rotation @ [1.0, 0.0, 0.0]
    assert line @ share[3:, 3:] @ line == pytest.approx(0, abs=1e-12)
    across = POSE.rotation @ [0.0, 0.0, 1.0]
    assert across @ share[3:, 3:] @ across == pytest.approx(SD_MM**2 / (2 * 38**2))


def test_an_exact_body_adds_nothing() -> None:
    one = measurement(0)
    assert one.with_tolerance(RAVEN) is one
    assert tolerance_sd(RAVEN, POSE) == (0.0, 0.0)


def test_distances_within_tolerance_are_not_flagged() -> None:
    shifts = np.array([[0.6, 0, 0], [0, 0, 0], [-0.6, 0, 0]])
    centers, own = RAVEN.centers + shifts, np.tile(1e-4 * np.eye(3), (3, 1, 1))
    assert layout_flags(RAVEN, RAVEN.names, centers, own, 0.5)
    loose = replace(RAVEN, tolerance_mm=0.3)
    assert not layout_flags(loose, RAVEN.names, centers, own, 0.5)
    places = dict(zip(RAVEN.names, centers, strict=True))
    seen = [LocatedBalls(places, dict.fromkeys(RAVEN.names, 1e-4), {})] * 5
    assert check_body(seen, RAVEN).causes
    assert not check_body(seen, loose).causes


def test_expected_accuracy_includes_the_body_tolerance() -> None:
    cameras = list(ring().values())
    exact = expected_accuracy(POSE, 20.0, RAVEN, cameras, 0.1)
    loose = replace(RAVEN, tolerance_mm=SD_MM)
    known = expected_accuracy(POSE, 20.0, loose, cameras, 0.1)
    mm, deg = tolerance_sd(loose, POSE)
    assert np.allclose(known[:, 3:], np.hypot(exact[:, 3:], [mm, deg]))


def _followed(tolerance_mm: float) -> tuple[int, float]:
    """Of eight bodies with misplaced balls: poses flagged, and the share in 95 % regions."""
    flagged, inside = 0, []
    for seed in range(8):
        shifts = np.random.default_rng(seed).normal(0, SD_MM, (3, 3))
        balls = [
            replace(b, center_mm=b.center_mm + s) for b, s in zip(RAVEN.balls, shifts, strict=True)
        ]
        stated = replace(RAVEN, balls=tuple(balls), tolerance_mm=tolerance_mm)
        poses = [m.pose for m in run(stated, lambda _: [(RAVEN, POSE)], ring(), count=6)[0]]
        flagged += sum(bool(pose.flags) for pose in poses)
        for pose in poses:
            error = POSE.difference(pose.world_from_body)
            inside.append(error @ np.linalg.solve(pose.covariance, error) < 12.6)
    return flagged, float(np.mean(inside))


def test_balls_misplaced_within_tolerance_are_not_flagged() -> None:
    flagged, inside = _followed(SD_MM)
    assert flagged == 0
    assert inside > 0.8
    flagged, inside = _followed(0.0)
    assert flagged > 10
    assert inside < 0.5


def test_a_body_file_keeps_its_tolerance(tmp_path) -> None:
    write_body(tmp_path / "body.toml", replace(RAVEN, tolerance_mm=0.125, radius_tolerance_mm=0.2))
    kept = read_body(tmp_path / "body.toml")
    assert (kept.tolerance_mm, kept.radius_tolerance_mm) == (0.125, 0.2)
    write_body(tmp_path / "exact.toml", RAVEN)
    assert "\ntolerance_mm" not in (tmp_path / "exact.toml").read_text()
