"""A robot's state: its features, and readings of position and joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import TypeAdapter

from measure.arrays import Bools, Floats, Ints, floats
from measure.errors import EstimatorError
from measure.robots.chain import Joint, SerialChain


@dataclass(frozen=True)
class Feature:
    """One number of the state: a column's name and its unit ("deg", "um", "" for a bare number)."""

    name: str
    unit: str = ""


@dataclass(frozen=True)
class Reading:
    """A quantity in mm or rad, read from features: `value = sum(scale * feature)`."""

    terms: tuple[tuple[str, float], ...]

    @classmethod
    def of(cls, feature: str, scale: float = 1.0) -> Reading:
        """The quantity of one feature."""
        return cls(((feature, scale),))


@dataclass(frozen=True)
class OtherNames:
    """Columns under which a log may hold some features, all of them or none."""

    features: tuple[str, ...]
    columns: tuple[str, ...]
    scale: float = 1.0  # a column's number times this is the feature's
    unless: str = ""  # a column that a log of such names must not have


@dataclass(frozen=True)
class LogFormat:
    """Where the logs of a robot hold its features, and what else must be known to read them."""

    names: tuple[OtherNames, ...] = ()  # tried in order where a feature's own name is not there
    time: str | None = None  # column of the time; found if absent
    time_unit_s: float | None = None  # found if absent
    delimiter: str | None = None  # of text; found if absent
    topics: tuple[str, ...] = ()  # ends of names of joint topics in bags, the preferred first
    tip_topics: tuple[str, ...] = ()  # topics of poses of the tip
    frames: tuple[str, str] | None = None  # of base and tip in /tf


_FORMATS = TypeAdapter(LogFormat)


