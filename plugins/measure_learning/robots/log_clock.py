"""The time of a robot's log: its columns, their unit, and which rows are new states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats
from measure.errors import EstimatorError
from measure.limits import LEVER_MM
from measure.reading import TIME, candidates, stated_unit_s, time_columns
from measure.robots.schema import StateSchema
from measure_learning.robots.columns import UNITS_S

_SLOWEST_S, _FASTEST_S = 1.0, 1e-4  # Steps of robot logs
_EPOCH_S = (1e9, 1e10)  # Seconds since 1970 of the years 2001 to 2286
_GOES_ON = 0.4
"""Share of its speed before and after that an arm keeps across a state that is held. An arm that
stands for two rows and starts again at full speed keeps a third."""
_LEAST_MM, _LEAST_SHARE = 0.2, 0.01
"""Way across a held state that harms labels, and share of such rows, from which it is worth a word:
rounding of a slow joint and a lost packet are not."""


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
