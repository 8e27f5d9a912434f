"""Robot logs: states over time, from Parquet, CSV, ROS 1/2 bags and MCAP."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.errors import EstimatorError
from measure.limits import LEVER_MM
from measure.robots.schema import RobotLog, StateSchema, reported_mm
from measure.tables import TIME
from measure_learning.robots.generic import BUILTIN, YAML, read_schema
from measure_learning.robots.headings import (
    Clock,
    FeatureColumns,
    by_place,
    find_columns,
    heading_hint,
    lacking,
)
from measure_learning.robots.raven import raven_schema

if TYPE_CHECKING:
    from measure_learning.robots.tables import TableColumns


def robot_names() -> list[str]:
    """What `find_schema` knows."""
    return ["raven", "raven-right", *sorted(path.stem for path in BUILTIN.glob("*.toml"))]


def find_schema(name: str) -> StateSchema:
    """The schema of a known robot, or what a `.toml`, `.urdf` or UR's `.yaml` describes."""
    if name in ("raven", "raven-right"):
        return raven_schema("left" if name == "raven" else "right")
    if name in robot_names():
        return read_schema(BUILTIN / f"{name}.toml")
    if name.endswith(".xacro"):
        raise EstimatorError(
            f"{name}: xacro must be expanded first: `xacro {name} > {name.removesuffix('.xacro')}`"
        )
    if name.endswith((".toml", ".urdf", *YAML)):
        return read_schema(Path(name))
    raise EstimatorError(
        f"no robot schema '{name}': there is {', '.join(robot_names())}, or give a robot.toml, "
        "a .urdf or UR's calibration.yaml"
    )


def misfit(where: str, schema: StateSchema, missing: Sequence[str], there: Sequence[str]) -> str:
    """Which features a log lacks, and which known robots its columns fit instead."""
    text = str(lacking(where, missing, len(schema.names), there))
    hint = heading_hint(schema, there)
    numbered = set(by_place(there))
    sure = [name for name in there if name not in numbered]  # by place any robot would fit
    fitting = [
        name
        for name in robot_names()
        if (other := find_schema(name)).robot != schema.robot
        and not isinstance(find_columns(other, sure), list)
    ]
    return text + hint + (f"; its columns fit --robot {' or '.join(fitting)}" if fitting else "")


_GOES_ON = 0.4
"""Share of its speed before and after that an arm keeps across a state that is held. An arm that
stands for two rows and starts again at full speed keeps a third."""
_LEAST_MM, _LEAST_SHARE = 0.2, 0.01
"""Way across a held state that harms labels, and share of such rows, from which it is worth a word:
rounding of a slow joint and a lost packet are not."""
_SAME_INSTANT_S = 1e-3
_SAME_MM = 1e-9  # A controller's own position differs by more, if only by its last digit
ROBOT_KEY = b"measure.robot"  # Under which a Parquet file of states names its robot


def read_log(path: Path, schema: StateSchema, *, topic: str | None = None) -> RobotLog:
    """Read a log into memory; `LogFile` reads one of any length.

    Parquet, text, a bag of ROS 1, MCAP, or the folder of a ROS 2 bag, whose topic is found if
    absent. EstimatorError: missing or unreadable, lacks features (they are named), or its clock
    runs backwards.
    """
    times, states = zip(*log_pieces(path, schema, topic), strict=True)
    return RobotLog(schema, np.concatenate(times), np.concatenate(states))


def log_pieces(
    path: Path, schema: StateSchema, topic: str | None = None, *, again: bool = False
) -> Iterator[tuple[Floats, Floats]]:
    """Times (n,) and states (n, features) of a log in order, piece by piece; see `read_log`.

    What is wrong with a file is not said `again`.
    """
    if not path.exists():
        raise EstimatorError(f"{path}: no such robot log")
    if is_table(path):
        pieces = _table_pieces(path, schema)
    else:
        from measure_learning.robots.bags import bag_pieces

        pieces = bag_pieces(path, schema, topic, again=again)
    row, last_s, kept = 0, -np.inf, 0
    for times, states in pieces:
        _check_times(path, times, last_s, row)
        new = np.diff(times, prepend=last_s) > 0
        row, kept, last_s = row + len(times), kept + int(new.sum()), float(times[-1])
        if new.any():
            yield times[new], states[new]
    if kept < 2:
        raise EstimatorError(f"{path}: holds {kept} states; a log needs at least two")


def _check_times(path: Path, times: Floats, last_s: float, row: int) -> None:
    """Refuse a piece whose times (n,) do not go on from the last one; `row` rows came before."""
    if not np.isfinite(times).all():
        where = row + int(np.argmin(np.isfinite(times))) + 1
        raise EstimatorError(f"{path}: row {where} has no time")
    back = np.diff(times, prepend=last_s) < 0
    if back.any():
        # The row before it, as long as there is one: where the log is to be split.
        raise EstimatorError(
            f"{path}: time runs backwards at row {row + int(np.argmax(back))}: split the log there"
        )