@dataclass(frozen=True, eq=False)
class StateSchema:
    """A robot's state."""

    robot: str  # name; a model trained for one robot refuses another's states
    features: tuple[Feature, ...]  # in the order of the state vector
    # three readings in mm: the tip as the robot reports it.
    position: tuple[Reading, Reading, Reading]
    joints: tuple[Reading, ...] = ()  # readings in rad or mm, in the order of `chain`; may be empty
    coupled: tuple[int, ...] = ()  # indices into `joints` of joints that share cables (a wrist)
    chain: SerialChain | None = None  # the forward kinematics, if known
    torques: tuple[Reading, ...] = ()  # readings of the motors' torques, one per joint, if reported
    # names of groups of features, for ablation.
    groups: dict[str, tuple[str, ...]] = field(default_factory=dict)
    log: LogFormat = LogFormat()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the features."""
        return tuple(feature.name for feature in self.features)

    def index(self, names: Sequence[str]) -> list[int]:
        """Positions of features in the state vector; EstimatorError names what is missing."""
        where = {name: index for index, name in enumerate(self.names)}
        if missing := [name for name in names if name not in where]:
            raise EstimatorError(
                f"{self.robot}: no feature {', '.join(missing)}; "
                f"its {len(self.features)} features begin {', '.join(self.names[:8])}"
            )
        return [where[name] for name in names]

    def read(self, states: ArrayLike, readings: Sequence[Reading]) -> Floats:
        """Quantities (..., readings) from states (..., features)."""
        return np.asarray(states, dtype=np.float64) @ self.reading_matrix(readings)

    def reading_matrix(self, readings: Sequence[Reading]) -> Floats:
        """The matrix (features, readings) that `read` multiplies states with."""
        out = np.zeros((len(self.features), len(readings)))
        for column, reading in enumerate(readings):
            rows = self.index([name for name, _ in reading.terms])
            out[rows, column] = [scale for _, scale in reading.terms]
        return out

    def position_mm(self, states: ArrayLike) -> Floats:
        """The reported tip (..., 3)."""
        return self.read(states, self.position)

    def joint_positions(self, states: ArrayLike) -> Floats:
        """Joint positions (..., joints) in rad and mm."""
        return self.read(states, self.joints)

    @property
    def periods(self) -> Floats:
        """How far the features (features,) of turning joints go in one turn; inf of all others."""
        matrix, out = self.reading_matrix(self.joints), np.full(len(self.features), np.inf)
        turns = [not joint.prismatic for joint in self.chain.joints] if self.chain else []
        for row in np.flatnonzero((matrix != 0).sum(axis=1) == 1):
            (joint,) = np.flatnonzero(matrix[row])
            if turns and turns[joint] and np.count_nonzero(matrix[:, joint]) == 1:
                out[row] = 2 * np.pi / abs(matrix[row, joint])
        return out

    def means(self, other: StateSchema) -> bool:
        """Whether another describes the robot alike: units, readings, chain; not how logs do."""
        ours, theirs = self._numbers(), other._numbers()
        same = self.features == other.features and ours.shape == theirs.shape
        return same and bool(np.allclose(ours, theirs))

    def _numbers(self) -> Floats:
        """All that makes position, joints and kinematics of the features, in a row."""
        links = self.chain.joints if self.chain else ()
        tool = [self.chain.tool] if self.chain else []
        read = self.reading_matrix((*self.position, *self.joints))
        parts = [read, *tool, *(m for j in links for m in (j.link, j.axis))]
        return np.concatenate([part.ravel() for part in parts])

    def to_dict(self) -> dict[str, Any]:
        """Plain values that JSON can hold; `from_dict` turns them back."""
        chain = self.chain and {
            "joints": [
                {"link": j.link.tolist(), "axis": j.axis.tolist(), "prismatic": j.prismatic}
                for j in self.chain.joints
            ],
            "tool": self.chain.tool.tolist(),
        }
        return {
            "robot": self.robot,
            "features": [[feature.name, feature.unit] for feature in self.features],
            "position": [list(map(list, reading.terms)) for reading in self.position],
            "joints": [list(map(list, reading.terms)) for reading in self.joints],
            "torques": [list(map(list, reading.terms)) for reading in self.torques],
            "coupled": list(self.coupled),
            "chain": chain,
            "groups": {name: list(members) for name, members in self.groups.items()},
            "log": asdict(self.log),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> StateSchema:
        """What `to_dict` wrote."""

        def readings(lists: Any) -> tuple[Reading, ...]:
            return tuple(Reading(tuple((str(n), float(s)) for n, s in terms)) for terms in lists)

        chain = values["chain"] and SerialChain(
            tuple(
                Joint(np.array(j["link"]), np.array(j["axis"]), bool(j["prismatic"]))
                for j in values["chain"]["joints"]
            ),
            np.array(values["chain"]["tool"]),
        )
        x, y, z = readings(values["position"])
        return cls(
            robot=values["robot"],
            features=tuple(Feature(name, unit) for name, unit in values["features"]),
            position=(x, y, z),
            joints=readings(values["joints"]),
            torques=readings(values["torques"]),
            coupled=tuple(values["coupled"]),
            chain=chain,
            groups={name: tuple(members) for name, members in values["groups"].items()},
            log=_FORMATS.validate_python(values["log"]),
        )


@dataclass(frozen=True, eq=False)
class RobotLog:
    """States of one robot on the robot's own clock, in memory."""

    schema: StateSchema  # what the columns of `states` are
    times_s: Floats  # (n,) strictly increasing
    states: Floats  # (n, features)

    def __post_init__(self) -> None:
        count = len(floats("times_s", self.times_s, "n"))
        floats("states", self.states, count, len(self.schema.features))

    @property
    def broken(self) -> Ints:
        """(features,) in how many states a feature is no number."""
        return np.asarray((~np.isfinite(self.states)).sum(axis=0), dtype=np.int64)

    @property
    def complete(self) -> Bools:
        """(n,) whether a state is all numbers."""
        return np.asarray(np.isfinite(self.states).all(axis=1))

    @property
    def reported_mm(self) -> Floats:
        """(n, 3) the tip as reported; NaN where a state is not complete."""
        return reported_mm(self.schema, self.states, self.complete)

    def states_at(self, rows: Ints) -> Floats:
        """States (k, features) of some rows (k,), in any order."""
        return self.states[rows]


def reported_mm(schema: StateSchema, states: Floats, complete: Bools) -> Floats:
    """The reported tip (n, 3) of states (n, features); NaN where one is not `complete` (n,)."""
    out = np.full((len(states), 3), np.nan)
    out[complete] = schema.position_mm(states[complete])
    return out
