"""Any robot, described by a small TOML file: features, position, joints, and its chain if known."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from measure.errors import EstimatorError
from measure.robots.chain import Joint, SerialChain, dh_link
from measure.robots.schema import Feature, Reading, StateSchema


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class _Column(_File):
    name: str
    unit: str = ""


class _Joint(_File):
    """A joint and its Craig link: alpha and a before it, offset and d along it."""

    feature: str
    scale: float = Field(1.0, description="to rad or mm")
    kind: Literal["turns", "slides"] = "turns"
    alpha_deg: float | None = None
    a_mm: float = 0.0
    offset_deg: float = 0.0
    d_mm: float = 0.0


class _Robot(_File):
    robot: str
    features: list[_Column] = Field(min_length=1)
    position: list[str] = Field(min_length=3, max_length=3)
    position_to_mm: float = 1.0
    joints: list[_Joint] = []
    coupled: list[int] = []
    tool_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)


def read_schema(path: Path) -> StateSchema:
    """Read a `robot.toml`.

    Joints that all carry `alpha_deg` make a kinematic chain; otherwise the chain is unknown.

    Raises:
        EstimatorError: the file is missing or does not fit; the message says where.
    """
    try:
        file = _Robot.model_validate(tomllib.loads(path.read_text()))
    except OSError:
        raise EstimatorError(f"{path}: no such robot description") from None
    except tomllib.TOMLDecodeError as error:
        raise EstimatorError(f"{path}: not TOML: {error}") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise EstimatorError(f"{path}: '{where}': {first['msg']}") from None
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
