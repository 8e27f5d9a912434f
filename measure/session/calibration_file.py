"""`calibration.toml`: cameras, their poses and how well these are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    FiniteFloat,
    ValidationInfo,
    field_validator,
    model_validator,
)

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, Projection
from measure.model.camera_rows import check_coefficients
from measure.reading import FileModel
from measure.session.files import SafeName, dump_toml, load_toml

Triple = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Row = list[FiniteFloat]
NO_CAMERA_MATRIX = "not a camera matrix [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
LONGEST_READOUT_S = 0.2
UNSTATED_SCALE_SD = 6e-4
"""Standard deviation of the world's scale where a calibration states none: balls 76 mm apart show
no less (docs/explanation/uncertainty.md)."""
JOINT_COVARIANCE = "joint_covariance"
"""Key of the provenance: of all poses and free lens parameters together, in the cameras' order."""
UNIT_TOLERANCE = 1e-3  # How far the length of a written quaternion may be from 1


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated cameras."""

    cameras: tuple[Camera, ...]
    # where it comes from: program, version, date, capture, judgement; free.
    provenance: Mapping[str, Any] = field(default_factory=dict)
    # standard deviation of the factor by which all distances from the world's origin may be off.
    scale_sd: float = UNSTATED_SCALE_SD

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(camera.name for camera in self.cameras)

    def camera(self, name: str) -> Camera:
        """The camera called `name`; CalibrationError if there is none."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise CalibrationError(
            f"no calibration of camera '{name}'; there is one of {', '.join(self.names)}"
        )


def is_camera_matrix(matrix: Floats) -> bool:
    """Whether (3, 3) is [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]."""
    lower = np.abs([matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1]).max()
    return bool(np.isfinite(matrix).all() and matrix[0, 0] > 0 < matrix[1, 1] and lower < 1e-9)


def _camera_matrix(value: tuple[Triple, Triple, Triple]) -> tuple[Triple, Triple, Triple]:
    if not is_camera_matrix(np.array(value)):
        raise ValueError(NO_CAMERA_MATRIX)
    return value


CameraMatrix = Annotated[tuple[Triple, Triple, Triple], AfterValidator(_camera_matrix)]


Magnification = Annotated[FiniteFloat, Field(ge=-0.01, le=0.01)]


class CameraModel(FileModel):
    """One `[[cameras]]` table; the pose is world_from_camera."""

    name: SafeName
    size_wh: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
    matrix: CameraMatrix
    model: Projection = "pinhole"
    distortion: Annotated[Row, Field(default_factory=list)]
    quat_wxyz: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    translation_mm: Triple
    reprojection_rms_px: Annotated[FiniteFloat, Field(ge=0)] | None = None
    pose_covariance: list[Row] | None = None
    intrinsics_covariance: list[Row] | None = None
    pose_intrinsics_covariance: list[Row] | None = None
    lateral_color: tuple[Magnification, Magnification] | None = None
    readout_s: Annotated[FiniteFloat, Field(ge=-LONGEST_READOUT_S, le=LONGEST_READOUT_S)] = 0.0

    @field_validator("distortion")
    @classmethod
    def _is_of_the_model(cls, value: Row, given: ValidationInfo) -> Row:
        check_coefficients(value, given.data.get("model", "pinhole"))
        return value

    @field_validator("quat_wxyz")
    @classmethod
    def _is_rotation(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        length = float(np.linalg.norm(value))
        if abs(length - 1) > UNIT_TOLERANCE:
            raise ValueError(f"not a rotation: the quaternion's length is {length:.4g}, not 1")
        return value

    @field_validator("pose_covariance", "intrinsics_covariance")
    @classmethod
    def _is_covariance(cls, value: list[Row] | None) -> list[Row] | None:
        return value if value is None else _checked_covariance(value)

    @model_validator(mode="after")
    def _sizes_fit(self) -> CameraModel:
        for name, size in (("pose_covariance", 6), ("intrinsics_covariance", 12)):
            value = getattr(self, name)
            if value is not None and len(value) != size:
                raise ValueError(f"{name} must be {size}x{size}, got {len(value)}x{len(value)}")
        cross = self.pose_intrinsics_covariance
        if cross is not None:
            if [len(row) for row in cross] != [12] * 6:
                raise ValueError("pose_intrinsics_covariance must be 6x12")
            if self.pose_covariance is None or self.intrinsics_covariance is None:
                raise ValueError("pose_intrinsics_covariance needs the other two covariances")
            P, C, lens = map(np.array, (self.pose_covariance, cross, self.intrinsics_covariance))
            _checked_covariance(np.block([[P, C], [C.T, lens]]).tolist())
        return self

    def camera(self) -> Camera:
        """As the model's camera."""
        stated = (self.intrinsics_covariance, self.pose_covariance, self.pose_intrinsics_covariance)
        of_lens, of_pose, of_both = (None if P is None else np.array(P) for P in stated)
        matrix, distortion = np.array(self.matrix), np.array(self.distortion)
        intrinsics = Intrinsics(
            self.size_wh, matrix, distortion, of_lens, self.model, self.lateral_color
        )
        pose = RigidTransform.from_quat_wxyz(self.quat_wxyz, self.translation_mm)
        rms_px = self.reprojection_rms_px
        return Camera(self.name, intrinsics, pose, of_pose, rms_px, of_both, self.readout_s)


class CalibrationModel(FileModel):
    """A whole `calibration.toml`."""

    cameras: Annotated[Sequence[CameraModel], Field(min_length=1)]
    scale_sd: Annotated[FiniteFloat, Field(ge=0, lt=1)] = UNSTATED_SCALE_SD
    provenance: Annotated[dict[str, Any], Field(default_factory=dict)]


class LensModel(CameraModel):
    """One `[[cameras]]` table; only its lens is used: the pose may be absent."""

    quat_wxyz: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] = (1.0, 0.0, 0.0, 0.0)
    translation_mm: Triple = (0.0, 0.0, 0.0)


