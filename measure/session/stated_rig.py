"""Cameras as files of other programs state them, and how they become ours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from measure.arrays import Floats
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, Projection
from measure.model.camera_rows import check_coefficients
from measure.session.calibration_file import NO_CAMERA_MATRIX, Calibration, is_camera_matrix

Unit = Literal["mm", "cm", "m"]
MM_PER: dict[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_MAX_ROTATION_RAD = 100.0  # Of a component of a rotation vector: a few turns
_MODELS: dict[str, Projection] = {
    **dict.fromkeys(
        ("fisheye", "equidistant", "equi", "kannala_brandt", "kb4", "1", "true"), "fisheye"
    ),
    **dict.fromkeys(("", "none", "plumb_bob", "rational_polynomial", "rational", "0"), "pinhole"),
    **dict.fromkeys(("radtan", "pinhole", "opencv", "standard", "false"), "pinhole"),
}
"""What programs call the lens models that are read; numbers are MC-Calib's and OpenCV's."""

Sizes = Mapping[str, tuple[int, int]]


@dataclass(frozen=True, eq=False)
class StatedCamera:
    """One camera."""

    name: str
    matrix: Floats  # (3, 3) px
    distortion: Floats  # OpenCV's coefficients of the model
    model: Projection = "pinhole"
    # of its pictures in px; None where the file does not say.
    size_wh: tuple[int, int] | None = None
    # rotation (vector or matrix) and translation, camera_from_world; None if not there.
    pose: tuple[Floats, Floats] | None = None
    rms_px: float | None = None  # of its calibration, or None

    def lens(self, place: str) -> Intrinsics:
        """Its lens; CalibrationError if the numbers are none, or the picture size is unknown."""
        if self.matrix.shape != (3, 3) or not is_camera_matrix(self.matrix):
            raise CalibrationError(f"{place}: {NO_CAMERA_MATRIX}")
        if self.size_wh is None:
            raise CalibrationError(
                f"{place}: has no picture size: write image_width and image_height into it"
            )
        # OpenCV's thin-prism and tilt terms are none of ours, and must be zero.
        given, longest = self.distortion, 4 if self.model == "fisheye" else 8
        if not given[longest:].any():
            given = given[:longest]
        try:
            check_coefficients(given, self.model)
        except ValueError as problem:
            raise CalibrationError(f"{place}: {problem}") from None
        return Intrinsics(self.size_wh, self.matrix, given, model=self.model)


@dataclass(frozen=True, eq=False)
class StatedRig:
    """The cameras of one file."""

    program: str
    cameras: tuple[StatedCamera, ...]
    unit: object = "mm"  # of the translations, as the file or the program has it
    numbered: bool = False  # whether its cameras have no names but numbers

    def calibration(self, path: Path, unit: Unit | None, pictures: Sizes) -> Calibration:
        """As our calibration; CalibrationError if a camera cannot be used, or has no pose.

        `unit` goes before the file's. `pictures`, by camera name in order, are the sizes where the
        file has none, and the names for numbered cameras.
        """
        scale = _mm_per(path, self.unit, unit)
        cameras = []
        named = self._named(pictures)
        for stated in named:
            place = f"{path}: camera '{stated.name}'"
            if stated.pose is None:
                raise CalibrationError(
                    f"{place} has intrinsics but no pose (R and T, camera from world): name the "
                    "file in a capture and locate the camera with measure calibrate"
                )
            rotation, translation = stated.pose
            pose = RigidTransform(_rotation_matrix(place, rotation), scale * translation)
            lens = stated.lens(place)
            cameras.append(Camera(stated.name, lens, pose.inverse(), None, stated.rms_px))
        facts: dict[str, object] = {"format": self.program, "mm_per_unit": scale}
        pairs = zip(named, self.cameras, strict=True)
        if order := [f"{new.name} = {old.name}" for new, old in pairs if new.name != old.name]:
            facts["taken_in_order"] = ", ".join(order)
        return Calibration(tuple(cameras), facts)

    def lenses(self, path: Path) -> dict[str, Intrinsics]:
        """The lenses alone, by camera name; CalibrationError if a camera cannot be used."""
        return {one.name: one.lens(f"{path}: camera '{one.name}'") for one in self.cameras}

    def _named(self, pictures: Sizes) -> list[StatedCamera]:
        names = [camera.name for camera in self.cameras]
        if self.numbered and len(names) == len(pictures) and not set(names) & set(pictures):
            names = list(pictures)
        return [
            replace(camera, name=name, size_wh=camera.size_wh or pictures.get(name))
            for camera, name in zip(self.cameras, names, strict=True)
        ]


def stated_model(place: str, said: Mapping[str, object]) -> Projection:
    """The lens model a file states under some keys, or a pinhole; CalibrationError: unknown."""
    models = set()
    for key, value in said.items():
        name = "" if value is None else str(value).lower().replace("-", "_").removesuffix(".0")
        if name not in _MODELS:
            raise CalibrationError(
                f"{place}: {key} is '{value}': only lenses of OpenCV's plumb_bob, "
                "rational_polynomial and fisheye (equidistant) models are read; calibrate with "
                "such a lens model"
            )
        models.add(_MODELS[name])
    return "fisheye" if "fisheye" in models else "pinhole"


def _mm_per(path: Path, stated: object, given: Unit | None) -> float:
    """Millimetres in the unit of a file's translations."""
    unit = given or stated or "mm"
    if not isinstance(unit, str) or unit not in MM_PER:
        raise CalibrationError(
            f"{path}: unit {unit!r}: it may be mm, cm or m; calibration_unit in [session] goes "
            "before it"
        )
    return MM_PER[unit]


def _rotation_matrix(place: str, rotation: Floats) -> Floats:
    """A rotation vector (3,) or matrix (3, 3), as a matrix."""
    if rotation.size == 3:
        if np.max(np.abs(rotation)) > _MAX_ROTATION_RAD:
            raise CalibrationError(
                f"{place}: its rotation vector of {np.max(np.abs(rotation)):.3g} is none: is it in "
                "rad?"
            )
        return RigidTransform.from_rotvec(rotation.reshape(3)).rotation
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise CalibrationError(
            f"{place}: not a rotation: determinant {np.linalg.det(rotation):.3f}, R R^T differs "
            f"from 1 by {np.abs(rotation @ rotation.T - np.eye(3)).max():.2g}"
        )
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt
