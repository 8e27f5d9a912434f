"""Calibrations of other programs: which file is whose, and how ours is written for them."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from measure.arrays import Floats
from measure.bags import is_bag, split_topic
from measure.errors import CalibrationError
from measure.model import Camera
from measure.reading import parse_toml
from measure.session import MM_PER, Calibration, Format, StatedRig, Unit, dump_toml
from measure_formats.bag_lenses import read_camera_infos
from measure_formats.plain_values import READ, plain_values
from measure_formats.rig_slam import read_colmap, read_slam
from measure_formats.rig_tables import is_foreign_toml, read_tables
from measure_formats.rig_xml import read_xml

_ZED = {"LEFT_CAM", "RIGHT_CAM"}  # What its tables are called, before the size of the pictures


def read_rig(path: Path, text: str) -> StatedRig | None:
    """The cameras in a file of one of these programs; None if it is nobody's of them."""
    if is_bag(split_topic(path)[0]):
        return read_camera_infos(path)
    try:
        values = parse_toml(text)
    except tomllib.TOMLDecodeError:
        if path.suffix.lower() == ".toml":
            return None
    else:
        if _ZED & {str(key).upper().rpartition("_")[0] for key in values}:
            raise CalibrationError(
                f"{path}: is of a ZED, whose file places the right camera by angles of its own "
                f"definition: it is not read; {READ}"
            )
        return read_tables(path, values) if is_foreign_toml(values) else None
    if text.lstrip().startswith("<") and "<opencv_storage" not in text:
        return read_xml(path, text)
    if (rig := read_colmap(path, text)) is not None:
        return rig
    values = plain_values(path, text)
    return read_slam(path, values) or read_tables(path, values)


def write_anipose(path: Path, calibration: Calibration) -> None:
    """Write aniposelib's TOML, in mm."""
    tables: dict[str, Any] = {
        f"cam_{i}": {"name": camera.name, **_foreign_values(camera, "mm")}
        for i, camera in enumerate(calibration.cameras)
    }
    known = [c.reprojection_rms_px for c in calibration.cameras if c.reprojection_rms_px]
    worst = max(known, default=0.0)
    tables["metadata"] = {"adjusted": False, "error": worst, "unit": "mm"}
    path.write_text(dump_toml(tables), encoding="utf-8")


def write_caliscope(path: Path, calibration: Calibration) -> None:
    """Write caliscope's `camera_array.toml`, in metres."""
    tables = {
        str(i): {
            "cam_id": i,
            "name": camera.name,
            "rotation_count": 0,
            "error": camera.reprojection_rms_px,
            **_foreign_values(camera, "m"),
        }
        for i, camera in enumerate(calibration.cameras)
    }
    path.write_text(dump_toml({"cameras": tables}), encoding="utf-8")


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
        out.write("distortion_coefficients", _opencv_distortion(camera).reshape(-1, 1))
        out.write("R", camera.camera_from_world.rotation)
        out.write("T", camera.camera_from_world.translation.reshape(3, 1))
        if camera.reprojection_rms_px is not None:
            out.write("avg_reprojection_error", camera.reprojection_rms_px)
        out.endWriteStruct()
    out.endWriteStruct()
    out.release()


def _opencv_distortion(camera: Camera) -> Floats:
    """The shortest OpenCV vector (5 or 8; 4 of a fisheye) that holds a camera's distortion."""
    distortion = camera.intrinsics.coefficients
    return distortion if distortion[5:].any() else distortion[:5]


def _foreign_values(camera: Camera, unit: Unit) -> dict[str, Any]:
    rotation, _ = cv2.Rodrigues(camera.camera_from_world.rotation)
    return {
        "size": list(camera.intrinsics.size_wh),
        "matrix": camera.intrinsics.matrix,
        "distortions": _opencv_distortion(camera),
        "fisheye": camera.intrinsics.model == "fisheye",
        "rotation": np.asarray(rotation).reshape(3),
        "translation": camera.camera_from_world.translation / MM_PER[unit],
    }


RIGS = Format("rigs", READ, read_calibration=read_rig)
ANIPOSE = Format("anipose", "aniposelib's TOML", write_calibration=write_anipose)
CALISCOPE = Format("caliscope", "caliscope's camera_array.toml", write_calibration=write_caliscope)
OPENCV = Format(
    "opencv", "OpenCV's YAML, XML or JSON, as the name ends", write_calibration=write_opencv
)