class LensesModel(CalibrationModel):
    """A whole `calibration.toml`; only its lenses are used."""

    cameras: Annotated[Sequence[LensModel], Field(min_length=1)]


def read_own_lenses(path: Path) -> Calibration:
    """As `read_own_calibration`, but cameras without a pose stand in the world's origin."""
    given = load_toml(path, LensesModel, CalibrationError)
    return Calibration(tuple(camera.camera() for camera in given.cameras))


def read_own_calibration(path: Path) -> Calibration:
    """Read our own format; CalibrationError with file, line and key where it cannot be used."""
    given = load_toml(path, CalibrationModel, CalibrationError)
    cameras = tuple(camera.camera() for camera in given.cameras)
    return Calibration(cameras, given.provenance, given.scale_sd)


def write_own_calibration(path: Path, calibration: Calibration) -> None:
    """Write `calibration.toml`; `read_calibration` gives back the same numbers."""
    values = {
        "scale_sd": calibration.scale_sd,
        "cameras": [_camera_values(camera) for camera in calibration.cameras],
        "provenance": dict(calibration.provenance) or None,
    }
    path.write_text(dump_toml(values), encoding="utf-8")


def _camera_values(camera: Camera) -> dict[str, Any]:
    return {
        "name": camera.name,
        "size_wh": list(camera.intrinsics.size_wh),
        "matrix": camera.intrinsics.matrix,
        "model": None if camera.intrinsics.model == "pinhole" else camera.intrinsics.model,
        "distortion": camera.intrinsics.coefficients,
        "quat_wxyz": camera.world_from_camera.quat_wxyz,
        "translation_mm": camera.world_from_camera.translation,
        "reprojection_rms_px": camera.reprojection_rms_px,
        "pose_covariance": camera.pose_covariance,
        "intrinsics_covariance": camera.intrinsics.covariance,
        "pose_intrinsics_covariance": camera.pose_intrinsics_covariance,
        "lateral_color": camera.intrinsics.lateral_color,
        "readout_s": camera.readout_s or None,
    }


def _checked_covariance(value: list[Row]) -> list[Row]:
    if any(len(row) != len(value) for row in value):
        raise ValueError(f"not square: {len(value)} rows of {len(value[0])}")
    matrix = np.array(value)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    if np.abs(matrix - matrix.T).max() > 1e-6 * np.abs(matrix).max():
        raise ValueError("a covariance must be symmetric")
    if np.diag(matrix).min() < 0 or np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0] < -1e-6:
        raise ValueError("a covariance must not have negative eigenvalues")
    return value
