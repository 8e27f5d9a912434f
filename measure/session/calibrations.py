"""Calibrations whatever their format, checked for what no single camera shows."""

from __future__ import annotations

import logging
import tomllib
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.model import Camera, Intrinsics
from measure.reading import parse_toml, read_text
from measure.session import calibration_file
from measure.session.files import check_name, dump_toml
from measure.session.interchange_tables import is_foreign_toml, read_tables
from measure.session.interchange_xml import read_xml
from measure.session.stated_rig import MM_PER, Sizes, StatedRig, Unit, plain_values

_log = logging.getLogger(__name__)

Format = Literal["triball", "anipose", "caliscope", "opencv"]

_FOCAL_SIZES = 0.05, 200.0
"""Least and largest focal length of what may be a lens, in sizes of its picture."""
_MIDDLE, _SAME_PX = (0.25, 0.5, 0.75), 0.01
_MAX_DISTORTION_RATIO, _NEAR_SHARE = 3.0, 0.01
"""Largest ratio of distorted to ideal distance from the principal point in the middle half of the
picture, and the share of the picture added to both."""
_MAX_SPREAD_MM = 1e6
METRES_SPREAD_MM = 3.0
"""Cameras all within this many "mm" of the first were surely written in metres."""


def read_calibration(
    path: Path | str, unit: Unit | None = None, pictures: Sizes | None = None
) -> calibration_file.Calibration:
    """Read a calibration: ours or another program's, told apart by content.

    For files of other programs: the unit of their translations, if they state none; and names of
    the cameras that are wanted, with the sizes of their pictures, if they number their cameras or
    state no sizes. CalibrationError: the file cannot be used, two cameras share a name, or the
    translations cannot be in the unit taken.
    """
    path = Path(path)
    text = read_text(path, CalibrationError)
    stated = _foreign(path, text)
    if stated is None:
        calibration = calibration_file.read_own_calibration(path)
    else:
        calibration = stated.calibration(path, unit, pictures or {})
    check_calibration(calibration, str(path))
    return calibration


def read_intrinsics(path: Path | str) -> dict[str, Intrinsics]:
    """The lenses alone, by camera name, poses or not; CalibrationError if there are none."""
    path = Path(path)
    stated = _foreign(path, read_text(path, CalibrationError))
    if stated is not None:
        return stated.lenses(path)
    return {camera.name: camera.intrinsics for camera in read_calibration(path).cameras}


def _foreign(path: Path, text: str) -> StatedRig | None:
    """The rig in a file of another program; None if it is ours."""
    values: dict[str, object] | None = None
    with suppress(tomllib.TOMLDecodeError):
        values = parse_toml(text)
    if values is not None and is_foreign_toml(values):
        return read_tables(path, values)
    if values is not None or path.suffix.lower() == ".toml":
        return None
    if text.lstrip().startswith("<") and "<opencv_storage" not in text:
        return read_xml(path, text)
    return read_tables(path, plain_values(path, text))


def write_calibration(
    path: Path | str, calibration: calibration_file.Calibration, file_format: Format = "triball"
) -> None:
    """Write a calibration; only our own format holds covariances, shutters and provenance.

    Translations are in mm, of "caliscope" in m; for "opencv" the ending chooses YAML, XML or JSON.
    """
    cameras = calibration.cameras
    lost = {
        "rolling shutter (readout_s)": [c.name for c in cameras if c.readout_s],
        "lateral colour": [c.name for c in cameras if any(c.intrinsics.lateral_color or ())],
    }
    for what, names in lost.items():
        if names and file_format != "triball":
            _log.warning(
                "%s: a file for %s cannot hold the %s of %s: what is measured with it will be off",
                path,
                file_format,
                what,
                ", ".join(names),
            )
    writers = {
        "triball": calibration_file.write_own_calibration,
        "anipose": write_anipose,
        "caliscope": write_caliscope,
        "opencv": write_opencv,
    }
    writers[file_format](Path(path), calibration)


def check_calibration(calibration: calibration_file.Calibration, source: str) -> None:
    """Refuse (CalibrationError) what cannot be right.

    No camera, two of one name, a lens that there cannot be, or all so close together that their
    translations must be metres, or so far apart that they cannot be mm.
    """
    names = calibration.names
    if not names:
        raise CalibrationError(f"{source}: holds no calibrated camera")
    for name in names:
        try:
            check_name(name)
        except ValueError as problem:
            raise CalibrationError(f"{source}: a camera's name: {problem}") from None
        if names.count(name) > 1:
            raise CalibrationError(f"{source}: camera '{name}' is there {names.count(name)} times")
    for camera in calibration.cameras:
        if not _is_a_lens(camera.intrinsics):
            raise CalibrationError(
                f"{source}: camera '{camera.name}': no lens sees pictures of "
                f"{camera.intrinsics.size_wh[0]}x{camera.intrinsics.size_wh[1]} px with this "
                "matrix and distortion: are they in px, and of this camera?"
            )
    if len(names) < 2:
        return
    centers = np.stack([camera.center for camera in calibration.cameras])
    with np.errstate(over="ignore"):
        spread = float(np.linalg.norm(centers - centers[0], axis=1).max())
    if spread < METRES_SPREAD_MM:
        raise CalibrationError(
            f"{source}: the cameras stand within {spread:.3g} mm of each other: the translations "
            "look like metres; write mm, or for another program's file say calibration_unit = "
            '"m" in [session]'
        )
    if spread > _MAX_SPREAD_MM:
        raise CalibrationError(
            f"{source}: the cameras stand up to {spread:.3g} mm apart: are the translations in mm?"
        )


def _is_a_lens(lens: Intrinsics) -> bool:
    """Whether the middle half of the picture is seen along rays that lead back to it."""
    if not _FOCAL_SIZES[0] <= lens.focal_px / max(lens.size_wh) <= _FOCAL_SIZES[1]:
        return False
    if abs(lens.matrix[0, 1]) > lens.focal_px:  # rows of pixels more than 45 deg askew
        return False
    pixels = np.array([(u, v) for u in _MIDDLE for v in _MIDDLE]) * lens.size_wh
    straight = replace(lens, distortion=np.zeros(8))
    with np.errstate(all="ignore"):
        rays = lens.unproject(pixels)
        moved = np.abs(lens.project(rays) - pixels)
        seen, ideal = (
            np.linalg.norm(places - lens.matrix[:2, 2], axis=1) + _NEAR_SHARE * max(lens.size_wh)
            for places in (pixels, straight.project(rays))
        )
        bent = np.maximum(seen / ideal, ideal / seen)
    return bool(np.all(moved < _SAME_PX) and np.all(bent < _MAX_DISTORTION_RATIO))


def write_anipose(path: Path, calibration: calibration_file.Calibration) -> None:
    """Write aniposelib's TOML, in mm."""
    tables: dict[str, Any] = {
        f"cam_{i}": {"name": camera.name, **_foreign_values(camera, "mm")}
        for i, camera in enumerate(calibration.cameras)
    }
    known = [c.reprojection_rms_px for c in calibration.cameras if c.reprojection_rms_px]
    worst = max(known, default=0.0)
    tables["metadata"] = {"adjusted": False, "error": worst, "unit": "mm"}
    path.write_text(dump_toml(tables), encoding="utf-8")


def write_caliscope(path: Path, calibration: calibration_file.Calibration) -> None:
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


def write_opencv(path: Path, calibration: calibration_file.Calibration) -> None:
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
