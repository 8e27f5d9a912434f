"""Calibrations of aniposelib and caliscope: TOML whose poses are camera_from_world."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, Projection
from measure.model.camera import check_coefficients
from measure.session.calibration_file import Calibration, CameraMatrix, Row, Triple
from measure.session.toml_errors import validation_message
from measure.session.toml_text import dump_toml

Unit = Literal["mm", "cm", "m"]
MM_PER: dict[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_MAX_ROTATION_RAD = 100.0
"""Of a component of a rotation vector: a few turns."""


class ForeignCamera(BaseModel):
    """What both programs write of a camera; what we do not need is passed over."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    name: str | None = None
    cam_id: int | str | None = None
    port: int | str | None = None
    size: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    matrix: CameraMatrix
    distortions: Row
    rotation: Triple | tuple[Triple, Triple, Triple]
    translation: Triple
    error: FiniteFloat | None = None
    fisheye: bool = False
    ignore: bool = False

    def camera(self, name: str, mm_per_unit: float) -> Camera:
        """As the model's camera."""
        camera_from_world = RigidTransform(
            rotation_matrix(np.array(self.rotation)), mm_per_unit * np.array(self.translation)
        )
        model: Projection = "fisheye" if self.fisheye else "pinhole"
        distortion = distortion8(self.distortions, model)
        intrinsics = Intrinsics(self.size, np.array(self.matrix), distortion, model=model)
        return Camera(name, intrinsics, camera_from_world.inverse(), None, self.error)


def is_foreign_toml(values: Mapping[str, Any]) -> bool:
    """Whether parsed TOML is aniposelib's or caliscope's rather than ours."""
    return not isinstance(values.get("cameras"), list) and bool(_camera_tables(values))


def read_foreign_toml(
    path: Path, text: str, values: Mapping[str, Any], unit: Unit | None
) -> Calibration:
    """Read aniposelib's or caliscope's tables of cameras.

    Args:
        path: for messages.
        text: for messages with a line.
        values: the parsed file.
        unit: of the translations. If omitted: metres for caliscope, which knows no other; for
            aniposelib, which writes the unit of its board, what `[metadata]` says, else mm.

    Raises:
        CalibrationError: a table cannot be used, or the lens model is not supported.
    """
    caliscope = isinstance(values.get("cameras"), Mapping)
    metadata = values.get("metadata")
    stated = metadata.get("unit") if isinstance(metadata, Mapping) and not caliscope else None
    mm_per_unit = mm_per(path, stated, unit or ("m" if caliscope else None))
    cameras = []
    for keys, table in _camera_tables(values):
        if table.get("ignore"):
            continue
        if caliscope and not {"rotation", "translation"} <= table.keys():
            raise CalibrationError(f"{path}: camera {keys[-1]} has no pose (rotation, translation)")
        try:
            given = ForeignCamera.model_validate(table)
        except ValidationError as problem:
            message = validation_message(path, text, problem, ForeignCamera, table, keys)
            raise CalibrationError(message) from None
        number = given.cam_id if given.cam_id is not None else given.port
        name = given.name or (keys[-1] if number is None else f"cam_{number}")
        try:
            cameras.append(given.camera(name, mm_per_unit))
        except CalibrationError as problem:
            raise CalibrationError(f"{path}: camera {keys[-1]}: {problem}") from None
    program = "caliscope" if caliscope else "aniposelib"
    return Calibration(tuple(cameras), {"format": program, "mm_per_unit": mm_per_unit})


def mm_per(path: Path, stated: object, given: Unit | None) -> float:
    """Millimetres in the unit of a file's translations.

    Args:
        path: for messages.
        stated: the file's own word for it, None or "" where there is none: mm.
        given: goes before it.

    Raises:
        CalibrationError: the file's word is no unit that we know.
    """
    unit = given or stated or "mm"
    if not isinstance(unit, str) or unit not in MM_PER:
        raise CalibrationError(
            f"{path}: unit {unit!r}: it may be mm, cm or m; calibration_unit in [session] goes "
            "before it"
        )
    return MM_PER[unit]


def write_anipose(path: Path, calibration: Calibration) -> None:
    """Write aniposelib's TOML, in mm."""
    tables: dict[str, Any] = {
        f"cam_{i}": {"name": camera.name, **_foreign_values(camera, "mm")}
        for i, camera in enumerate(calibration.cameras)
    }
    tables["metadata"] = {"adjusted": False, "error": _worst_rms(calibration), "unit": "mm"}
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


def rotation_matrix(rotation: Floats) -> Floats:
    """A rotation vector (3,) or matrix (3, 3), as a matrix.

    Raises:
        CalibrationError: the matrix is no rotation.
    """
    if rotation.size == 3:
        if np.max(np.abs(rotation)) > _MAX_ROTATION_RAD:
            raise CalibrationError(
                f"its rotation vector of {np.max(np.abs(rotation)):.3g} is none: is it in rad?"
            )
        return RigidTransform.from_rotvec(rotation.reshape(3)).rotation
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise CalibrationError(
            f"not a rotation: determinant {np.linalg.det(rotation):.3f}, R R^T differs from 1 by "
            f"{np.abs(rotation @ rotation.T - np.eye(3)).max():.2g}"
        )
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt


def distortion8(values: Row | Floats, model: Projection) -> Floats:
    """OpenCV coefficients without the thin-prism and tilt terms, which must be zero.

    Raises:
        CalibrationError: they are not, or their number is none of the lens model's.
    """
    given = np.asarray(values, dtype=np.float64).reshape(-1)
    longest = 4 if model == "fisheye" else 8
    if given.size > longest and not given[longest:].any():
        given = given[:longest]
    try:
        check_coefficients(given, model)
    except ValueError as problem:
        raise CalibrationError(str(problem)) from None
    return given


def opencv_distortion(camera: Camera) -> Floats:
    """The shortest OpenCV vector (5 or 8; 4 of a fisheye) that holds a camera's distortion."""
    distortion = camera.intrinsics.coefficients
    return distortion if distortion[5:].any() else distortion[:5]


def _camera_tables(values: Mapping[str, Any]) -> list[tuple[tuple[str, ...], Mapping[str, Any]]]:
    nested = values.get("cameras")
    if isinstance(nested, Mapping):
        return [(("cameras", k), v) for k, v in nested.items() if isinstance(v, Mapping)]
    return [
        ((key,), table)
        for key, table in values.items()
        if isinstance(table, Mapping) and "matrix" in table
    ]


def _foreign_values(camera: Camera, unit: Unit) -> dict[str, Any]:
    rotation, _ = cv2.Rodrigues(camera.camera_from_world.rotation)
    return {
        "size": list(camera.intrinsics.size_wh),
        "matrix": camera.intrinsics.matrix,
        "distortions": opencv_distortion(camera),
        "fisheye": camera.intrinsics.model == "fisheye",
        "rotation": np.asarray(rotation).reshape(3),
        "translation": camera.camera_from_world.translation / MM_PER[unit],
    }


def _worst_rms(calibration: Calibration) -> float:
    known = [c.reprojection_rms_px for c in calibration.cameras if c.reprojection_rms_px]
    return max(known, default=0.0)
