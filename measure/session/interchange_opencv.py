"""OpenCV's calibration files (YAML, XML or JSON of `cv2.FileStorage`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, Projection
from measure.session.calibration_file import NO_CAMERA_MATRIX, Calibration, is_camera_matrix
from measure.session.interchange_toml import (
    Unit,
    distortion8,
    mm_per,
    opencv_distortion,
    rotation_matrix,
)
from measure.session.interchange_yaml import stated_model

_SHOWN = 120
"""Characters of a reason: OpenCV quotes what it could not read."""
_MATRIX_NAMES = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
_DISTORTION_NAMES = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D")
_MODEL_NAMES = ("distortion_model", "camera_model", "lens_model", "model")
_FISHEYE_FLAGS = ("fisheye_model", "fisheye", "is_fisheye", "distortion_type")
"""Where the number 1 says that the lens is a fisheye, and 0 that it is not."""
_ROTATION_NAMES = ("rotation", "R", "rvec")
_TRANSLATION_NAMES = ("translation", "T", "tvec", "t")


READ = (
    "calibrations are read as this program's TOML, aniposelib's or caliscope's TOML, Kalibr's "
    "camchain, ROS's camera_info (lenses), or OpenCV's YAML, XML or JSON with camera_matrix, "
    "distortion_coefficients, image_width and image_height"
)
"""The end of messages on files of other programs."""


def is_opencv(text: str) -> bool:
    """Whether text is what `cv2.FileStorage` writes."""
    start = text.lstrip()
    return start.startswith(("%YAML", "<?xml", "<opencv_storage", "{"))


def read_opencv(path: Path, text: str, unit: Unit | None) -> Calibration:
    """Read a file of one camera, or of several under `cameras`, with their poses.

    Args:
        path: for messages; its stem names a camera that has no `camera_name`.
        text: the file's content.
        unit: of the translations; what the file's `unit` says, else mm.

    Raises:
        CalibrationError: not such a file, or a camera without matrix, image size or pose.
    """
    storage = _parse(path, text)
    scale = mm_per(path, storage.getNode("unit").string(), unit)
    cameras = []
    for node, name in _camera_nodes(storage, path):
        rotation = _first(node, _ROTATION_NAMES)
        translation = _first(node, _TRANSLATION_NAMES)
        if rotation is None or translation is None or translation.size != 3:
            raise CalibrationError(
                f"{path}: camera '{name}' has intrinsics but no pose (R and T, camera from world); "
                "locate it with measure calibrate"
            )
        shaped = rotation.size == 3 or rotation.shape == (3, 3)
        if not shaped or not np.isfinite([*rotation.flat, *translation.flat]).all():
            raise CalibrationError(
                f"{path}: camera '{name}': its pose is no 3x3 matrix R, or vector of 3, and a T of "
                "3, all finite numbers"
            )
        try:
            pose = RigidTransform(rotation_matrix(rotation), scale * translation.reshape(3))
        except CalibrationError as problem:
            raise CalibrationError(f"{path}: camera '{name}': {problem}") from None
        error = node.getNode("avg_reprojection_error")
        rms = None if error.empty() else float(error.real())
        cameras.append(
            Camera(name, _intrinsics(storage, node, path, name), pose.inverse(), None, rms)
        )
    return Calibration(tuple(cameras), {"format": "opencv"})


def read_opencv_intrinsics(path: Path, text: str) -> dict[str, Intrinsics]:
    """Read the lenses alone, by camera name.

    Raises:
        CalibrationError: not such a file, or a camera without matrix or image size.
    """
    storage = _parse(path, text)
    return {
        name: _intrinsics(storage, node, path, name) for node, name in _camera_nodes(storage, path)
    }


def write_opencv(path: Path, calibration: Calibration) -> None:
    """Write OpenCV YAML, XML or JSON, as the name ends; poses are camera_from_world in mm."""
    out = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if not out.isOpened():
        raise CalibrationError(f"{path}: cannot be written as OpenCV YAML, XML or JSON")
    out.write("unit", "mm")
    out.startWriteStruct("cameras", cv2.FILE_NODE_SEQ)
    for camera in calibration.cameras:
        out.startWriteStruct("", cv2.FILE_NODE_MAP)
        out.write("camera_name", camera.name)
        out.write("image_width", int(camera.intrinsics.size_wh[0]))
        out.write("image_height", int(camera.intrinsics.size_wh[1]))
        if camera.intrinsics.model == "fisheye":
            out.write("camera_model", "fisheye")
        out.write("camera_matrix", camera.intrinsics.matrix)
        out.write("distortion_coefficients", opencv_distortion(camera).reshape(-1, 1))
        out.write("R", camera.camera_from_world.rotation)
        out.write("T", camera.camera_from_world.translation.reshape(3, 1))
        if camera.reprojection_rms_px is not None:
            out.write("avg_reprojection_error", camera.reprojection_rms_px)
        out.endWriteStruct()
    out.endWriteStruct()
    out.release()


def _parse(path: Path, text: str) -> Any:
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as problem:
        cause = str(problem.__cause__ or problem).strip().splitlines()[-1]
        cause = cause.rpartition("error: ")[2][:_SHOWN]
        raise CalibrationError(f"{path}: not a file OpenCV can read ({cause}); {READ}") from None
    return storage


def _camera_nodes(storage: Any, path: Path) -> list[tuple[Any, str]]:
    nodes = storage.getNode("cameras")
    if nodes.isSeq():
        found = [nodes.at(i) for i in range(nodes.size())]
        if not all(node.isMap() for node in found):
            raise CalibrationError(f"{path}: cameras must be maps with a camera_matrix each")
        return [(n, n.getNode("camera_name").string() or f"cam{i}") for i, n in enumerate(found)]
    if _first(storage, _MATRIX_NAMES) is None:
        known = ", ".join(storage.root().keys()) or "nothing"
        raise CalibrationError(f"{path}: no camera_matrix in it; it holds {known}; {READ}")
    return [(storage, storage.getNode("camera_name").string() or path.stem)]


def _first(node: Any, names: tuple[str, ...]) -> Floats | None:
    """The first of these matrices that is there; NaN if its numbers do not fit its shape."""
    for name in names:
        found = node.getNode(name)
        if not found.empty() and found.isMap():
            try:
                return np.asarray(found.mat(), dtype=np.float64)
            except cv2.error:
                return np.full((1, 1), np.nan)
    return None


def _model(nodes: tuple[Any, ...], place: str) -> Projection:
    """The lens model stated by the file or the camera's own part of it."""
    models = []
    for node in nodes:
        said = {key: node.getNode(key).string() for key in _MODEL_NAMES}
        for key in _FISHEYE_FLAGS:
            flag = node.getNode(key)
            if not flag.empty() and (flag.isInt() or flag.isReal()) and flag.real() != 0:
                said[key] = "fisheye" if flag.real() == 1 else f"{flag.real():g}"
        models.append(stated_model(place, said))
    return "fisheye" if "fisheye" in models else "pinhole"


def _intrinsics(storage: Any, node: Any, path: Path, name: str) -> Intrinsics:
    model = _model((storage, node), f"{path}: camera '{name}'")
    matrix = _first(node, _MATRIX_NAMES)
    distortion = _first(node, _DISTORTION_NAMES)
    width, height = node.getNode("image_width"), node.getNode("image_height")
    if matrix is None or matrix.shape != (3, 3):
        raise CalibrationError(f"{path}: camera '{name}' has no 3x3 camera_matrix")
    if not is_camera_matrix(matrix):
        raise CalibrationError(f"{path}: camera '{name}': {NO_CAMERA_MATRIX}")
    if distortion is not None and not np.isfinite(distortion).all():
        raise CalibrationError(f"{path}: camera '{name}': distortion coefficients must be finite")
    if width.empty() or height.empty():
        raise CalibrationError(
            f"{path}: camera '{name}' has no image_width and image_height, "
            "without which its fit to the images cannot be checked"
        )
    try:
        coefficients = distortion8(np.zeros(0) if distortion is None else distortion, model)
    except CalibrationError as problem:
        raise CalibrationError(f"{path}: camera '{name}': {problem}") from None
    size = int(width.real()), int(height.real())
    return Intrinsics(size, matrix, coefficients, model=model)
