"""Calibrations of other programs: what is wrong in them, and what they cannot hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.errors import CalibrationError
from measure.model import Camera, Projection
from measure.session import Calibration, read_calibration, read_intrinsics, write_calibration
from tests.calibration.rigs import cameras


def test_a_real_opencv_file(shared: Path) -> None:
    path = shared / "data/opencv_stereo/left_intrinsics.yml"
    lens = read_intrinsics(path)["left_intrinsics"]
    assert lens.size_wh == (640, 480)
    assert lens.focal_px == pytest.approx(535.91573396163199)
    assert lens.distortion[:5] == pytest.approx(
        [-0.26637260909660682, -0.038588898922304653, 0.0017831947, -0.00028122100, 0.2383915308]
    )
    with pytest.raises(CalibrationError, match="'left_intrinsics' has intrinsics but no pose"):
        read_calibration(path)


def test_an_opencv_file_of_something_else(shared: Path) -> None:
    with pytest.raises(CalibrationError, match=r"stereo_calib\.xml: holds no camera that is"):
        read_calibration(shared / "data/opencv_stereo/stereo_calib.xml")


def test_a_caliscope_project_file_is_no_calibration(shared: Path) -> None:
    with pytest.raises(CalibrationError, match=r"config\.toml"):
        read_calibration(shared / "data/caliscope_4cam/prerecorded_intrinsic/config.toml")


@pytest.mark.parametrize("text", ["%YAML:1.0\n---\nx: [", "<?xml version='1.0'?><a>", "{", "{}"])
def test_a_broken_opencv_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.yml").write_text(text)
    with pytest.raises(CalibrationError, match=r"c\.yml: "):
        read_calibration(tmp_path / "c.yml")


@pytest.mark.parametrize("file_format", ["anipose", "caliscope"])
def test_a_matrix_of_another_program_is_a_camera_matrix(tmp_path: Path, file_format) -> None:
    from measure.session import open_session
    from tests.session.conftest import write_recording

    with open_session(write_recording(tmp_path / "rec").path) as session:
        write_calibration(tmp_path / "c.toml", Calibration(session.cameras), file_format)
    text = (tmp_path / "c.toml").read_text()
    assert "0.0, 0.0, 1.0" in text
    (tmp_path / "c.toml").write_text(text.replace("0.0, 0.0, 1.0", "0.0, 0.0, 2.0", 1))
    with pytest.raises(CalibrationError, match=r"c\.toml.*not a camera matrix"):
        read_calibration(tmp_path / "c.toml")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("T", np.array([[1.0], [np.nan], [0.0]]), "T must be 3 finite numbers"),
        ("R", np.full((3, 3), np.nan), "R must be finite numbers"),
        ("R", np.eye(2), "its pose is no 3x3 matrix R"),
        ("R", np.eye(4), "its pose is no 3x3 matrix R"),
        ("camera_matrix", np.diag([70.0, 70.0, 0.0]), "not a camera matrix"),
        ("camera_matrix", np.diag([np.nan, 70.0, 1.0]), "camera_matrix must be 9 finite"),
        ("distortion_coefficients", np.full((5, 1), np.nan), "must be finite"),
    ],
)
def test_an_opencv_file_with_wrong_numbers(tmp_path: Path, name: str, value, said: str) -> None:
    right = {"camera_matrix": np.diag([70.0, 70.0, 1.0]), "R": np.eye(3), "T": np.zeros((3, 1))}
    out = cv2.FileStorage(str(tmp_path / "c.yml"), cv2.FILE_STORAGE_WRITE)
    for key, number in {"image_width": 64, "image_height": 48, **right, name: value}.items():
        out.write(key, number)
    out.release()
    with pytest.raises(CalibrationError, match=rf"c\.yml: camera 'c'.*{said}"):
        read_calibration(tmp_path / "c.yml")


def _written(path: Path, file_format) -> str:
    write_calibration(path, Calibration(cameras()), file_format)
    return path.read_text()


@pytest.mark.parametrize(
    ("name", "file_format", "right", "wrong", "said"),
    [
        ("c.yml", "opencv", "unit: mm", "unit: inch", "unit 'inch': it may be mm, cm or m"),
        ("c.toml", "anipose", 'unit = "mm"', 'unit = "inch"', "unit 'inch'"),
        ("c.toml", "anipose", 'unit = "mm"', 'unit = ["mm"]', r"unit \['mm'\]"),
        ("c.yml", "opencv", "rows: 3", "rows: 2", "camera_matrix must be 9 finite numbers"),
        ("c.yml", "opencv", "rows: 5", "rows: 6", "coefficients must be finite"),
    ],
)
def test_a_slip_in_another_programs_file(
    tmp_path: Path, name: str, file_format, right: str, wrong: str, said: str
) -> None:
    text = _written(tmp_path / name, file_format)
    (tmp_path / name).write_text(text.replace(right, wrong, 1))
    with pytest.raises(CalibrationError, match=rf"{name}.*{said}"):
        read_calibration(tmp_path / name)


def test_a_unit_given_goes_before_a_unit_unknown(tmp_path: Path) -> None:
    text = _written(tmp_path / "c.yml", "opencv")
    (tmp_path / "c.yml").write_text(text.replace("unit: mm", "unit: inch"))
    found = read_calibration(tmp_path / "c.yml", unit="cm").cameras[0]
    true = cameras()[0].camera_from_world.translation
    assert np.allclose(found.camera_from_world.translation, 10 * true)


def test_other_programs_values_that_say_nothing_of_cameras(tmp_path: Path) -> None:
    text = _written(tmp_path / "c.toml", "anipose")
    (tmp_path / "c.toml").write_text("metadata = 3\n" + text.split("[metadata]")[0])
    assert len(read_calibration(tmp_path / "c.toml").cameras) == 4


def test_an_opencv_file_whose_cameras_are_numbers(tmp_path: Path) -> None:
    (tmp_path / "c.yml").write_text("%YAML:1.0\n---\ncameras: [ 1, 2 ]\n")
    with pytest.raises(CalibrationError, match="cameras must be maps"):
        read_calibration(tmp_path / "c.yml")


def test_a_rolling_shutter_that_a_format_cannot_hold_is_said(tmp_path: Path, caplog) -> None:
    colored = replace(cameras()[1].intrinsics, lateral_color=(7e-4, -5e-4))
    changed = (
        replace(cameras()[0], readout_s=0.01),
        replace(cameras()[1], intrinsics=colored),
        *cameras()[2:],
    )
    rolling = Calibration(changed)
    write_calibration(tmp_path / "own.toml", rolling)
    write_calibration(tmp_path / "other.toml", Calibration(cameras()), "caliscope")
    assert not caplog.text
    kept = read_calibration(tmp_path / "own.toml").cameras
    assert [c.intrinsics.lateral_color for c in kept[:2]] == [None, (7e-4, -5e-4)]
    write_calibration(tmp_path / "c.toml", rolling, "caliscope")
    assert "cannot hold the lateral colour of cam1" in caplog.text
    assert "cannot hold the rolling shutter (readout_s) of cam0" in caplog.text


@pytest.mark.parametrize(
    ("coefficients", "read_as"),
    [("[-0.1, 0.02, 0.001, -0.002]", "pinhole"), ("[0.05, -0.01, 0.03, -0.004]", None)],
)
def test_four_coefficients_that_cannot_be_a_pinhole_s_need_a_model(
    tmp_path, coefficients, read_as
) -> None:
    path = tmp_path / "left.yml"
    path.write_text(
        "image_width: 640\nimage_height: 480\n"
        "camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}\n"
        f"distortion_coefficients: {{rows: 1, cols: 4, data: {coefficients}}}\n"
    )
    if read_as is None:
        with pytest.raises(CalibrationError, match="no lens model, the last two too large"):
            read_intrinsics(path)
        path.write_text(path.read_text() + "camera_model: fisheye\n")
    (lens,) = read_intrinsics(path).values()
    assert lens.model == (read_as or "fisheye")


@pytest.mark.parametrize(
    ("said", "other"),
    [
        ('distortion_model: "equidistant"', 'distortion_model: "mei"'),
        ("fisheye_model: 1", "fisheye_model: 2"),
    ],
)
@pytest.mark.parametrize("read", [read_calibration, read_intrinsics])
def test_a_lens_is_read_by_the_model_that_its_file_names(tmp_path, said, other, read) -> None:
    """Read as k1 k2 p1 p2, a fisheye's four coefficients cost millimetres, without a word."""
    path = tmp_path / "c.yml"
    write_calibration(
        path, Calibration((with_lens(cameras()[0], "fisheye"), *cameras()[1:])), "opencv"
    )
    written = path.read_text()
    assert written.count("camera_model: fisheye") == 1

    def models(stated: str) -> list[str]:
        path.write_text(written.replace("camera_model: fisheye", stated))
        found = read(path)
        lenses = (
            found.values() if read is read_intrinsics else [c.intrinsics for c in found.cameras]
        )
        return [lens.model for lens in lenses]

    fisheye_first = ["fisheye", *["pinhole"] * (len(cameras()) - 1)]
    assert models("camera_model: fisheye") == models(said) == fisheye_first
    assert models('distortion_model: "plumb_bob"') == ["pinhole"] * len(cameras())
    with pytest.raises(
        CalibrationError, match=f"{other.split(':')[0]} is .*: only lenses of OpenCV's"
    ):
        models(other)