def write_log(path: Path, log: RobotLog) -> None:
    """Write CSV, if the name ends with `.csv`, else Parquet."""
    import pyarrow as pa

    states = zip(log.schema.names, log.states.T.astype(np.float32), strict=True)
    table = pa.table({TIME: log.times_s, **dict(states)})
    if path.suffix == ".csv":
        from pyarrow import csv

        csv.write_csv(table, path)
    else:
        from pyarrow import parquet

        named = table.replace_schema_metadata({ROBOT_KEY: log.schema.robot})
        parquet.write_table(named, path, compression="zstd")


def of_instants(path: Path, schema: StateSchema, times_s: Floats) -> StateSchema:
    """The schema with seconds as its logs' unit, if a table's times are these: then they are that.

    Stops are farther apart than a robot logs, so that the steps tell no unit.
    """
    if schema.log.time_unit_s is not None or not is_table(path):
        return schema
    from measure_learning.robots.tables import Table

    table = Table.read(path)
    columns = Clock(str(path), table.schema.names, schema).columns
    if len(columns) != 1:
        return schema
    held = np.sort(table.numbers(*columns)[:, 0])
    after = np.clip(np.searchsorted(held, times_s), 1, max(len(held) - 1, 1))
    if len(held) < 2:
        return schema
    off = np.minimum(np.abs(held[after] - times_s), np.abs(held[after - 1] - times_s))
    if np.mean(off < _SAME_INSTANT_S) < 0.9:
        return schema
    return replace(schema, log=replace(schema.log, time_unit_s=1.0))


def check_robot(table: TableColumns, robot: str) -> None:
    """Refuse (EstimatorError) a table whose metadata names another robot; most files name none."""
    named = table.metadata(ROBOT_KEY)
    if named not in ("", robot):
        raise EstimatorError(f"{table.path}: holds states of robot '{named}', not of '{robot}'")


def is_table(path: Path) -> bool:
    """Whether a log is Parquet or text, by its content, and not a bag."""
    from measure_learning.robots.tables import kind_of

    return not path.is_dir() and kind_of(path) in (".parquet", ".csv")


def feature_columns(where: Path, schema: StateSchema, there: Sequence[str]) -> FeatureColumns:
    """Where a log with the columns `there` holds the features; EstimatorError if some are not."""
    found = find_columns(schema, there)
    if isinstance(found, list):
        raise EstimatorError(misfit(str(where), schema, found, there))
    return found


def _table_pieces(path: Path, schema: StateSchema) -> Iterator[tuple[Floats, Floats]]:
    from measure_learning.robots.tables import TableFile

    file = TableFile.open(path, schema.log.delimiter)
    check_robot(file, schema.robot)
    found = feature_columns(path, schema, file.schema.names)
    clock = Clock(str(path), file.schema.names, schema)
    for table in file.pieces((*clock.columns, *found.columns)):
        states = found.states(str(path), table.numbers(*found.columns))
        yield clock.seconds(table.numbers(*clock.columns)), states


def as_held(path: Path, schema: StateSchema, topic: str | None = None) -> StateSchema:
    """The schema without those fields of `raven_state` that a log's software has not; else itself.

    Position, joints and torques must be there.
    """
    if not path.exists() or not schema.torques:
        return schema
    if is_table(path):
        from measure_learning.robots.tables import TableFile

        there = set(TableFile.open(path, schema.log.delimiter).schema.names)
        held = {name for name, members in schema.groups.items() if there.issuperset(members)}
    else:
        from measure_learning.robots.bags import held_fields

        held = held_fields(path, schema, topic)
    read = (*schema.position, *schema.joints, *schema.torques)
    needed = {name for reading in read for name, _ in reading.terms}
    groups = {name: members for name, members in schema.groups.items() if name in held}
    names = {name for members in groups.values() for name in members}
    if not needed <= names:
        return schema
    features = tuple(feature for feature in schema.features if feature.name in names)
    return replace(schema, features=features, groups=groups)


