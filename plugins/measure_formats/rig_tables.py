"""Rigs in tables: of aniposelib, Kalibr, MC-Calib, multical, EasyMocap, OpenCV and ROS."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.reading import LARGEST, read_text
from measure.session import StatedCamera, StatedRig, stated_model
from measure_formats.plain_values import READ, plain_values

Table = Mapping[str, Any]

_MATRIX = ("camera_matrix", "cameramatrix", "matrix", "k", "mtx")
_DISTORTION = (
    *("distortion_coefficients", "distortion_coeffs", "distortion_vector", "distcoeffs"),
    *("dist_coeffs", "dist_coeff", "distortions", "distortion", "dist", "d"),
)
_MODEL = (
    *("distortion_model", "camera_model", "lens_model", "model"),
    *("fisheye_model", "fisheye", "is_fisheye", "distortion_type"),
)
_ROTATION, _TRANSLATION = ("rotation", "r", "rvec"), ("translation", "t", "tvec")
_WIDTHS, _HEIGHTS = ("image_width", "img_width", "width"), ("image_height", "img_height", "height")
_SIZES = ("image_size", "imagesize", "resolution", "size")
_RMS = ("avg_reprojection_error", "error")
_SIDES = (("1", "2"), ("_1", "_2"), ("_left", "_right"), ("_l", "_r"), ("l", "r"))
"""What ends the names of the two cameras of a stereo pair."""
_MAX_TANGENTIAL = 0.02
"""Largest tangential coefficient of a lens that is accepted where a file names no lens model."""
_STEREO_MATRIX = ("m", *_MATRIX)


def read_tables(path: Path, values: object) -> StatedRig | None:
    """The cameras of a file of another program; None if it is none, CalibrationError: broken.

    One that holds lenses alone or poses alone is read with its companion, such as `extri.yml`
    beside `intri.yml`.
    """
    if isinstance(values, Mapping):
        for read in (_anipose, _kalibr, _mc_calib, _multical, _easymocap, _stereo, _opencv):
            rig = read(path, {str(key): value for key, value in values.items()})
            if rig is not None:
                return rig
    return None


def is_foreign_toml(values: Table) -> bool:
    """Whether parsed TOML is aniposelib's or caliscope's rather than ours."""
    return not isinstance(values.get("cameras"), list) and bool(_matrix_tables(values))


def _matrix_tables(values: Table) -> dict[str, Table]:
    nested = values.get("cameras")
    tables = nested if isinstance(nested, Mapping) else values
    kept = {key: table for key, table in tables.items() if isinstance(table, Mapping)}
    return {key: table for key, table in kept.items() if "matrix" in table}


def _anipose(path: Path, values: Table) -> StatedRig | None:
    """Aniposelib's tables, and caliscope's under `cameras`, which knows but metres."""
    cameras = []
    for key, table in _matrix_tables(values).items():
        number = table.get("cam_id", table.get("port"))
        name = str(table.get("name") or (key if number is None else f"cam_{number}"))
        if not table.get("ignore"):
            cameras.append(_camera(name, f"{path}: camera '{name}'", table, {}))
    if isinstance(values.get("cameras"), Mapping):
        return StatedRig("caliscope", tuple(cameras), "m") if cameras else None
    metadata = values.get("metadata")
    unit = metadata.get("unit") if isinstance(metadata, Mapping) else None
    return StatedRig("aniposelib", tuple(cameras), unit) if cameras else None


def _kalibr(path: Path, values: Table) -> StatedRig | None:
    """`camchain.yaml`: each camera's `T_cn_cnm1` takes points from the camera before it, in m.

    OpenVINS states `T_imu_cam`, world_from_camera, in its place; so may Kalibr `T_cam_imu`.
    """
    chain = {
        name: table
        for name, table in values.items()
        if isinstance(table, Mapping) and {"intrinsics", "resolution"} <= table.keys()
    }
    chained = any("T_cn_cnm1" in table for table in chain.values())
    camera_from_world, cameras = np.eye(4), list[StatedCamera]()
    for name, table in sorted(chain.items(), key=lambda pair: (len(pair[0]), pair[0])):
        place = f"{path}: camera '{name}'"
        fx, fy, cx, cy = numbers_in(table["intrinsics"], place, "intrinsics", 4)
        lens = {"camera_matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], **table}
        if not chained and (imu := _imu_pose(table, place)) is not None:
            camera_from_world = imu
        elif cameras:
            step = numbers_in(table.get("T_cn_cnm1"), place, "T_cn_cnm1", 16)
            camera_from_world = step.reshape(4, 4) @ camera_from_world
        pose = camera_from_world[:3, :3], camera_from_world[:3, 3]
        cameras.append(_camera(name, place, lens, values, pose))
    return StatedRig("kalibr", tuple(cameras), "m") if cameras else None


def _imu_pose(table: Table, place: str) -> Floats | None:
    """The pose (4, 4) of a camera in the frame of an inertial sensor, if one is stated."""
    if "T_imu_cam" in table:
        pose = numbers_in(table["T_imu_cam"], place, "T_imu_cam", 16).reshape(4, 4)
        turn = pose[:3, :3].T
        return np.block([[turn, (-turn @ pose[:3, 3])[:, None]], [np.zeros(3), 1.0]])
    if "T_cam_imu" in table:
        return numbers_in(table["T_cam_imu"], place, "T_cam_imu", 16).reshape(4, 4)
    return None


def _mc_calib(path: Path, values: Table) -> StatedRig | None:
    """`calibrated_cameras_data.yml`: `camera_pose_matrix` is world_from_camera."""
    cameras, groups = [], set()
    for name, table in values.items():
        if not (isinstance(table, Mapping) and "camera_pose_matrix" in table):
            continue
        place = f"{path}: camera '{name}'"
        matrix = numbers_in(table["camera_pose_matrix"], place, "camera_pose_matrix", 16)
        turn, center = matrix.reshape(4, 4)[:3, :3].T, matrix.reshape(4, 4)[:3, 3]
        cameras.append(_camera(name, place, table, {}, (turn, -turn @ center)))
        groups.add(table.get("camera_group"))
    if len(groups) > 1:
        raise CalibrationError(
            f"{path}: its cameras are in {len(groups)} groups (camera_group), which MC-Calib could "
            "not relate to each other: calibrate them with common views"
        )
    return StatedRig("mc-calib", tuple(cameras), values.get("unit"), True) if cameras else None


def _multical(path: Path, values: Table) -> StatedRig | None:
    """JSON of multical: `camera_poses` are camera_from_rig, by `a_to_b` or the camera's name."""
    poses, lenses = values.get("camera_poses"), values.get("cameras")
    if not (isinstance(poses, Mapping) and isinstance(lenses, Mapping)):
        return None
    if not all(isinstance(one, Mapping) for one in (*poses.values(), *lenses.values())):
        raise CalibrationError(f"{path}: cameras and camera_poses must be maps of maps; {READ}")
    own = {str(key).partition("_to_")[0]: pose for key, pose in poses.items()}
    cameras = []
    for name, table in lenses.items():
        merged = {**own.get(str(name), {}), **table}
        cameras.append(_camera(str(name), f"{path}: camera '{name}'", merged, {}))
    return StatedRig("multical", tuple(cameras), values.get("unit", "m"))


