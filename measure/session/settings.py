"""What `session.toml` may hold."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, FiniteFloat, model_validator

from measure.session.body_file import BodyModel
from measure.session.files import FileModel, Name
from measure.session.stated_rig import Unit
from measure.session.timestamps import LATEST_S


class SessionTable(FileModel):
    """The `[session]` table; every path is relative to the file."""

    name: str = ""
    description: str = ""
    body: Name | None = None
    bodies: Annotated[list[Name], Field(default_factory=list)]
    reference: str = ""
    calibration: Name | None = None
    calibration_unit: Unit | None = None
    truth: Name | None = None


class CameraTable(FileModel):
    """One `[[cameras]]` table."""

    name: Name
    images: Name | None = None
    video: Name | None = None
    timestamps: Name | None = None
    time_column: Name | None = None
    time_offset_s: Annotated[FiniteFloat, Field(ge=-LATEST_S, le=LATEST_S)] = 0.0
    bit_depth: Annotated[int, Field(ge=8, le=16)] | None = None
    controls: dict[str, int | str] = Field(default_factory=dict)  # kept for people to read

    @model_validator(mode="after")
    def _one_source(self) -> CameraTable:
        if (self.images is None) == (self.video is None):
            raise ValueError(f"camera '{self.name}' needs either images or video")
        if self.images is not None and self.timestamps is None:
            raise ValueError(
                f"camera '{self.name}': images carry no time; give timestamps = \"....csv\""
            )
        return self


class RobotTable(FileModel):
    """The `[robot]` table."""

    log: Name


class SessionModel(FileModel):
    """A whole `session.toml`."""

    session: SessionTable
    cameras: Annotated[list[CameraTable], Field(default_factory=list)]
    body: BodyModel | None = None
    robot: RobotTable | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> SessionModel:
        given = (self.body is not None, self.session.body is not None, bool(self.session.bodies))
        if sum(given) > 1:
            raise ValueError(
                'give the body once: body = "body.toml" or bodies = ["tool.toml", "base.toml"] in '
                "[session], or [body]"
            )
        names = [camera.name for camera in self.cameras]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two cameras are called '{name}'")
        if len(names) < 2:
            raise ValueError(
                f"a measurement needs at least two cameras, the session has {len(names)}"
            )
        return self