def with_lens(camera: Camera, model: Projection) -> Camera:
    bent = [-0.02, 0.004, -0.001, 0.0002]
    return replace(camera, intrinsics=replace(camera.intrinsics, distortion=bent, model=model))


@pytest.mark.parametrize("file_format", ["triball", "anipose", "caliscope", "opencv"])
def test_a_fisheye_comes_back_from_every_format(tmp_path: Path, file_format) -> None:
    path, rig = tmp_path / "c.yml", tuple(with_lens(camera, "fisheye") for camera in cameras())
    path = path.with_suffix(".yml" if file_format == "opencv" else ".toml")
    write_calibration(path, Calibration(rig), file_format)
    for lens in (camera.intrinsics for camera in read_calibration(path).cameras):
        assert lens.model == "fisheye"
        np.testing.assert_allclose(lens.coefficients, [-0.02, 0.004, -0.001, 0.0002])
    path.write_text(path.read_text().replace("0.004", "0.004, 0.0, 0.3"))
    with pytest.raises(CalibrationError):
        read_calibration(path)


ROS = """
image_width: 1280
image_height: 720
camera_name: left
camera_matrix: {{rows: 3, cols: 3, data: [1400.0, 0.0, 640.0, 0.0, 1401.0, 360.0, 0.0, 0.0, 1.0]}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: 5, data: [0.06, -0.14, -0.0009, 0.0007, 0.05]}}
"""


