"""Cameras that only the body has located, adjusted: scale, numbers of cameras, covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.by_body import SLIP, shape_error
from measure.calibration.by_body.adjustment import (
    Shape,
    adjusted,
    loose_prior,
    moved_to,
    recording_of_links,
    shape_of,
)
from measure.calibration.by_body.linking import link
from measure.calibration.refining.recording import BallMotion
from measure.calibration.refining.refine import refine_rig
from measure.geometry import RigidTransform
from measure.model import Body, Camera
from tests.calibration.by_body.test_linking import lenses, off, recorded
from tests.calibration.refining.cases import BODY, case
from tests.calibration.refining.cases import motion as wander
from tests.conftest import looking_at_origin


def located(rig: tuple[Camera, ...], body: Body, of: Body | None = None) -> Shape:
    """The rig as sightings of a body place it, once they are taken for those of `body`."""
    linked = link(lenses(rig), body, recorded(rig, of or body))
    recording = recording_of_links(linked, body)
    rough = adjusted(linked.cameras, body, recording).cameras
    first = moved_to(linked.cameras, rough)
    return shape_of(refine_rig(first, body, recording, None, loose_prior(first)), body, recording)


def ring(count: int, webcam) -> tuple[Camera, ...]:
    return tuple(
        Camera(f"cam{k}", webcam, looking_at_origin(450.0, 0.3 + k * 2 * np.pi / count, 0.436))
        for k in range(count)
    )


@pytest.mark.parametrize("count", [2, 6])
def test_two_cameras_are_enough_and_six_are_all_placed(count, webcam, paper_body):
    """Sightings scatter by 0.3 px, 0.1 mm there: 24 instants of three balls each average that."""
    true = ring(count, webcam) if count > 2 else ring(5, webcam)[:2]
    mm, deg = off(located(true, paper_body).cameras, true)
    assert mm < 1.5
    assert deg < 0.2


def test_balls_too_far_apart_in_the_file_make_the_world_larger_and_nobody_the_wiser(
    rig, paper_body
):
    """No picture shows it: so the scale is never said to be known better than the file is."""
    factor = 1.01
    larger = paper_body.with_centers(factor * paper_body.centers).with_radii(
        factor * paper_body.radii, paper_body.radius_covariance
    )
    for said in (paper_body, larger):
        shape = located(rig, said, paper_body)
        first, *others = shape.cameras
        apart = [np.linalg.norm(camera.center - first.center) for camera in others]
        true = [np.linalg.norm(camera.center - rig[0].center) for camera in rig[1:]]
        grown = 1.0 if said is paper_body else factor
        assert np.mean(apart) / np.mean(true) == pytest.approx(grown, abs=0.002)
        arms_mm = float(np.linalg.norm(said.centers - said.middle))
        assert shape.scale_sd >= 0.05 / arms_mm  # 0.05 mm is usual where a file states nothing


def test_the_stated_covariance_holds_the_error():
    """Of 6 draws one may lie outside the 99 % region; `benchmarks.by_body` counts more of them."""
    outside = 0
    for seed in range(100, 106):
        square, dimensions, _ = shape_error(case(seed, 60, slip=SLIP, stated=False), False)
        outside += square > chi2.ppf(0.99, dimensions)
    assert outside <= 1


def test_motion_beside_a_gap_is_told_by_the_frame_sets_on_its_own_side():
    """Three frame sets, a pause, three more, and so on: the motion between them is not known."""
    threes = np.concatenate([k + np.array([-1, 0, 1]) / 30 for k in np.arange(12.0)])
    poses = wander(threes)
    motion = BallMotion(threes, poses, BODY.centers)
    frame, ball, late = np.arange(36), np.zeros(36, dtype=int), np.full(36, 0.01)
    moved = np.einsum("nij,nj->ni", poses.rotation, motion.at(frame, ball, late)[0])
    true = wander(threes + 0.01)
    first, then = (
        np.einsum("nij,j->ni", one.rotation, BODY.centers[0]) + one.translation
        for one in (poses, true)
    )
    assert np.abs(first + moved - then).max() < 0.02
    assert np.abs(then - first).max() > 0.5  # which is told, then, to a few per cent


def test_a_single_frame_set_between_gaps_shows_no_motion():
    times_s = np.array([0.0, 1.0, 1.1, 1.2, 5.0, 5.1, 5.2, 5.3])
    poses = RigidTransform.from_rotvec(np.zeros((8, 3)), np.outer(times_s, [10.0, 0, 0]))
    way, velocity = BallMotion(times_s, poses, BODY.centers).at(
        np.arange(8), np.zeros(8, dtype=int), np.full(8, 0.01)
    )
    assert velocity[:, 0] == pytest.approx([0.0] + [10.0] * 7)
    assert way[:, 0] == pytest.approx([0.0] + [0.1] * 7)
