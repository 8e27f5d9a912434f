"""The time of a robot's log: its columns and their unit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.reading import TIME, candidates, stated_unit_s, time_columns
from measure.robots.schema import StateSchema
from measure_learning.robots.columns import UNITS_S

_SLOWEST_S, _FASTEST_S = 1.0, 1e-4  # Steps of robot logs
_EPOCH_S = (1e9, 1e10)  # Seconds since 1970 of the years 2001 to 2286


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
