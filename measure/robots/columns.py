"""Which columns of a log are a robot's features, and which unit its times have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.reading import TIME, candidates, stated_unit_s, time_columns
from measure.robots.schema import StateSchema

_LARGEST_TURNS = 4.0  # No joint turns farther; degrees read as radians seem to
_SLOWEST_S, _FASTEST_S = 1.0, 1e-4  # Steps of robot logs
UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_EPOCH_S = (1e9, 1e10)  # Seconds since 1970 of the years 2001 to 2286
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
        turns = np.abs(joints[:, index]) / (2 * np.pi)
        if not joint.prismatic and (turns > _LARGEST_TURNS).any():
            name = schema.joints[index].terms[0][0]
            raise EstimatorError(
                f"{where}: joint '{name}' seems to turn {np.nanmax(turns):.0f} times round: is "
                "its column in degrees? Give its unit in a robot.toml"
            )


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
        may_be = [n for n, unit in UNITS_S.items() if _FASTEST_S <= step * unit <= _SLOWEST_S]
        middle = float(np.nanmedian(times)) if np.isfinite(times).any() else np.nan
        dated = [n for n in may_be if _EPOCH_S[0] <= middle * UNITS_S[n] < _EPOCH_S[1]]
        if 1 not in (len(dated), len(may_be)):
            raise EstimatorError(
                f"{self._where}: column '{self.columns[0]}' states no unit, and its steps of "
                f"{step:g} may be {' or '.join(may_be) or 'anything'}: give it in a robot.toml: "
                '[log] time_unit = "s"'
            )
        return (dated if len(dated) == 1 else may_be)[0]
