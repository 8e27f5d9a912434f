"""A log on disk: its times and positions in memory, its states read again when they are wanted."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.errors import EstimatorError
from measure.robots.logs import log_pieces
from measure.robots.schema import StateSchema, reported_mm


class LogFile:
    """A log of any length; see `StateLog` for what its parts are.

    The file is read once when this is built, and once more for every call of `states_at`.
    """

    def __init__(self, path: Path, schema: StateSchema, topic: str | None = None) -> None:
        """Read the file.

        Raises:
            EstimatorError: as `read_log`.
        """
        self.schema, self._path, self._topic = schema, path, topic
        times, places, whole = list[Floats](), list[Floats](), list[Bools]()
        self.broken: Ints = np.zeros(len(schema.features), dtype=np.int64)
        for piece, states in log_pieces(path, schema, topic):
            finite = np.isfinite(states)
            self.broken += (~finite).sum(axis=0)
            complete = np.asarray(finite.all(axis=1))
            times.append(piece)
            whole.append(complete)
            places.append(reported_mm(schema, states, complete))
        self.times_s: Floats = np.concatenate(times)
        self.complete: Bools = np.concatenate(whole)
        self.reported_mm: Floats = np.concatenate(places)

    def states_at(self, rows: Ints) -> Floats:
        """States (k, features) of some rows (k,), in any order.

        Raises:
            EstimatorError: the file has changed since.
        """
        order = np.argsort(rows, kind="stable")
        wanted = rows[order]
        out = np.empty((len(rows), len(self.schema.features)))
        start = done = 0
        for times, states in log_pieces(self._path, self.schema, self._topic):
            stop = int(np.searchsorted(wanted, start + len(times)))
            out[order[done:stop]] = states[wanted[done:stop] - start]
            start, done = start + len(times), stop
        if start != len(self.times_s):
            raise EstimatorError(f"{self._path}: has changed while it was read: try again")
        return out
