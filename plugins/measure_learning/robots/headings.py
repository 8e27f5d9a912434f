"""What the headings of robots' logs mean: joints, the tip, the tool's pose and the time."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.reading import listed
from measure.robots.schema import OtherNames, StateSchema
from measure.tables import STEPS_S, TIME, UNITS_S, candidates, stated_unit_s, time_columns

# What headings mean, in the words of every program and maker whose logs are read. {0} and {1} count
# from there; a robot's own names stand in its description, and times in `measure.tables`.
JOINTS = (
    "actual_q_{0}",
    "q[{0}]",
    "q{1}",
    "q_{1}",
    "q_{0}",
    "joint_{1}",
    "joint{1}",
    "joint_{0}",
    "j{1}",
)
"""Positions of joints."""
UNITS_BEHIND = (("", 1.0), ("_rad", 1.0), ("_deg", np.pi / 180))
"""What may stand behind those, and how many rad it is."""
TIPS = ((("x_mm", "y_mm", "z_mm"), 1.0), (("x_m", "y_m", "z_m"), 1e3))
"""Positions of the tip, and how many mm their numbers are."""
PLACES = (
    ("x", "y", "z"),
    ("tx", "ty", "tz"),
    ("actual_tcp_pose_0", "actual_tcp_pose_1", "actual_tcp_pose_2"),
)
"""Positions of the tool, whose headings or numbers tell the unit."""
TURNS: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (("qx", "qy", "qz", "qw"), ("ros",)),
    (("orientation.x", "orientation.y", "orientation.z", "orientation.w"), ("ros",)),
    (("q1", "q2", "q3", "q4"), ("abb", "ros")),
    (("q0", "q1", "q2", "q3"), ("abb", "ros")),
    (("actual_tcp_pose_3", "actual_tcp_pose_4", "actual_tcp_pose_5"), ("ur",)),
    (("a", "b", "c"), ("kuka", "mitsubishi", "doosan")),
    (("w", "p", "r"), ("fanuc",)),
    (("rx", "ry", "rz"), ("ur", "yaskawa", "staubli")),
    (("o", "a", "t"), ("kawasaki",)),
    (("yaw", "pitch", "roll"), ("kuka",)),
)
"""Rotations of the tool, and who writes them so: the first of these are the likeliest."""
_SEPARATORS = "/_.:- "
_LEAST_LETTERS = 5  # of a name that is sought inside others; `q1` is part of too many
_OTHER_QUANTITY = re.compile(
    r"vel|speed|rate|acc|eff|torque|current|temp|target|command|desired|error"
)
_BY_PLACE = re.compile(r"(?:.*[/.])?position[_.\[/]?\d+\]?")
_UNIT = re.compile(r"(.+?)(?:[\s_]+|\s*[\[(])(mm|cm|m|deg|degrees|rad|°)[\])]?", re.IGNORECASE)
_CELL = re.compile(r"(.*?)([0-4])[_,]?([0-4])\]?")  # of a matrix, by row and column
_NUMBERED = re.compile(r"(.*?)[\[_.]?(\d+)\]?")
_LARGEST_TURNS = 4.0  # No joint turns farther; degrees read as radians seem to
_LARGEST_SLIDE_MM = 2e4  # No axis is longer; mm read as metres seem to be
_EPOCH_S = (1e9, 1e10)  # Seconds since 1970 of the years 2001 to 2286


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
    """What to do about headings that do not identify the joints; empty if nothing is known."""
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
        f"{where}: lacks {len(missing)} of {count} columns: {listed(missing)}; it has "
        f"{listed(there)}"
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


def affixes(names: Sequence[str], there: Sequence[str]) -> list[tuple[str, str]]:
    """What stands before and behind all of `names` in headings: `left_`, or `/js/` and `/position`.

    Of several that say which quantity they are, those of positions.
    """
    if any(len(name) < _LEAST_LETTERS for name in names):
        return []
    held = set(there)
    found = [
        (before, behind)
        for before, behind in _around(names[0], there)
        if held.issuperset(f"{before}{name}{behind}" for name in names)
        and not _OTHER_QUANTITY.search(behind.lower())
    ]
    stated = [pair for pair in found if "pos" in pair[1].lower()]
    return stated or found


def _around(name: str, there: Sequence[str]) -> Iterator[tuple[str, str]]:
    for heading in there:
        before, inside, behind = heading.partition(name)
        if (
            inside
            and (not before or before[-1] in _SEPARATORS)
            and (not behind or behind[0] in _SEPARATORS)
        ):
            yield before, behind


def by_place(there: Sequence[str]) -> list[str]:
    """Headings that number the positions of a message, whose order they do not say."""
    return [name for name in there if _BY_PLACE.fullmatch(name)]


@dataclass(frozen=True)
class ToolHeadings:
    """Columns of places and turns, the latter 3, 4, 9 (of a matrix) or 16 (a matrix with both)."""

    place: tuple[str, ...]
    turn: tuple[str, ...]
    makers: tuple[str, ...]

    @classmethod
    def of(cls, there: Sequence[str]) -> ToolHeadings | None:
        """Those of a tool's pose, whatever stands before all of them, and units behind; or None."""
        stems = {split_unit(name)[0].lower(): name for name in reversed(there)}
        place = next((c for names in PLACES if (c := _under_prefix(stems, names))), ())
        if (matrix := _matrix(stems)) and (len(matrix) == 16 or place):
            return cls(() if len(matrix) == 16 else place, matrix, ("matrix",))
        for names, makers in TURNS:
            several_joints = names[0] in ("q0", "q1") and len(makers) > 1 and "q5" in stems
            if place and not several_joints and (turn := _under_prefix(stems, names)):
                return cls(place, turn, makers)
        return None


