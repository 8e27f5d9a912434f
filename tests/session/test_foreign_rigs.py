"""Rigs in the files of other programs: known points must appear where the rig shows them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera
from measure.session import read_calibration, read_intrinsics
from tests.calibration.rigs import SIZE, cameras

POINTS = np.random.default_rng(1).uniform((-60, -60, 190), (60, 60, 310), (20, 3))
NAMES = {f"cam{i}": SIZE for i in range(4)}


def _opencv(path: Path, values: dict[str, object]) -> Path:
    out = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        if isinstance(value, dict):
            out.startWriteStruct(key, cv2.FILE_NODE_MAP)
            for inner, number in value.items():
                out.write(inner, number)
            out.endWriteStruct()
        elif isinstance(value, list):
            out.startWriteStruct(key, cv2.FILE_NODE_SEQ)
            for word in value:
                out.write("", word)
            out.endWriteStruct()
        else:
            out.write(key, value)
    out.release()
    return path


def _bent(camera: Camera) -> Floats:
    return camera.intrinsics.distortion[:5].reshape(1, 5)


def _relative(camera: Camera) -> RigidTransform:
    """From the first camera, as stereo pairs and chains have it."""
    return camera.camera_from_world @ cameras()[0].world_from_camera


def mc_calib(folder: Path) -> Path:
    values: dict[str, object] = {"nb_camera": 4}
    for i, camera in enumerate(cameras()):
        values[f"camera_{i}"] = {
            "camera_matrix": camera.intrinsics.matrix,
            "distortion_vector": _bent(camera),
            "distortion_type": 0,
            "camera_group": 0,
            "img_width": SIZE[0],
            "img_height": SIZE[1],
            "camera_pose_matrix": camera.world_from_camera.matrix,
        }
    return _opencv(folder / "calibrated_cameras_data.yml", values)


def easymocap(folder: Path) -> Path:
    rig = cameras()
    names: dict[str, object] = {"names": [camera.name for camera in rig]}
    intri, extri = dict(names), dict(names)
    for camera in rig:
        intri[f"K_{camera.name}"] = camera.intrinsics.matrix
        intri[f"dist_{camera.name}"] = _bent(camera)
        pose = camera.camera_from_world
        extri[f"R_{camera.name}"] = cv2.Rodrigues(pose.rotation)[0]
        extri[f"Rot_{camera.name}"] = pose.rotation
        extri[f"T_{camera.name}"] = pose.translation.reshape(3, 1) / 1000
    _opencv(folder / "intri.yml", intri)
    return _opencv(folder / "extri.yml", extri)


def easymocap_by_its_lenses(folder: Path) -> Path:
    return easymocap(folder).with_name("intri.yml")


def multical(folder: Path) -> Path:
    lenses, poses = {}, {}
    for camera in cameras():
        lens, pose = camera.intrinsics, _relative(camera)
        lenses[camera.name] = {
            "model": "standard",
            "image_size": list(SIZE),
            "K": lens.matrix.tolist(),
            "dist": _bent(camera).tolist(),
        }
        name = camera.name if camera.name == "cam0" else f"{camera.name}_to_cam0"
        poses[name] = {"R": pose.rotation.tolist(), "T": (pose.translation / 1000).tolist()}
    path = folder / "calibration.json"
    path.write_text(json.dumps({"cameras": lenses, "camera_poses": poses}, indent=1))
    return path


def stereo_calib(folder: Path) -> Path:
    one, two, *_ = cameras()
    pose = _relative(two)
    lenses: dict[str, object] = {}
    for i, camera in enumerate((one, two), start=1):
        lenses |= {f"M{i}": camera.intrinsics.matrix, f"D{i}": _bent(camera)}
    placed = {"R": pose.rotation, "T": pose.translation.reshape(3, 1)}
    return _opencv(folder / "stereo.yml", {**lenses, **placed})


def stereo_calib_in_two_files(folder: Path) -> Path:
    storage = cv2.FileStorage(str(stereo_calib(folder)), cv2.FILE_STORAGE_READ)
    kept = {key: storage.getNode(key).mat() for key in ("M1", "D1", "M2", "D2", "R", "T")}
    rectified = {key: np.eye(3) for key in ("R1", "R2", "P1", "P2")}
    placed = {key: kept.pop(key) for key in "RT"}
    _opencv(folder / "extrinsics.yml", {**placed, **rectified})
    return _opencv(folder / "intrinsics.yml", dict(kept))


def qualisys(folder: Path, version: str = "2023.1", scale: float = 1) -> Path:
    text = f'<?xml version="1.0"?>\n<calibration qtm-version="{version}"><cameras>'
    for camera in cameras():
        lens, center = camera.intrinsics, camera.center
        k1, k2, p1, p2, k3 = scale * lens.distortion[:5]
        axes = camera.world_from_camera.rotation @ np.diag([1, -1, -1])  # y up, z to the back
        turn = " ".join(f'r{j + 1}{i + 1}="{axes[i, j]}"' for i in range(3) for j in range(3))
        u, v = 64 * (lens.matrix[:2, 2] + [10, 20])
        text += (
            f'<camera active="1" serial="{camera.name}" model="Miqus Video">'
            '<fov_video left="10" top="20" right="1289" bottom="739"/>'
            f'<transform x="{center[0]}" y="{center[1]}" z="{center[2]}" {turn}/>'
            f'<intrinsic focallength="9.2" focalLengthU="{64 * lens.matrix[0, 0]}" '
            f'focalLengthV="{64 * lens.matrix[1, 1]}" centerPointU="{u}" centerPointV="{v}" '
            f'skew="0" radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}" '
            f'tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/></camera>'
        )
    (folder / "rig.qca.txt").write_text(text + "</cameras></calibration>")
    return folder / "rig.qca.txt"


def qualisys_by_pose2sim(folder: Path) -> Path:
    return qualisys(folder, "none", 64)


WRITERS = [
    *(mc_calib, easymocap, easymocap_by_its_lenses, multical, stereo_calib),
    *(stereo_calib_in_two_files, qualisys, qualisys_by_pose2sim),
]


@pytest.mark.parametrize("write", WRITERS)
def test_known_points_appear_where_they_do(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    path = write(tmp_path)
    pair = "stereo" in write.__name__
    pictures = {name: size for name, size in NAMES.items() if not pair or name in ("cam0", "cam1")}
    found = read_calibration(path, pictures=pictures)
    assert found.names == tuple(pictures)
    relative = pair or write is multical
    for camera, true in zip(found.cameras, cameras(), strict=False):
        seen = cameras()[0].camera_from_world.apply(POINTS) if relative else POINTS
        np.testing.assert_allclose(camera.project(seen), true.project(POINTS), atol=1e-6)
    if pair:  # in the wrong direction it would be seen elsewhere
        assert np.linalg.norm(found.cameras[1].center - _relative(cameras()[1]).translation) > 100
        with pytest.raises(CalibrationError, match="camera '1': has no picture size"):
            read_intrinsics(path)
        path.write_text(path.read_text() + "image_width: 1280\nimage_height: 720\n")
        assert [lens.size_wh for lens in read_intrinsics(path).values()] == [SIZE, SIZE]


def vicon(folder: Path, terms: str = "-4e-8 1.5e-14 0") -> Path:
    text = '<?xml version="1.0" encoding="utf-8"?>\n<Cameras>'
    for camera in cameras():
        lens, pose = camera.intrinsics, camera.camera_from_world
        w, x, y, z = pose.quat_wxyz
        u, v = lens.matrix[:2, 2]
        text += (
            f'<Camera DEVICEID="{camera.name}" PIXEL_ASPECT_RATIO="1" SENSOR_SIZE="1280 720" '
            f'SKEW="0" TYPE="Vue"><KeyFrames><KeyFrame FOCAL_LENGTH="{lens.matrix[0, 0]}" '
            f'FRAME="0" ORIENTATION="{x} {y} {z} {w}" POSITION="'
            f'{" ".join(map(str, camera.center))}" PRINCIPAL_POINT="{u} {v}" '
            f'VICON_RADIAL2="ViconRadial2 {u} {v} {terms}"/></KeyFrames></Camera>'
        )
    (folder / "take.xcp").write_text(text + "</Cameras>")
    return folder / "take.xcp"


def test_vicons_radial_terms_lead_from_the_picture_to_a_pinholes(tmp_path: Path) -> None:
    k1, k2 = -4e-8, 1.5e-14
    for camera, true in zip(read_calibration(vicon(tmp_path)).cameras, cameras(), strict=True):
        square = np.diag([*np.repeat(true.intrinsics.matrix[0, 0], 2), 1.0])
        square[:2, 2] = true.intrinsics.matrix[:2, 2]
        plain = replace(true, intrinsics=replace(true.intrinsics, matrix=square, distortion=[]))
        off = camera.project(POINTS) - square[:2, 2]
        squared = np.sum(off**2, axis=1, keepdims=True)
        straight = off * (1 + k1 * squared + k2 * squared**2) + square[:2, 2]
        np.testing.assert_allclose(straight, plain.project(POINTS), atol=1e-3)
        assert np.abs(off + square[:2, 2] - straight).max() > 0.3


@pytest.mark.parametrize(
    ("write", "old", "new", "said"),
    [
        (mc_calib, "distortion_type: 0", "distortion_type: 2", "distortion_type is '2.0': only"),
        (mc_calib, "camera_group: 0", "camera_group: 1", "its cameras are in 2 groups"),
        (multical, '"standard"', '"fisheye62"', "model is 'fisheye62': only lenses"),
        (easymocap, "T_cam1", "T_cam9", "'cam1' has intrinsics but no pose"),
        (qualisys, "focalLengthU", "focalLength", "'cam0': <intrinsic> lacks focalLengthU"),
        (qualisys, "<?xml", "<!DOCTYPE a><?xml", "it has a DOCTYPE"),
        (vicon, 'ORIENTATION="', 'ORIENTATION="x', "ORIENTATION = .* is no 4 finite numbers"),
        (vicon, "ViconRadial2 6", "ViconRadial2 7", "not about its principal point"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, write, old: str, new: str, said: str) -> None:
    path = write(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=rf"{path.name}: .*{said}"):
        read_calibration(path, pictures=NAMES)


SLAM = ["openvins.yaml", "basalt.json", "cameras.txt", "images.txt", "transforms.json"]


@pytest.mark.parametrize("name", SLAM)
def test_rigs_of_slam_and_photogrammetry_are_read(shared: Path, name: str) -> None:
    true = read_calibration(shared / "renders/still/calibration.toml")
    found = read_calibration(
        shared / "inputs/slam_calibrations" / name, pictures=dict.fromkeys(true.names, (1280, 720))
    )
    assert found.names == true.names
    for camera, own in zip(found.cameras, true.cameras, strict=True):
        off = camera.camera_from_world.difference(own.camera_from_world)
        assert np.abs(off).max() < 1e-6
        np.testing.assert_allclose(camera.intrinsics.matrix, own.intrinsics.matrix, atol=1e-6)
        bent = own.intrinsics.coefficients[:4] * (name != "basalt.json")
        np.testing.assert_allclose(camera.intrinsics.coefficients[:4], bent, atol=1e-9)


def test_a_rig_of_slam_that_lacks_something_is_named(tmp_path: Path, shared: Path) -> None:
    folder = shared / "inputs/slam_calibrations"
    with pytest.raises(CalibrationError, match=r"zed.conf: is of a ZED"):
        read_calibration(folder / "zed.conf")
    (tmp_path / "cameras.txt").write_text((folder / "cameras.txt").read_text())
    with pytest.raises(CalibrationError, match=r"COLMAP's lenses, and no images\.txt"):
        read_calibration(tmp_path / "cameras.txt")
    text = (folder / "basalt.json").read_text().replace('"pinhole"', '"ds"', 1)
    (tmp_path / "basalt.json").write_text(text)
    with pytest.raises(CalibrationError, match=r"camera '0': camera_type is 'ds': of Basalt's"):
        read_calibration(tmp_path / "basalt.json")


def test_a_calibration_beyond_reason_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "rig.yaml").open("wb") as file:
        file.write(b"cam0:\n")
        file.truncate(9 << 20)
    with pytest.raises(CalibrationError, match=r"has 9437184 bytes, and 8388608 are the most"):
        read_calibration(tmp_path / "rig.yaml")
