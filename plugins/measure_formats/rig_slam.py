"""Rigs of SLAM and of photogrammetry: Basalt, nerfstudio and instant-ngp, COLMAP.

OpenVINS writes Kalibr's tables, see `rig_tables`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.reading import read_text
from measure.session import StatedCamera, StatedRig, stated_model
from measure_formats.plain_values import READ
from measure_formats.rig_tables import numbers_in

Table = Mapping[str, Any]

_QUATERNION, _POSITION = ("qw", "qx", "qy", "qz"), ("px", "py", "pz")
_BASALT = {
    "pinhole": ("pinhole", ()),
    "pinhole-radtan8": ("pinhole", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kb4": ("fisheye", ("k1", "k2", "k3", "k4")),
}
_COLMAP_LINE = re.compile(r"[0-9]+ [A-Z_]+ [0-9]+ [0-9]+( [-+.0-9eE]+){3,12} *")
_COLMAP = {
    "SIMPLE_PINHOLE": ("pinhole", 1, 0),
    "PINHOLE": ("pinhole", 2, 0),
    "SIMPLE_RADIAL": ("pinhole", 1, 1),
    "RADIAL": ("pinhole", 1, 2),
    "OPENCV": ("pinhole", 2, 4),
    "FULL_OPENCV": ("pinhole", 2, 8),
    "OPENCV_FISHEYE": ("fisheye", 2, 4),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, 1),
    "RADIAL_FISHEYE": ("fisheye", 1, 2),
}
"""Lens model, and how many focal lengths and coefficients stand about the principal point."""
_COLMAP_MIDDLE_PX = 0.5  # Of the first pixel, from which it counts the principal point
_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])  # Its cameras look along -z, and y points up


def read_slam(path: Path, values: object) -> StatedRig | None:
    """Basalt's JSON, or nerfstudio's `transforms.json`; None if it is neither."""
    if not isinstance(values, Mapping):
        return None
    inner = values.get("value0")
    if isinstance(inner, Mapping) and {"T_imu_cam", "intrinsics"} <= inner.keys():
        return _basalt(path, inner)
    frames = values.get("frames")
    if isinstance(frames, list) and any(
        isinstance(one, Mapping) and "transform_matrix" in one for one in frames
    ):
        return _nerfstudio(path, values, frames)
    return None


def read_colmap(path: Path, text: str) -> StatedRig | None:
    """COLMAP's `cameras.txt` with the `images.txt` beside it; None if it is neither."""
    rows = _rows(text)
    if not rows:
        return None
    if not _COLMAP_LINE.fullmatch(rows[0]):
        is_images = len(rows[0].split()) == 10 and "IMAGE_ID" in text
        other = path.with_name("cameras.txt")
        if not (is_images and other.is_file()):
            return None
        return read_colmap(other, read_text(other, CalibrationError))
    lenses = {row.split()[0]: row.split()[1:] for row in rows}
    images = path.with_name("images.txt")
    if not images.is_file():
        raise CalibrationError(
            f"{path}: holds COLMAP's lenses, and no {images.name} with the cameras' poses is beside"
        )
    # Each pose is followed by a line of points, which may be empty.
    posed = [row.split() for row in _rows(read_text(images, CalibrationError))]
    posed = [row for row in posed if len(row) == 10 and row[8] in lenses]
    cameras = []
    for row, name in zip(posed, _names([row[9] for row in posed]), strict=True):
        place = f"{images}: camera '{name}'"
        quat_wxyz = numbers_in(row[1:5], place, "the quaternion", 4)
        pose = _turn(place, quat_wxyz), numbers_in(row[5:8], place, "the translation", 3)
        cameras.append(_colmap_camera(f"{path}: camera '{name}'", name, lenses[row[8]], pose))
    return StatedRig("colmap", tuple(cameras), "m") if cameras else None


