"""Robot logs: states over time, from Parquet, CSV, ROS 1/2 bags and MCAP."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.robots.psm import psm_schema
from measure.robots.raven import raven_schema
from measure.robots.schema import RobotLog, StateSchema

if TYPE_CHECKING:
    from measure.robots.tables import Table

TIME = "time_s"
ROBOT_KEY = b"measure.robot"
"""Under which a Parquet file of states names its robot."""
SCHEMAS: dict[str, Callable[[], StateSchema]] = {
    "raven": lambda: raven_schema("left"),
    "raven-right": lambda: raven_schema("right"),
    "dvrk-psm": psm_schema,
}


def find_schema(name: str) -> StateSchema:
    """The schema called `raven`, `raven-right`, `dvrk-psm`, or described by a TOML file.

    Raises:
        EstimatorError: there is no such schema.
    """
    if name in SCHEMAS:
        return SCHEMAS[name]()
    if name.endswith(".toml"):
        from measure.robots.generic import read_schema

        return read_schema(Path(name))
    raise EstimatorError(
        f"no robot schema '{name}': there is {', '.join(SCHEMAS)}, or give a robot.toml"
    )


def read_log(path: Path, schema: StateSchema, *, topic: str | None = None) -> RobotLog:
    """Read a log.

    Args:
        path: `.parquet`, `.csv`, `.bag`, `.mcap`, or a ROS 2 bag folder.
        schema: which features are needed.
        topic: of the state messages in a bag; the only `raven_state` topic if absent.

    Raises:
        EstimatorError: the file is missing or unreadable, lacks features (they are named), or its
            clock runs backwards.
    """
    if not path.exists():
        raise EstimatorError(f"{path}: no such robot log")
    if path.suffix in (".parquet", ".csv"):
        times, states = _read_table(path, schema)
    else:
        from measure.robots.bags import read_bag

        times, states = read_bag(path, schema, topic)
    return _checked(path, RobotLog(schema, times, states))


def write_log(path: Path, log: RobotLog) -> None:
    """Write CSV, if the name ends with `.csv`, else Parquet."""
    import pyarrow as pa

    columns = {TIME: log.times_s}
    for index, name in enumerate(log.schema.names):
        columns[name] = log.states[:, index].astype(np.float32)
    table = pa.table(columns)
    if path.suffix == ".csv":
        from pyarrow import csv

        csv.write_csv(table, path)
    else:
        from pyarrow import parquet

        named = table.replace_schema_metadata({ROBOT_KEY: log.schema.robot})
        parquet.write_table(named, path, compression="zstd")


def check_robot(table: Table, robot: str) -> None:
    """Refuse a table whose metadata names another robot; most files name none.

    Raises:
        EstimatorError: it names another robot.
    """
    named = table.metadata(ROBOT_KEY)
    if named not in ("", robot):
        raise EstimatorError(f"{table.path}: holds states of robot '{named}', not of '{robot}'")


def _read_table(path: Path, schema: StateSchema) -> tuple[Floats, Floats]:
    from measure.robots.tables import Table

    table = Table.read(path)
    check_robot(table, schema.robot)
    columns = table.numbers(TIME, *schema.names)
    return columns[:, 0], columns[:, 1:]


def _checked(path: Path, log: RobotLog) -> RobotLog:
    if len(log.times_s) < 2:
        raise EstimatorError(f"{path}: holds {len(log.times_s)} states; a log needs at least two")
    if not np.isfinite(log.times_s).all():
        row = int(np.argmin(np.isfinite(log.times_s))) + 1
        raise EstimatorError(f"{path}: row {row} has no time")
    step = np.diff(log.times_s)
    if np.any(step < 0):
        row = int(np.argmax(step < 0)) + 1
        raise EstimatorError(f"{path}: time runs backwards at row {row}: split the log there")
    keep = np.concatenate([[True], step > 0])
    return RobotLog(log.schema, log.times_s[keep], log.states[keep])
