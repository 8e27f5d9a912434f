"""Cameras that the others contradict are freed alone; what no freed camera mends is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.calibration.refining.freeing import contradicted, freed
from measure.calibration.refining.recording import recording_of
from measure.errors import CalibrationError
from measure.model import Camera
from tests.checking.test_clocks import CAMERAS, moving, recorded
from tests.scenes import RAVEN

TRUE = tuple(CAMERAS.values())
NAMES = tuple(CAMERAS)
NUDGE = np.array([2.0, -3.0, 3.0, 0.003, 0.002, -0.004])


@pytest.fixture(scope="module")
def measured():
    return list(recorded(moving, count=45))


def nudged(camera: Camera, by: float = 1.0) -> Camera:
    return replace(camera, world_from_camera=camera.world_from_camera.perturb(by * NUDGE))


def zoomed(camera: Camera, by: float) -> Camera:
    matrix = camera.intrinsics.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1 + by
    return replace(camera, intrinsics=replace(camera.intrinsics, matrix=matrix))


def rig(**others: Camera) -> tuple[Camera, ...]:
    return tuple(others.get(camera.name, camera) for camera in TRUE)


def test_only_what_the_others_contradict_is_named(measured) -> None:
    assert contradicted(measured, RAVEN, TRUE) == ()
    assert contradicted(measured, RAVEN, rig(cam2=nudged(CAMERAS["cam2"]))) == ("cam2",)
    assert contradicted(measured, RAVEN, rig(cam0=zoomed(CAMERAS["cam0"], 0.03))) == ("cam0",)
    three = rig(cam1=nudged(CAMERAS["cam1"], -1.0))[:3]
    assert contradicted(measured, RAVEN, three) == ("cam1",)
    every = tuple(
        nudged(camera, by) for camera, by in zip(TRUE, (0.5, -0.3, 0.4, -0.6), strict=True)
    )
    assert contradicted(measured, RAVEN, every) == ()  # no two of them agree


def test_what_would_be_shared_out_among_all_is_refused(measured) -> None:
    with pytest.raises(CalibrationError, match=r"all cameras.*calibrat"):
        contradicted(measured, RAVEN, tuple(zoomed(camera, 0.03) for camera in TRUE))
    with pytest.raises(CalibrationError, match=r"cannot tell which of them is off.* --only"):
        contradicted(measured, RAVEN, rig(cam1=nudged(CAMERAS["cam1"]))[:2])
    bent = RAVEN.with_centers(RAVEN.centers + np.diag([0.0, 3.0, 0.0]))
    with pytest.raises(CalibrationError, match="yellow is not where the body file says"):
        contradicted(measured, bent, TRUE)


@pytest.mark.parametrize(
    ("name", "now", "moved"),
    [("cam2", nudged(CAMERAS["cam2"]), True), ("cam0", zoomed(CAMERAS["cam0"], -0.03), False)],
)
def test_a_freed_camera_comes_back_and_the_others_stay(measured, name, now, moved) -> None:
    first, recording = rig(**{name: now}), recording_of(measured, RAVEN)
    free = freed(first, [name], RAVEN, recording)
    assert free.moved == moved
    cameras, joint = free.as_stated(free.refinement, first, None)
    assert joint is None
    at = moving(np.array(0.5)).apply(RAVEN.centers)
    for camera, true, before in zip(cameras, TRUE, first, strict=True):
        if camera.name != name:
            assert camera.world_from_camera is before.world_from_camera
        off, was = (np.abs(c.project(at) - true.project(at)).max() for c in (camera, before))
        assert off < 0.15
        assert was > 3 or camera.name != name


def test_a_freed_camera_errs_as_those_do_that_hold_it(measured) -> None:
    """Its pose has the held cameras' common errors, and its own beside."""
    first = rig(cam2=nudged(CAMERAS["cam2"]))
    sd = np.repeat([0.5, 0.001], 3)
    together = np.tile(np.diag(sd**2), (4, 4)) + np.diag(np.tile(sd / 100, 4) ** 2)
    free = freed(first, ["cam2"], RAVEN, recording_of(measured, RAVEN))
    cameras, joint = free.as_stated(free.refinement, first, together)
    assert joint is not None
    assert np.linalg.eigvalsh(joint).min() > 0
    kept = np.r_[0:12, 18:24]
    np.testing.assert_allclose(joint[np.ix_(kept, kept)], together[np.ix_(kept, kept)])
    np.testing.assert_allclose(cameras[2].pose_covariance, joint[12:18, 12:18])
    turn = np.sqrt(joint[15:18, 15:18].trace() / 3)
    assert 0.8e-3 < turn < 1.5e-3