def _easymocap(path: Path, values: Table) -> StatedRig | None:
    """EasyMocap's `intri.yml` and `extri.yml`: camera_from_world, in metres."""
    names = values.get("names")
    if not isinstance(names, list) or not any(f"{k}_{names[0]}" in values for k in "KRT"):
        return None
    for needed in "KT":
        values = _with_companion(path, values, f"{needed}_{names[0]}")
    cameras = []
    for name in map(str, names):
        own = {key: values.get(f"{key}_{name}") for key in ("K", "dist", "T")}
        own["R"] = values.get(f"Rot_{name}", values.get(f"R_{name}"))
        own["width"], own["height"] = values.get(f"W_{name}"), values.get(f"H_{name}")
        cameras.append(_camera(name, f"{path}: camera '{name}'", own, values))
    return StatedRig("easymocap", tuple(cameras), values.get("unit", "m"))


def _stereo(path: Path, values: Table) -> StatedRig | None:
    """What OpenCV's sample `stereo_calib` writes: R and T take points from camera 1 to 2."""
    rectified = {"R1", "R2", "P1", "P2"} <= values.keys()
    lower = _lower(_with_companion(path, values, "M1") if rectified else values)
    for sides in _SIDES:
        lenses = [_first(lower, _STEREO_MATRIX, side) for side in sides]
        if not all(isinstance(lens, np.ndarray | list | Mapping) for lens in lenses):
            continue
        if not rectified and _first(lower, _ROTATION) is None:
            lower = _lower(_with_companion(path, values, "R"))
        one, two = (
            {"k": lens, "d": _first(lower, _DISTORTION, side)}
            for lens, side in zip(lenses, sides, strict=True)
        )
        placed = {key: lower.get(key) for key in (*_ROTATION, *_TRANSLATION)}
        seen = any(value is not None for value in placed.values())
        start = (np.eye(3), np.zeros(3)) if seen else None
        cameras = (
            _camera("1", f"{path}: camera '1'", one, lower, start),
            _camera("2", f"{path}: camera '2'", {**two, **placed}, lower),
        )
        return StatedRig("opencv stereo", cameras, lower.get("unit"), True)
    return None


