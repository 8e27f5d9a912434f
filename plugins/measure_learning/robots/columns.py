"""Columns of a log that hold a robot's features, whatever stands before and behind their names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.reading import listed
from measure.robots.schema import OtherNames, StateSchema

_LARGEST_TURNS = 4.0  # No joint turns farther; degrees read as radians seem to
_LARGEST_SLIDE_MM = 2e4  # No axis is longer; mm read as metres seem to be
UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


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


_SEPARATORS = "/_.:- "
_LEAST_LETTERS = 5  # of a name that is sought inside others; `q1` is part of too many
_OTHER_QUANTITY = re.compile(
    r"vel|speed|rate|acc|eff|torque|current|temp|target|command|desired|error"
)
_BY_PLACE = re.compile(r"(?:.*[/.])?position[_.\[/]?\d+\]?")


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