def _rows(text: str) -> list[str]:
    lines = (line.strip() for line in text.splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def _colmap_camera(
    place: str, name: str, row: list[str], pose: tuple[Floats, Floats]
) -> StatedCamera:
    model, width, height, *params = row
    if model not in _COLMAP:
        raise CalibrationError(f"{place}: model {model} is not read; {', '.join(_COLMAP)} are")
    projection, focal, count = _COLMAP[model]
    given = numbers_in(params, place, "parameters", focal + 2 + count)
    fx, fy = given[0], given[focal - 1]
    cx, cy = given[focal : focal + 2] - _COLMAP_MIDDLE_PX
    distortion = np.pad(given[focal + 2 :], (0, max(4 - count, 0)))
    return StatedCamera(
        name,
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        distortion,
        stated_model(place, {"model": projection}),
        (int(width), int(height)),
        pose,
    )


def _basalt(path: Path, values: Table) -> StatedRig:
    """Its `T_imu_cam` are world_from_camera, in m; its cameras have no names."""
    poses, lenses = values["T_imu_cam"], values["intrinsics"]
    sizes = values.get("resolution", [])
    lists = all(isinstance(one, list) for one in (poses, lenses, sizes))
    if not lists or not len(poses) == len(lenses) == len(sizes):
        raise CalibrationError(
            f"{path}: T_imu_cam, intrinsics and resolution must be lists of one length; {READ}"
        )
    cameras = []
    for k, (pose, lens, size) in enumerate(zip(poses, lenses, sizes, strict=True)):
        place = f"{path}: camera '{k}'"
        pose, lens = dict(pose), dict(lens)
        kind, own = str(lens.get("camera_type")), dict(lens.get("intrinsics", {}))
        if kind not in _BASALT:
            raise CalibrationError(
                f"{place}: camera_type is '{kind}': of Basalt's lens models {', '.join(_BASALT)} "
                "are read: calibrate with one of them"
            )
        model, names = _BASALT[kind]
        values_of = {key: own.get(key) for key in ("fx", "fy", "cx", "cy", *names)}
        fx, fy, cx, cy, *distortion = numbers_in(
            list(values_of.values()), place, ", ".join(values_of), len(values_of)
        )
        turn = _turn(place, numbers_in([pose.get(q) for q in _QUATERNION], place, "qw to qz", 4))
        center = numbers_in([pose.get(p) for p in _POSITION], place, "px, py, pz", 3)
        width, height = numbers_in(size, place, "resolution", 2)
        cameras.append(
            StatedCamera(
                str(k),
                np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
                np.array(distortion),
                stated_model(place, {"camera_type": model}),
                (int(width), int(height)),
                (turn.T, -turn.T @ center),
            )
        )
    return StatedRig("basalt", tuple(cameras), "m", numbered=True)


def _nerfstudio(path: Path, shared: Table, frames: Sequence[Any]) -> StatedRig:
    """Each frame is a camera: world_from_camera, in m, with the axes of OpenGL."""
    tables = [{**shared, **dict(frame)} for frame in frames]
    names = _names([str(table.get("file_path", f"cam{k}")) for k, table in enumerate(tables)])
    cameras = []
    for name, table in zip(names, tables, strict=True):
        place = f"{path}: camera '{name}'"
        model = stated_model(place, {"camera_model": _plain_model(table)})
        needed = [table.get(key) for key in ("fl_x", "fl_y", "cx", "cy")]
        fx, fy, cx, cy = numbers_in(needed, place, "fl_x, fl_y, cx, cy", 4)
        width, height = numbers_in([table.get("w"), table.get("h")], place, "w, h", 2)
        keys = ("k1", "k2", "k3", "k4") if model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
        distortion = numbers_in([table.get(key, 0.0) for key in keys], place, ", ".join(keys))
        if model != "fisheye" and table.get("k4"):
            raise CalibrationError(f"{place}: its k4 is none of OpenCV's: calibrate without")
        matrix = numbers_in(table["transform_matrix"], place, "transform_matrix", 16).reshape(4, 4)
        turn, center = matrix[:3, :3] @ _FROM_OPENGL, matrix[:3, 3]
        cameras.append(
            StatedCamera(
                name,
                np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
                distortion,
                model,
                (int(width), int(height)),
                (turn.T, -turn.T @ center),
            )
        )
    return StatedRig("nerfstudio", tuple(cameras), "m")


def _plain_model(table: Table) -> str:
    """What a lens model is called, as OpenCV calls it."""
    said = str(table.get("camera_model", "OPENCV")).lower()
    return {"opencv_fisheye": "fisheye", "simple_pinhole": "pinhole"}.get(said, said)


def _turn(place: str, quat_wxyz: Floats) -> Floats:
    if not 0.9 < float(np.linalg.norm(quat_wxyz)) < 1.1:
        raise CalibrationError(f"{place}: its quaternion is no rotation")
    return Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()


def _names(files: Sequence[str]) -> list[str]:
    """What cameras are called after their pictures: the file, or the folder where files repeat."""
    stems = [PurePosixPath(file).stem for file in files]
    if len(set(stems)) == len(stems):
        return stems
    return [PurePosixPath(file).parent.name for file in files]