@dataclass(frozen=True, eq=False)
class NewStates:
    """Rows of a log that hold a new state, where a program wrote the last one again and again."""

    rows: Bools  # (n,) which rows count
    rate_hz: float = np.nan  # of new states while the arm moves
    matters: bool = False  # whether the others are many, and the arm moved farther than they say

    @classmethod
    def of(cls, times_s: Floats, steps_mm: Floats) -> NewStates:
        """Find them by the times (n,) and by how far every row is from the one before, in mm.

        A row that repeats the one before is held if the arm goes on as if it had not stopped. A
        robot at rest repeats itself too: its rows count, up to the last that may be an answer.
        """
        count = len(times_s)
        changes = np.flatnonzero(steps_mm != 0)
        jumps, spans_s, lengths = steps_mm[changes[1:]], *map(np.diff, (times_s[changes], changes))
        speeds = jumps / spans_s
        moves = np.zeros(len(lengths), dtype=bool)
        moves[1:-1] = speeds[1:-1] > _GOES_ON * np.minimum(speeds[:-2], speeds[2:])
        if not (moves & (lengths > 1)).any():
            return cls(np.ones(count, dtype=bool))
        usual = int(np.median(lengths[moves]))
        run = np.searchsorted(changes, np.arange(count), side="right") - 1
        left = np.append(changes, count)[run + 1] - np.arange(count)  # rows until the next change
        rows = (steps_mm != 0) | ~(np.append(moves, False)[run] | (left < usual))
        far = np.append(jumps, 0.0)[run] > _LEAST_MM
        steady = lengths <= 2 * usual
        rate_hz = float(steady.sum() / spans_s[steady].sum())
        return cls(rows, rate_hz, float(np.mean(~rows & far)) > _LEAST_SHARE)

    def __str__(self) -> str:
        """How many rows repeat others, and the robot's rate; empty where that does not matter."""
        if not self.matters:
            return ""
        return (
            f"{100 * (1 - self.rows.mean()):.0f} % of its rows repeat the one before while the arm "
            f"moves: the robot answers {self.rate_hz:.3g} times a second, and every answer counts "
            "once"
        )


def steps_mm(schema: StateSchema, states: Floats, before: Floats | None = None) -> Floats:
    """How far joints of states (n, features) are from those of the row before; turns at a lever.

    That of the tip where no joints are known. NaN for the first row, if nothing was `before` it.
    """
    matrix = schema.reading_matrix(schema.joints or schema.position)
    if schema.joints and schema.chain is not None:
        matrix = matrix * [1.0 if joint.prismatic else LEVER_MM for joint in schema.chain.joints]
    read = np.flatnonzero(matrix.any(axis=1))  # other features need not be numbers
    first = np.full((1, states.shape[1]), np.nan) if before is None else before[None]
    with np.errstate(invalid="ignore", over="ignore"):
        moved = np.diff(np.concatenate([first, states])[:, read], axis=0)
        return np.asarray(np.linalg.norm(moved @ matrix[read], axis=1))


class LogFile:
    """A log of any length; see `RobotLog` for what its parts are.

    The file is read once when this is built, and once more for every call of `states_at`. States
    that a program wrote again until the robot answered count once. Its schema has the fields that
    the log has.
    """

    def __init__(self, path: Path, schema: StateSchema, topic: str | None = None) -> None:
        """Read the file; see `read_log`."""
        schema = as_held(path, schema, topic)
        self.schema, self._path, self._topic = schema, path, topic
        times, places, whole, steps = list[Floats](), list[Floats](), list[Bools](), list[Floats]()
        last: Floats | None = None
        self.broken: Ints = np.zeros(len(schema.features), dtype=np.int64)
        self.computed = schema.chain is not None  # whether its positions are those of its joints
        for piece, states in log_pieces(path, schema, topic):
            finite = np.isfinite(states)
            self.broken += (~finite).sum(axis=0)
            complete = np.asarray(finite.all(axis=1))
            times.append(piece)
            whole.append(complete)
            steps.append(steps_mm(schema, states, last))
            last = states[-1]
            places.append(reported_mm(schema, states, complete))
            if schema.chain is not None and self.computed:
                tips = schema.chain.tip_mm(schema.joint_positions(states[complete]))
                self.computed = np.allclose(tips, places[-1][complete], rtol=0.0, atol=_SAME_MM)
        self.new = NewStates.of(np.concatenate(times), np.concatenate(steps))
        self.times_s: Floats = np.concatenate(times)[self.new.rows]
        self.complete: Bools = np.concatenate(whole)[self.new.rows]
        self.reported_mm: Floats = np.concatenate(places)[self.new.rows]

    def states_at(self, rows: Ints) -> Floats:
        """States (k, features) of rows (k,); EstimatorError if the file has changed since."""
        order = np.argsort(rows, kind="stable")
        wanted = np.flatnonzero(self.new.rows)[rows[order]]
        out = np.empty((len(rows), len(self.schema.features)))
        start = done = 0
        pieces = log_pieces(self._path, self.schema, self._topic, again=True)
        for times, states in pieces:
            stop = int(np.searchsorted(wanted, start + len(times)))
            out[order[done:stop]] = states[wanted[done:stop] - start]
            start, done = start + len(times), stop
        if start != len(self.new.rows):
            raise EstimatorError(f"{self._path}: has changed while it was read: try again")
        return out


StateLog: TypeAlias = RobotLog | LogFile