def test_a_lens_as_ros_writes_it(tmp_path: Path) -> None:
    path = tmp_path / "left.yaml"
    path.write_text(ROS.format(model="plumb_bob"))
    (lens,) = read_intrinsics(path).values()
    assert lens.size_wh == (1280, 720)
    np.testing.assert_allclose(lens.matrix, [[1400, 0, 640], [0, 1401, 360], [0, 0, 1]])
    np.testing.assert_allclose(lens.distortion[:5], [0.06, -0.14, -0.0009, 0.0007, 0.05])
    with pytest.raises(CalibrationError, match="'left' has intrinsics but no pose"):
        read_calibration(path)
    path.write_text(ROS.format(model="equidistant"))
    with pytest.raises(CalibrationError, match="'left': distortion of a fisheye: expected 0 or 4"):
        read_intrinsics(path)
    path.write_text(ROS.format(model="equidistant").replace(", 0.05]", "]"))
    assert read_intrinsics(path)["left"].model == "fisheye"


def camchain() -> str:
    """The rig as Kalibr writes it: each camera from the one before, in metres."""
    lines, before = [], None
    for index, camera in enumerate(cameras()):
        lens, pose = camera.intrinsics, camera.camera_from_world
        (fx, _, cx), (_, fy, cy), _ = lens.matrix.tolist()
        lines += [
            f"cam{index}:",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {lens.distortion[:4].tolist()}",
            "  distortion_model: radtan",
            f"  intrinsics: [{fx}, {fy}, {cx}, {cy}]",
            f"  resolution: {list(lens.size_wh)}",
        ]
        if before is not None:
            step = (pose @ before.inverse()).matrix
            step[:3, 3] /= 1000
            lines += ["  T_cn_cnm1:", *(f"  - {row}" for row in step.tolist())]
        before = pose
    return "\n".join(lines)


