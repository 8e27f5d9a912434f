"""Writing OpenCV's calibration files (YAML, XML or JSON of `cv2.FileStorage`)."""

from __future__ import annotations

from pathlib import Path

import cv2

from measure.errors import CalibrationError
from measure.session.calibration_file import Calibration
from measure.session.interchange_toml import opencv_distortion


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
