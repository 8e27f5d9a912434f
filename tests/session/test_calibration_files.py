from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics
from measure.session import Calibration, read_calibration, write_calibration

POINTS = np.array([[10.0, 20, 30], [-50, 40, 10], [0, 0, 0], [60, -30, -20]])


def _spd(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(0, 1, (size, size))
    return root @ root.T * 1e-3


def _camera(seed: int, name: str) -> Camera:
    """A camera some 800 mm away that looks at the origin, turned about its axis by chance."""
    rng = np.random.default_rng(seed)
    place = rng.normal(0, 1, 3)
    place *= 800 / np.linalg.norm(place)
    z = -place / np.linalg.norm(place)
    x = np.cross(z, rng.normal(0, 1, 3))
    x /= np.linalg.norm(x)
    focal, offset = 1400 + rng.normal(0, 10, 2), rng.normal(0, 10, 2)
    matrix = [[focal[0], 0, 640 + offset[0]], [0, focal[1], 360 + offset[1]], [0, 0, 1]]
    known = _spd(rng, 18)
    lens = Intrinsics((1280, 720), np.array(matrix), rng.normal(0, 0.05, 5), known[6:, 6:])
    pose = RigidTransform(np.stack([x, np.cross(z, x), z], axis=1), place)
    return Camera(name, lens, pose, known[:6, :6], float(rng.random()), known[:6, 6:])


def _cameras(seed: int = 1, count: int = 3) -> Calibration:
    return Calibration(tuple(_camera(seed * 10 + i, f"cam{i}") for i in range(count)))


@given(seed=st.integers(0, 10_000))
def test_our_format_keeps_every_digit(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = tmp_path_factory.mktemp("calibration") / "c.toml"
    given = _cameras(seed)
    write_calibration(path, Calibration(given.cameras, {"program": "x", "held_out": {"px": 0.1}}))
    back = read_calibration(path)
    assert back.provenance == {"program": "x", "held_out": {"px": 0.1}}
    for old, new in zip(given.cameras, back.cameras, strict=True):
        assert old.name == new.name
        assert old.intrinsics.size_wh == new.intrinsics.size_wh
        assert np.array_equal(old.intrinsics.matrix, new.intrinsics.matrix)
        assert np.array_equal(old.intrinsics.distortion, new.intrinsics.distortion)
        assert np.array_equal(old.intrinsics.covariance, new.intrinsics.covariance)
        assert np.array_equal(old.pose_covariance, new.pose_covariance)
        assert np.array_equal(old.covariance, new.covariance)
        assert old.reprojection_rms_px == new.reprojection_rms_px
        assert np.array_equal(old.center, new.center)
        difference = old.world_from_camera.difference(new.world_from_camera)
        assert np.abs(difference).max() < 1e-14


@pytest.mark.parametrize(
    ("file_format", "name"),
    [
        ("anipose", "c.toml"),
        ("caliscope", "c.toml"),
        ("opencv", "c.yaml"),
        ("opencv", "c.yml"),
        ("opencv", "c.xml"),
        ("opencv", "c.json"),
    ],
)
def test_other_formats_give_back_the_same_cameras(tmp_path: Path, file_format, name: str) -> None:
    given = _cameras()
    write_calibration(tmp_path / name, given, file_format)
    back = read_calibration(tmp_path / name)
    assert back.names == given.names
    for old, new in zip(given.cameras, back.cameras, strict=True):
        assert old.intrinsics.size_wh == new.intrinsics.size_wh
        rms_px = None if file_format == "anipose" else pytest.approx(old.reprojection_rms_px)
        assert new.reprojection_rms_px == rms_px
        assert np.abs(old.project(POINTS) - new.project(POINTS)).max() < 1e-9


ANIPOSE = """\
[cam_0]
name = "A"
size = [ 640, 480,]
matrix = [ [ 600.0, 0.0, 320.0,], [ 0.0, 600.0, 240.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.1, -0.05, 0.0, 0.0, 0.0,]
rotation = [ 0.0, 0.0, 0.0,]
translation = [ 0.0, 0.0, 500.0,]

[cam_1]
name = "B"
size = [ 640, 480,]
matrix = [ [ 600.0, 0.0, 320.0,], [ 0.0, 600.0, 240.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.0, 0.0, 0.0, 0.0, 0.0,]
rotation = [ 0.0, 0.1, 0.0,]
translation = [ -100.0, 0.0, 480.0,]

[metadata]
adjusted = false
error = 0.07
"""


def test_anipose_poses_are_camera_from_world(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text(ANIPOSE)
    found = read_calibration(path)
    assert found.names == ("A", "B")
    assert np.allclose(found.camera("A").center, [0, 0, -500])
    camera = found.camera("B")
    by_opencv, _ = cv2.projectPoints(
        POINTS,
        np.array([0, 0.1, 0]),
        np.array([-100.0, 0, 480]),
        camera.intrinsics.matrix,
        np.zeros(5),
    )
    assert np.allclose(camera.project(POINTS), np.asarray(by_opencv).reshape(-1, 2), atol=1e-9)
    in_cm = read_calibration(path, unit="cm")
    assert np.allclose(in_cm.camera("A").center, [0, 0, -5000])


CALISCOPE = """\
[cameras.1]
cam_id = 1
rotation_count = 0
error = 0.21
exposure = "null"
grid_count = 20
size = [ 1920, 1080 ]
matrix = [ [ 1121.0, 0.0, 943.5 ], [ 0.0, 1120.0, 532.0 ], [ 0.0, 0.0, 1.0 ] ]
distortions = [ 0.07, -0.10, -0.0003, 0.000006, 0.0418 ]
translation = [ 0.0, 0.0, 1.5 ]
rotation = [ 0.0, 0.0, 0.0 ]
fisheye = false

[cameras.10]
port = 10
size = [ 1920, 1080 ]
matrix = [ [ 1121.0, 0.0, 943.5 ], [ 0.0, 1120.0, 532.0 ], [ 0.0, 0.0, 1.0 ] ]
distortions = [ 0.07, -0.10, -0.0003, 0.000006, 0.0418 ]
translation = [ 0.25, -0.05, 1.76 ]
rotation = [ [ 1.0, 0.0, 0.0 ], [ 0.0, 1.0, 0.0 ], [ 0.0, 0.0, 1.0 ] ]
"""


def test_caliscope_is_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "camera_array.toml"
    path.write_text(CALISCOPE)
    found = read_calibration(path)
    assert found.names == ("cam_1", "cam_10")
    assert found.camera("cam_1").reprojection_rms_px == 0.21
    assert np.allclose(found.camera("cam_1").center, [0, 0, -1500])
    assert np.allclose(found.camera("cam_10").center, [-250, 50, -1760])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("fisheye = false", "fisheye = true", "'cam_1': distortion of a fisheye: expected"),
        ("translation = [ 0.0, 0.0, 1.5 ]\n", "", "'cam_1' has intrinsics but no pose"),
        ("size = [ 1920, 1080 ]\nmatrix", "size = [ 0, 1080 ]\nmatrix", "picture size is no two"),
        ("[ 1.0, 0.0, 0.0 ], [ 0.0, 1.0, 0.0 ]", "[ 0, 1.0, 0 ], [ 1.0, 0, 0 ]", "not a rotation"),
    ],
)
def test_a_foreign_file_that_cannot_be_used(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in CALISCOPE
    path = tmp_path / "camera_array.toml"
    path.write_text(CALISCOPE.replace(old, new, 1))
    with pytest.raises(CalibrationError) as caught:
        read_calibration(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)


def test_metres_in_a_file_of_millimetres_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text(
        ANIPOSE.replace("500.0", "0.5").replace("-100.0", "-0.1").replace("480.0", "0.48")
    )
    with pytest.raises(CalibrationError, match=r'look like metres; .* calibration_unit = "m"'):
        read_calibration(path)
    assert np.allclose(read_calibration(path, unit="m").camera("A").center, [0, 0, -500])


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("pose_covariance", "[[1.0, 0.0], [0.0, 1.0]]", "must be 6x6, got 2x2"),
        ("pose_covariance", "[[1.0, 0.0]]", "not square"),
        ("pose_intrinsics_covariance", "[[1.0, 0.0]]", "must be 6x12"),
        ("pose_intrinsics_covariance", f"{6 * [12 * [0.0]]}", "needs the other two"),
        ("intrinsics_covariance", "[[1.0, 2.0], [2.0, 1.0]]", "negative eigenvalues"),
        ("pose_covariance", "[[1.0, 0.5], [0.0, 1.0]]", "symmetric"),
        ("distortion", "[0.1, 0.2]", "expected 0, 4, 5 or 8 coefficients, got 2"),
        ("reprojection_rms_px", "-1.0", "greater than or equal to 0"),
    ],
)
def test_impossible_values_are_named(tmp_path: Path, field: str, value: str, words: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(
        '[[cameras]]\nname = "a"\nsize_wh = [64, 48]\n'
        "matrix = [[70.0, 0.0, 31.5], [0.0, 70.0, 23.5], [0.0, 0.0, 1.0]]\n"
        f"quat_wxyz = [1.0, 0.0, 0.0, 0.0]\ntranslation_mm = [0.0, 0.0, 0.0]\n{field} = {value}\n"
    )
    with pytest.raises(CalibrationError, match=words) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