def test_a_rig_as_kalibr_writes_it(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(camchain())
    found, true = read_calibration(tmp_path / "camchain.yaml").cameras, cameras()
    assert [camera.name for camera in found] == ["cam0", "cam1", "cam2", "cam3"]
    for one, other in zip(found, true, strict=True):
        placed = true[0].camera_from_world @ other.world_from_camera
        assert np.abs(one.world_from_camera.difference(placed)).max() < 1e-6
        np.testing.assert_allclose(one.intrinsics.matrix, other.intrinsics.matrix)
    wide = camchain().replace("radtan", "equidistant", 1)
    (tmp_path / "camchain.yaml").write_text(wide)
    models = [c.intrinsics.model for c in read_calibration(tmp_path / "camchain.yaml").cameras]
    assert models == ["fisheye", "pinhole", "pinhole", "pinhole"]
    (tmp_path / "camchain.yaml").write_text(camchain().replace("model: pinhole", "model: omni", 1))
    with pytest.raises(CalibrationError, match="'cam0': camera_model is 'omni'"):
        read_calibration(tmp_path / "camchain.yaml")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("resolution: [", "resolution: [0.5, ", "'cam0': picture size must be 2 finite numbers"),
        ("intrinsics: [", "intrinsics: [.nan, ", "'cam0': intrinsics must be 4 finite"),
        ("  - [", "  - [x, ", "'cam1': T_cn_cnm1 must be 16 finite numbers"),
    ],
)
def test_a_slip_in_a_camchain(tmp_path: Path, old: str, new: str, said: str) -> None:
    (tmp_path / "camchain.yaml").write_text(camchain().replace(old, new, 1))
    with pytest.raises(CalibrationError, match=said):
        read_calibration(tmp_path / "camchain.yaml")


@pytest.mark.parametrize("angle", ["1e8", "180.0"])
def test_a_rotation_vector_beyond_reason(tmp_path: Path, angle: str) -> None:
    write_calibration(tmp_path / "c.toml", Calibration(cameras()), "anipose")
    lines = (tmp_path / "c.toml").read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("rotation"))
    lines[at] = f"rotation = [0.1, {angle}, 0.2]"
    (tmp_path / "c.toml").write_text("\n".join(lines))
    with pytest.raises(CalibrationError, match=r"rotation vector of .* is none: is it in rad"):
        read_calibration(tmp_path / "c.toml")


@pytest.mark.parametrize(
    "text", ['[{"intrinsic_matrix": [[1, 0], [0, 1]]}]', "-2.7,-1.4\n7.3,-2.6"]
)
def test_a_file_that_is_not_read_is_answered_with_what_is(tmp_path: Path, text: str) -> None:
    (tmp_path / "dlt.csv").write_text(text)
    for read in (read_calibration, read_intrinsics):
        with pytest.raises(CalibrationError, match=r"dlt\.csv: .*calibrations are read as"):
            read(tmp_path / "dlt.csv")
