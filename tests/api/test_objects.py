"""Cameras, bodies and runs as objects with arrays, for notebooks."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest

import measure
from measure.errors import ConfigError, SessionError
from measure.results import read_run
from measure.session import read_trajectory
from tests.camera_server import ServedCamera, serving
from tests.simulated.sessions import part_of

pytestmark = pytest.mark.slow
SETS, LIT = 8, 5


@pytest.fixture(scope="module")
def still(still, tmp_path_factory):
    """Its first frame sets."""
    return part_of(still, range(SETS), tmp_path_factory.mktemp("objects") / "still")


@pytest.fixture(scope="module")
def run(still):
    return measure.measure(still)


@pytest.fixture(scope="module")
def pictures(still):
    rig = measure.Rig.load(still / "calibration.toml")
    files = {name: sorted((still / name).glob("*.jpg")) for name in rig.names}
    return {name: [cv2.imread(str(file)) for file in some] for name, some in files.items()}


@pytest.fixture(scope="module")
def rig_and_body(still):
    return measure.Rig.load(still / "calibration.toml"), measure.Body.load(still / "body.toml")


def test_it_loads_without_anything_heavy():
    code = "import sys, measure; print(sorted({'numpy', 'scipy', 'cv2', 'numba'} & {*sys.modules}))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout == "[]\n"


def test_a_session_becomes_arrays_of_poses(still, run):
    truth = read_trajectory(still / "truth.csv").at(run.times)
    assert (len(run), run.position.shape, run.covariance.shape) == (SETS, (SETS, 3), (SETS, 6, 6))
    assert set(run.status) == {"ok"}
    off = np.linalg.norm(run.position - truth.translation, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.05
    turned = run.rotation.as_matrix() @ np.swapaxes(truth.rotation, 1, 2)
    assert np.degrees(np.arccos((np.trace(turned, axis1=1, axis2=2) - 1) / 2)).max() < 0.2
    assert np.all(np.linalg.eigvalsh(run.covariance) > 0)
    assert (run.body.name, run.rig.names) == ("raven three-ball body", tuple(run.rig.names))


def test_pictures_as_arrays_give_the_poses_of_their_session(run, pictures, rig_and_body):
    again = measure.measure(pictures, *rig_and_body, times=dict.fromkeys(pictures, run.times))
    np.testing.assert_array_equal(again.position, run.position)
    np.testing.assert_array_equal(again.covariance, run.covariance)


def test_what_is_saved_is_what_was_measured(run, tmp_path):
    run.save(tmp_path / "run")
    read = measure.Run.load(tmp_path / "run")
    np.testing.assert_array_equal(read.position, run.position)
    assert read.scale_sd == run.scale_sd
    assert read_run(tmp_path / "run").summary.values() == run._run.summary.values()
    table = read.to_pandas()
    np.testing.assert_array_equal(table[["x_mm", "y_mm", "z_mm"]], run.position)


def test_a_frame_set_without_a_pose_has_a_row_and_a_reason(run, pictures, rig_and_body):
    dark = {
        name: [*some[:LIT], *(0 * one for one in some[LIT:])] for name, some in pictures.items()
    }
    lost = measure.measure(dark, *rig_and_body, times=run.times)
    assert (len(lost), set(lost.status[:LIT])) == (SETS, {"ok"})
    assert not set(lost.status[LIT:]) & {"ok", "flagged"}
    assert np.isnan(lost.position[LIT:]).all()
    assert np.isnan(lost.rotation[LIT:].as_rotvec()).all()
    assert np.isnan(lost.covariance[LIT:]).all()
    assert all(lost.reason[LIT:])
    codes = lost.to_pandas()["codes"].tolist()
    assert (codes[LIT - 1], codes[LIT][0]) == ([], "against-prediction")
    assert codes[-1][-1] == "repeated-pictures"


def test_pictures_that_do_not_fit_are_refused_in_the_words_of_python(run, pictures, rig_and_body):
    with pytest.raises(ConfigError, match="need `rig`, `body` and `times`"):
        measure.measure(pictures)
    with pytest.raises(SessionError, match="one time for each picture"):
        measure.measure(pictures, *rig_and_body, times=run.times[:3])
    half = {name: [one[::2, ::2] for one in some] for name, some in pictures.items()}
    with pytest.raises(ConfigError, match="640x360 px, and `rig` has it calibrated at 1280x720"):
        measure.measure(half, *rig_and_body, times=run.times)
    gray = {name: [one[:, :, 0] for one in some] for name, some in pictures.items()}
    with pytest.raises(SessionError, match=r"expected uint8 of shape \(h, w, 3\)"):
        measure.measure(gray, *rig_and_body, times=run.times)
    with pytest.raises(ConfigError, match="`times` lacks camera"):
        measure.measure(pictures, *rig_and_body, times={})


@pytest.mark.usefixtures("signals")
def test_running_cameras_yield_poses_until_the_loop_is_left(still, rig_and_body):
    rig, body = rig_and_body
    cameras = {
        name: ServedCamera(
            [file.read_bytes() for file in sorted((still / name).glob("*.jpg"))], 0.1, stamps=True
        )
        for name in rig.names
    }
    with serving(cameras) as addresses:
        poses = []
        for pose in measure.stream(addresses, rig, body):
            poses.append(pose)
            if len(poses) == 5:
                break
    places = np.array([pose.position for pose in poses if pose.status == "ok"])
    truth = read_trajectory(still / "truth.csv").at(np.arange(SETS) / 30).translation
    nearest = np.linalg.norm(places[:, None] - truth, axis=2).min(axis=1)
    assert len(places) >= 3
    assert nearest.max() < 0.2
    assert np.all(np.diff([pose.time for pose in poses]) > 0)
