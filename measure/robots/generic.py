"""Any robot, described by a small TOML file: features, position, joints, and its chain if known."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    model_validator,
)

from measure.errors import EstimatorError
from measure.reading import parse_toml, read_toml_text
from measure.robots.chain import Joint, SerialChain, dh_link
from measure.robots.schema import Feature, Reading, StateSchema


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class _Column(_File):
    name: str
    unit: str = ""


def _not_zero(factor: float) -> float:
    if not 1e-9 <= abs(factor) <= 1e9:
        raise ValueError(f"{factor:g} is no factor between units")
    return factor


_Factor = Annotated[FiniteFloat, AfterValidator(_not_zero)]
_Size = Annotated[FiniteFloat, Field(ge=-1e6, le=1e6)]


class _JointTable(_File):
    """A joint and its Craig link: alpha and a before it, offset and d along it."""

    feature: str
    scale: _Factor = Field(1.0, description="to rad or mm")
    kind: Literal["turns", "slides"] = "turns"
    alpha_deg: _Size | None = None
    a_mm: _Size = 0.0
    offset_deg: _Size = 0.0
    d_mm: _Size = 0.0


class _Robot(_File):
    robot: str
    features: list[_Column] = Field(min_length=1)
    position: list[str] = Field(min_length=3, max_length=3)
    position_to_mm: Annotated[FiniteFloat, Field(ge=1e-9, le=1e9)] = 1.0
    joints: list[_JointTable] = []
    coupled: list[int] = []
    tool_mm: tuple[_Size, _Size, _Size] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _coupled_joints_exist(self) -> _Robot:
        for index in self.coupled:
            if not 0 <= index < len(self.joints):
                raise ValueError(
                    f"coupled names joint {index}; there are {len(self.joints)}, from 0 on"
                )
        return self


def read_schema(path: Path) -> StateSchema:
    """Read a `robot.toml`.

    Joints that all carry `alpha_deg` make a kinematic chain; otherwise the chain is unknown.

    Raises:
        EstimatorError: the file is missing or does not fit; the message says where.
    """
    try:
        file = _Robot.model_validate(parse_toml(read_toml_text(path, EstimatorError)))
    except tomllib.TOMLDecodeError as error:
        raise EstimatorError(f"{path}: not TOML: {error}") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        place = f"'{where}': " if where else ""
        raise EstimatorError(f"{path}: {place}{first['msg']}") from None
    x, y, z = (Reading.of(name, file.position_to_mm) for name in file.position)
    schema = StateSchema(
        robot=file.robot,
        features=tuple(Feature(column.name, column.unit) for column in file.features),
        position=(x, y, z),
        joints=tuple(Reading.of(joint.feature, joint.scale) for joint in file.joints),
        coupled=tuple(file.coupled),
        chain=_chain(file),
    )
    schema.index([*file.position, *(joint.feature for joint in file.joints)])
    return schema


def _chain(file: _Robot) -> SerialChain | None:
    if not file.joints or any(joint.alpha_deg is None for joint in file.joints):
        return None
    joints = tuple(
        Joint(
            dh_link(np.deg2rad(j.alpha_deg or 0.0), j.a_mm, np.deg2rad(j.offset_deg), j.d_mm),
            np.array([0.0, 0.0, 1.0]),
            j.kind == "slides",
        )
        for j in file.joints
    )
    tool = np.eye(4)
    tool[:3, 3] = file.tool_mm
    return SerialChain(joints, tool)
