"""The robots that are known by name: RAVEN-II, and those that packaged files describe."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from measure.errors import EstimatorError
from measure.robots.columns import find_columns, lacking
from measure.robots.generic import BUILTIN, read_schema
from measure.robots.raven import raven_schema
from measure.robots.schema import StateSchema


def robot_names() -> list[str]:
    """What `find_schema` knows."""
    return ["raven", "raven-right", *sorted(path.stem for path in BUILTIN.glob("*.toml"))]


def find_schema(name: str) -> StateSchema:
    """The schema of a known robot, or the one that a `.toml` or `.urdf` file describes."""
    if name in ("raven", "raven-right"):
        return raven_schema("left" if name == "raven" else "right")
    if name in robot_names():
        return read_schema(BUILTIN / f"{name}.toml")
    if name.endswith((".toml", ".urdf")):
        return read_schema(Path(name))
    raise EstimatorError(
        f"no robot schema '{name}': there is {', '.join(robot_names())}, or give a robot.toml or "
        "a .urdf"
    )


def misfit(where: str, schema: StateSchema, missing: Sequence[str], there: Sequence[str]) -> str:
    """Which features a log lacks, and which known robots its columns fit instead."""
    text = str(lacking(where, missing, len(schema.names), there))
    fitting = [
        name
        for name in robot_names()
        if (other := find_schema(name)).robot != schema.robot
        and not isinstance(find_columns(other, there), list)
    ]
    return text + (f"; its columns fit --robot {' or '.join(fitting)}" if fitting else "")