def split_unit(heading: str) -> tuple[str, str]:
    """Name and unit."""
    found = _UNIT.fullmatch(heading)
    return (found[1], found[2].lower()) if found else (heading, "")


def _under_prefix(stems: dict[str, str], names: Sequence[str]) -> tuple[str, ...]:
    """Headings of all names, with the same before each; empty if there are none."""
    for stem in sorted(stems, key=len):
        before = stem.removesuffix(names[0])
        if stem.endswith(names[0]) and (not before or before[-1] in _SEPARATORS):
            columns = [stems.get(before + name, "") for name in names]
            if all(columns):
                return tuple(columns)
    return ()


def _matrix(stems: dict[str, str]) -> tuple[str, ...]:
    """Headings of a matrix, row by row: 16 of a pose, or 9 of a rotation; empty if there is none.

    A pose without its last row has twelve; they are followed by four empty ones.
    """
    cells = dict[str, dict[tuple[int, int], str]]()
    numbered = dict[str, dict[int, str]]()
    for stem, name in stems.items():
        if found := _CELL.fullmatch(stem):
            cells.setdefault(found[1], {})[int(found[2]), int(found[3])] = name
        if found := _NUMBERED.fullmatch(stem):
            numbered.setdefault(found[1], {})[int(found[2])] = name
    for held in cells.values():
        first = min(held)[0]
        for rows, columns in ((4, 4), (3, 4), (3, 3)):
            at = [(first + i, first + j) for i in range(rows) for j in range(columns)]
            if all(cell in held for cell in at):
                last = [""] * (4 if (rows, columns) == (3, 4) else 0)
                return (*(held[cell] for cell in at), *last)
    for row in numbered.values():
        first = min(row)
        if first in (0, 1) and all(first + k in row for k in range(16)) and len(row) == 16:
            return tuple(row[first + k] for k in range(16))
    return ()


class Clock:
    """The column or columns that hold a log's times, and their unit."""

    def __init__(self, where: str, there: Sequence[str], schema: StateSchema) -> None:
        """Find them; EstimatorError if none, or several, may hold the time."""
        log = schema.log
        found = time_columns(there, log.time)
        if found is None:
            which = candidates(there)
            problem = (
                f"has no column '{log.time}'; it has {', '.join(there[:8])}"
                if log.time
                else f"which of {' and '.join(which)} holds the time?"
                if which
                else f"lacks {TIME}, and no other of its columns is called a time: it has "
                f"{', '.join(there[:8])}"
            )
            raise EstimatorError(f"{where}: {problem}: name it in a robot.toml: [log] time = ...")
        self._where = where
        self.columns = tuple(there[index] for index, _ in found)
        self._units_s: Floats | None = np.array([unit for _, unit in found])
        if log.time_unit_s is not None:
            self._units_s = np.array([log.time_unit_s])
        elif len(found) == 1 and found[0][1] == 1.0 and stated_unit_s(self.columns[0]) is None:
            self._units_s = None

    def seconds(self, values: Floats) -> Floats:
        """Times (n,) of the columns' numbers (n, 1 or 2); the first rows tell a unit not stated."""
        if self._units_s is None:
            self._units_s = np.array([UNITS_S[self._unit(values[:, 0])]])
        return np.asarray(values @ self._units_s)

    def _unit(self, times: Floats) -> str:
        """By the steps, and by the date where the times count from 1970."""
        steps = np.diff(times)
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else np.nan
        may_be = [n for n, unit in UNITS_S.items() if STEPS_S[0] <= step * unit <= STEPS_S[1]]
        middle = float(np.nanmedian(times)) if np.isfinite(times).any() else np.nan
        dated = [n for n in may_be if _EPOCH_S[0] <= middle * UNITS_S[n] < _EPOCH_S[1]]
        if 1 not in (len(dated), len(may_be)):
            raise EstimatorError(
                f"{self._where}: column '{self.columns[0]}' states no unit, and its steps of "
                f"{step:g} may be {' or '.join(may_be) or 'anything'}: give it in a robot.toml: "
                '[log] time_unit = "s"'
            )
        return (dated if len(dated) == 1 else may_be)[0]
