"""Where a robot stands in the cameras' world: the `frame.toml` that `measure register` writes."""

from __future__ import annotations

from pathlib import Path

from pydantic import ConfigDict, FiniteFloat

from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.reading import FileModel
from measure.session.files import Position, load_toml


class StatedTransform(FileModel):
    """A rigid transform as files state it."""

    quat_wxyz: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    translation_mm: Position

    def transform(self) -> RigidTransform:
        """The transform."""
        return RigidTransform.from_quat_wxyz(self.quat_wxyz, self.translation_mm)


class _FrameFile(FileModel):
    model_config = ConfigDict(extra="ignore")

    world_from_base: StatedTransform
    eye_in_hand: bool = False


def read_robot_base(path: Path) -> RigidTransform:
    """`world_from_base` of a `frame.toml`; EstimatorError: missing or wrong, with the line."""
    file = load_toml(path, _FrameFile, EstimatorError)
    if file.eye_in_hand:
        raise EstimatorError(f"{path}: is of cameras on the flange: no run is in its base")
    return file.world_from_base.transform()
