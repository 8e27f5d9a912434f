"""A robot's state: its features, readings of position and joints, and the columns of logs."""

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
from measure.robots.headings import affixes, by_place


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


_LARGEST_TURNS = 4.0  # No joint turns farther; degrees read as radians seem to
_LARGEST_SLIDE_MM = 2e4  # No axis is longer; mm read as metres seem to be
UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SHOWN = 12


@dataclass(frozen=True, eq=False)
class FeatureColumns:
    """Columns of a log, in the order in which `states` needs them."""

    schema: StateSchema
    columns: tuple[str, ...]  # (k,) some may be there several times
    scales: Floats  # (k,)
    features: tuple[int, ...]  # (k,) places in the state of what they hold
    computed: bool  # whether the position is computed from the joints

    def states(self, where: str, values: Floats) -> Floats:
        """States (n, features) from the columns' numbers (n, k); EstimatorError: joints in deg."""
        schema = self.schema
        out = np.full((len(values), len(schema.features)), np.nan)
        with np.errstate(invalid="ignore", over="ignore"):
            out[:, self.features] = values * self.scales
            if schema.chain is None:
                return out
            matrix = schema.reading_matrix(schema.joints)
            read = np.flatnonzero(matrix.any(axis=1))
            joints = out[:, read] @ matrix[read]  # other features need not be numbers
            _check_turns(where, schema, joints)
            if self.computed:
                tips = schema.chain.tip_mm(joints)
                for axis, reading in enumerate(schema.position):
                    ((name, scale),) = reading.terms
                    out[:, schema.index([name])[0]] = tips[:, axis] / scale
        return out


def find_columns(schema: StateSchema, there: Sequence[str]) -> FeatureColumns | list[str]:
    """Where a log with the columns `there` holds the features; or the features that it lacks.

    A position that is nowhere is computed from the joints, if the chain is known.
    """
    held = set(there)
    found = {name: (name, 1.0) for name in schema.names if name in held}
    for other in schema.log.names:
        if other.unless in held:  # a robot of more joints
            for feature, column in zip(other.features, other.columns, strict=True):
                if feature == column:
                    found.pop(feature, None)
        elif held.issuperset(other.columns) and not found.keys() >= set(other.features):
            named = zip(other.features, other.columns, strict=True)
            found |= {feature: (column, other.scale) for feature, column in named}
    joints = _joint_features(schema)
    if joints and not found.keys() >= set(joints) and len(affixed := _affixed(schema, there)) == 1:
        found |= affixed[0]
    missing = [name for name in schema.names if name not in found]
    if missing and set(missing) != set(_computable(schema)):
        return missing
    return FeatureColumns(
        schema,
        tuple(column for column, _ in found.values()),
        np.array([scale for _, scale in found.values()]),
        tuple(schema.index(list(found))),
        bool(missing),
    )


def _joint_features(schema: StateSchema) -> list[str]:
    return list(dict.fromkeys(name for reading in schema.joints for name, _ in reading.terms))


def _affixed(schema: StateSchema, there: Sequence[str]) -> list[dict[str, tuple[str, float]]]:
    """Every way in which headings hold the joints' names with the same before and behind each."""
    joints = _joint_features(schema)
    named = [OtherNames(tuple(joints), tuple(joints))]
    named += [other for other in schema.log.names if set(other.features) >= set(joints)]
    out = list[dict[str, tuple[str, float]]]()
    for other in named:
        for before, behind in affixes(other.columns, there):
            columns = [f"{before}{column}{behind}" for column in other.columns]
            pairs = zip(other.features, columns, strict=True)
            out.append({feature: (column, other.scale) for feature, column in pairs})
    return out


def heading_hint(schema: StateSchema, there: Sequence[str]) -> str:
    """What to do about headings from which the joints cannot be told; empty if nothing is known."""
    several = [[column for column, _ in found.values()] for found in _affixed(schema, there)]
    joints = _joint_features(schema)
    if len(several) > 1:
        held = " and as ".join(f"{columns[0]} ..." for columns in several)
        names = ", ".join(f'"{column}"' for column in several[0])
        return (
            f"; the joints are there as {held}: name those of this robot in a robot.toml: like = "
            f'"{schema.robot}", [log] joints = [{{names = [{names}]}}]'
        )
    numbered = by_place(there)
    if joints and len(numbered) >= len(joints):
        return (
            f"; {numbered[0]} ... {numbered[-1]} are positions by place, and a message's order "
            "need not be the robot's (many drivers sort by name): name them in the order of its "
            f'joints in a robot.toml: like = "{schema.robot}", [log] joints = [{{names = '
            f'["{numbered[0]}", ...]}}]'
        )
    return ""


def _computable(schema: StateSchema) -> list[str]:
    """The features of the position, if each is one coordinate and the chain gives it."""
    terms = [reading.terms for reading in schema.position]
    if schema.chain is None or any(len(term) != 1 for term in terms):
        return []
    return [name for ((name, _),) in terms]


def lacking(where: str, missing: Sequence[str], count: int, there: Sequence[str]) -> EstimatorError:
    """What to say of a log that lacks some of `count` columns."""
    return EstimatorError(
        f"{where}: lacks {len(missing)} of {count} columns: {', '.join(missing[:_SHOWN])}"
        f"{', ...' if len(missing) > _SHOWN else ''}; it has {', '.join(there[:8]) or 'nothing'}"
        f"{', ...' if len(there) > 8 else ''}"
    )


def _check_turns(where: str, schema: StateSchema, joints: Floats) -> None:
    assert schema.chain is not None
    for index, joint in enumerate(schema.chain.joints):
        name, values = schema.joints[index].terms[0][0], np.abs(joints[:, index])
        if not joint.prismatic and (values > _LARGEST_TURNS * 2 * np.pi).any():
            raise EstimatorError(
                f"{where}: joint '{name}' seems to turn {np.nanmax(values) / (2 * np.pi):.0f} "
                "times round: is its column in degrees? Give its unit in a robot.toml"
            )
        values = values[np.isfinite(values)]
        if joint.prismatic and (values > _LARGEST_SLIDE_MM).any():
            joint_names = _joint_features(schema)
            units = (
                f'{{name = "{n}", unit = "{"mm" if n == name else f.unit}"}}'
                for n, f in ((f.name, f) for f in schema.features)
                if n in joint_names
            )
            raise EstimatorError(
                f"{where}: joint '{name}' seems to slide {values.max() / 1e3:.0f} m: is its "
                f"column in mm? Give the units in a robot.toml: features = [{', '.join(units)}]"
            )