def _opencv(path: Path, values: Table) -> StatedRig | None:
    """One camera, or several under `cameras`: camera_from_world."""
    tables = values.get("cameras", [values])
    if not (isinstance(tables, list) and all(isinstance(table, Mapping) for table in tables)):
        raise CalibrationError(f"{path}: cameras must be maps with a camera_matrix each; {READ}")
    if tables[:1] == [values] and _first(_lower(values), _MATRIX) is None:
        return None
    cameras = []
    for index, table in enumerate(tables):
        usual = path.stem if table is values else f"cam{index}"
        name = str(table.get("camera_name") or usual)
        shared = {key: value for key, value in values.items() if key != "cameras"}
        cameras.append(_camera(name, f"{path}: camera '{name}'", table, shared))
    return StatedRig("opencv", tuple(cameras), values.get("unit"))


def _camera(
    name: str, place: str, table: Table, shared: Table, pose: tuple[Floats, Floats] | None = None
) -> StatedCamera:
    """A camera from its table; lens model and picture size may be stated for all."""
    own, common = _lower(table), _lower(shared)
    said = [{key: t.get(key) for key in _MODEL} for t in (common, own)]
    models = [stated_model(place, words) for words in said]
    matrix = numbers_in(_first(own, _MATRIX), place, "camera_matrix", 9)
    distortion = numbers_in(_first(own, _DISTORTION), place, "distortion coefficients")
    unsaid = not any(value is not None for words in said for value in words.values())
    if unsaid and distortion.size == 4 and np.abs(distortion[2:]).max() > _MAX_TANGENTIAL:
        raise CalibrationError(
            f"{place}: four distortion coefficients and no lens model, the last two too large for "
            "p1 p2 of plumb_bob: write camera_model: fisheye (k1 to k4) or camera_model: pinhole"
        )
    turn, shift = _first(own, _ROTATION), _first(own, _TRANSLATION)
    if pose is None and turn is not None and shift is not None:
        rotation = numbers_in(turn, place, "R")
        if rotation.size not in (3, 9):
            raise CalibrationError(f"{place}: its pose is no 3x3 matrix R, nor a vector of 3")
        shape = (3, 3) if rotation.size == 9 else (3,)
        pose = rotation.reshape(shape), numbers_in(shift, place, "T", 3)
    rms = _first(own, _RMS)
    return StatedCamera(
        name,
        matrix.reshape(3, 3),
        distortion,
        "fisheye" if "fisheye" in models else "pinhole",
        _size(own, place) or _size(common, place),
        pose,
        None if rms is None else float(numbers_in(rms, place, _RMS[0], 1)[0]),
    )


def _with_companion(path: Path, values: Table, needed: str) -> Table:
    """The values, with those of the file that holds the other half beside it."""
    if needed in values:
        return values
    for pair in (("intri", "extri"), ("extri", "intri")):
        other = path.with_name(re.sub(*pair, path.name))
        if other != path and other.is_file():
            more = plain_values(other, read_text(other, CalibrationError))
            return {**more, **values} if isinstance(more, Mapping) else values
    return values


def _lower(table: Table) -> dict[str, Any]:
    return {str(key).lower(): value for key, value in table.items()}


def _first(table: Table, names: tuple[str, ...], side: str = "") -> object:
    """What stands under the first of these names that is there."""
    return next((v for name in names if (v := table.get(name + side)) is not None), None)


def _size(table: Table, place: str) -> tuple[int, int] | None:
    """Width and height in px, if they are stated."""
    given = _first(table, _SIZES)
    if given is None:
        given = [_first(table, _WIDTHS), _first(table, _HEIGHTS)]
        if None in given:
            return None
    width, height = numbers_in(given, place, "picture size", 2)
    if min(width, height) < 1 or not float(width).is_integer() or not float(height).is_integer():
        raise CalibrationError(f"{place}: its picture size is no two whole numbers")
    return int(width), int(height)


def numbers_in(value: object, place: str, key: str, count: int | None = None) -> Floats:
    """Finite numbers (n,), perhaps the `data` of a matrix; none if they are left out.

    YAML takes 1e-5 for a text: texts of numbers count as such; a truth value is none.
    """
    given = value.get("data") if isinstance(value, Mapping) else value
    try:
        numbers = np.array([] if given is None else given, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array([np.nan])
    are = (np.abs(numbers) <= LARGEST).all() and not _holds_truth(given)
    if not are or (count is not None and len(numbers) != count):
        many = "" if count is None else f"{count} "
        raise CalibrationError(f"{place}: {key} must be {many}finite numbers, within {LARGEST:g}")
    return numbers


def _holds_truth(value: object) -> bool:
    """Whether true or false stands among values."""
    return isinstance(value, bool) or (isinstance(value, list) and any(map(_holds_truth, value)))
