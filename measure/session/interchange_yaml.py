"""Lenses and rigs in plain YAML: ROS's `camera_info` files and Kalibr's `camchain`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, Projection
from measure.session.calibration_file import NO_CAMERA_MATRIX, Calibration, is_camera_matrix
from measure.session.interchange_toml import Unit, distortion8, mm_per, rotation_matrix

_MODELS: dict[str, Projection] = {
    **dict.fromkeys(("fisheye", "equidistant", "equi", "kannala_brandt", "kb4"), "fisheye"),
    **dict.fromkeys(
        ("", "none", "plumb_bob", "rational_polynomial", "radtan", "pinhole", "opencv"), "pinhole"
    ),
}
"""What programs call the lens models that are read."""


def yaml_values(text: str) -> Mapping[str, Any] | None:
    """The tables of a `camera_info` or `camchain` file; None if it is neither."""
    try:
        values = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError):
        return None
    if isinstance(values, Mapping) and ("camera_matrix" in values or _chain(values)):
        return values
    return None


def read_yaml(path: Path, values: Mapping[str, Any], unit: Unit | None) -> Calibration:
    """Read Kalibr's chain of cameras; the first one is the world.

    Each camera's `T_cn_cnm1` takes points from the camera before it (Kalibr, "Yaml formats").

    Args:
        path: for messages.
        values: as `yaml_values` gives them.
        unit: of the translations; metres if omitted.

    Raises:
        CalibrationError: a camera without matrix, picture size or pose, or of another lens model.
    """
    lenses = read_yaml_intrinsics(path, values)
    if "camera_matrix" in values:
        raise CalibrationError(
            f"{path}: holds the lens of '{next(iter(lenses))}' but no pose, as ROS writes it: "
            "name it in a capture and locate the camera with measure calibrate"
        )
    scale = mm_per(path, None, unit or "m")
    camera_from_world, cameras = RigidTransform.identity(), []
    for index, (name, table) in enumerate(_chain(values).items()):
        if index:
            step = _transform(table.get("T_cn_cnm1"), f"{path}: camera '{name}'", scale)
            camera_from_world = step @ camera_from_world
        cameras.append(Camera(name, lenses[name], camera_from_world.inverse()))
    return Calibration(tuple(cameras), {"format": "kalibr", "mm_per_unit": scale})


def read_yaml_intrinsics(path: Path, values: Mapping[str, Any]) -> dict[str, Intrinsics]:
    """The lenses alone, by camera name.

    Raises:
        CalibrationError: a camera without matrix or picture size, or of another lens model.
    """
    if "camera_matrix" in values:
        name = str(values.get("camera_name") or path.stem)
        return {name: _ros_lens(values, f"{path}: camera '{name}'")}
    return {
        name: _kalibr_lens(table, f"{path}: camera '{name}'")
        for name, table in _chain(values).items()
    }


def stated_model(place: str, said: Mapping[str, object]) -> Projection:
    """The lens model that a file states under some keys, a pinhole if it does not.

    Raises:
        CalibrationError: it is one by whose numbers another one would be misread.
    """
    models = set()
    for key, value in said.items():
        name = "" if value is None else str(value).lower().replace("-", "_")
        if name not in _MODELS:
            raise CalibrationError(
                f"{place}: {key} is '{value}': only lenses of OpenCV's plumb_bob, "
                "rational_polynomial and fisheye (equidistant) models are read; calibrate with "
                "such a lens model"
            )
        models.add(_MODELS[name])
    return "fisheye" if "fisheye" in models else "pinhole"


def _chain(values: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Kalibr's tables by camera name, in the order of their numbers."""
    found = {
        str(name): table
        for name, table in values.items()
        if isinstance(table, Mapping) and {"intrinsics", "resolution"} <= table.keys()
    }
    return dict(sorted(found.items(), key=lambda pair: (len(pair[0]), pair[0])))


def _ros_lens(values: Mapping[str, Any], place: str) -> Intrinsics:
    model = stated_model(place, {"distortion_model": values.get("distortion_model")})
    matrix = _numbers(values.get("camera_matrix"), place, "camera_matrix", 9).reshape(3, 3)
    distortion = _numbers(values.get("distortion_coefficients"), place, "distortion_coefficients")
    size = (values.get("image_width"), values.get("image_height"))
    return _lens(size, matrix, distortion, model, place)


def _kalibr_lens(table: Mapping[str, Any], place: str) -> Intrinsics:
    keys = ("camera_model", "distortion_model")
    model = stated_model(place, {key: table.get(key) for key in keys})
    fx, fy, cx, cy = _numbers(table["intrinsics"], place, "intrinsics", 4)
    distortion = _numbers(table.get("distortion_coeffs"), place, "distortion_coeffs")
    size = table["resolution"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return _lens(size, matrix, distortion, model, place)


def _lens(
    size: object, matrix: Floats, distortion: Floats, model: Projection, place: str
) -> Intrinsics:
    whole = isinstance(size, list | tuple) and all(type(n) is int and n > 0 for n in size)
    if not (whole and isinstance(size, list | tuple) and len(size) == 2):
        raise CalibrationError(f"{place}: its picture size is no two whole numbers")
    if not is_camera_matrix(matrix):
        raise CalibrationError(f"{place}: {NO_CAMERA_MATRIX}")
    try:
        coefficients = distortion8(distortion, model)
    except CalibrationError as problem:
        raise CalibrationError(f"{place}: {problem}") from None
    return Intrinsics((size[0], size[1]), matrix, coefficients, model=model)


def _numbers(value: object, place: str, key: str, count: int | None = None) -> Floats:
    """A list of finite numbers, perhaps as the `data` of a matrix; none if it is left out."""
    given = value.get("data") if isinstance(value, Mapping) else value
    try:
        numbers = np.array([] if given is None else given, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all() or (count is not None and len(numbers) != count):
        many = "" if count is None else f"{count} "
        raise CalibrationError(f"{place}: {key} is no list of {many}finite numbers")
    return numbers


def _transform(value: object, place: str, scale: float) -> RigidTransform:
    matrix = _numbers(value, place, "T_cn_cnm1", 16).reshape(4, 4)
    try:
        return RigidTransform(rotation_matrix(matrix[:3, :3]), scale * matrix[:3, 3])
    except CalibrationError as problem:
        raise CalibrationError(f"{place}: {problem}") from None
