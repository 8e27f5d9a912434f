"""Selection of features: those that vary within trajectories."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats
from measure.host import Dataset
from measure_learning.onnx import Graph, OnnxEstimator, Value

_MAX_BETWEEN_SHARE = 0.3  # Largest share of a feature's variance that may lie between trajectories


def informative_features(data: Dataset) -> list[int]:
    """Columns that vary, and not mainly between trajectories.

    A feature that is constant within a trajectory (an encoder offset, new at each restart) only
    identifies the training trajectories, and an estimator would overfit to it. So a column is
    left out if over 30 % of its variance lies between trajectories, except those that joints (or,
    without joints, the position) are read from. A position that follows from the joints is left
    out, too.
    """
    varying, between, needed = _kinds(data)
    if data.schema.chain is not None:  # the position is a function of the joints
        position = np.any(data.schema.reading_matrix(data.schema.position) != 0, axis=1)
        varying &= ~position | needed
    return [int(i) for i in np.flatnonzero(varying & (~between | needed))]


class WithinTrajectoryEstimator(OnnxEstimator):
    """An estimator that does not use features which vary mainly between trajectories."""

    def watched(self, data: Dataset) -> list[int]:
        """Columns that must resemble the training: all but those that are not used."""
        _, between, needed = _kinds(data)
        return [int(i) for i in np.flatnonzero(~between | needed)]


def _kinds(data: Dataset) -> tuple[Bools, Bools, Bools]:
    """Columns that vary, that vary between trajectories, and that positions are read from."""
    schema, states = data.schema, data.states
    total = states.var(axis=0)
    means = np.array([states[rows].mean(axis=0) for _, rows in data.runs()])
    sizes = np.array([rows.stop - rows.start for _, rows in data.runs()])
    variance = np.average((means - states.mean(axis=0)) ** 2, axis=0, weights=sizes)
    varying = total > (1e-6 * np.maximum(np.abs(states).max(axis=0), 1e-6)) ** 2
    between = (variance > _MAX_BETWEEN_SHARE * total) & (len(means) > 1)
    needed = np.any(schema.reading_matrix(schema.joints or schema.position) != 0, axis=1)
    return varying, between, needed


@dataclass(frozen=True)
class StateWindow:
    """The present and `length - 1` earlier rows of `width` columns, newest first.

    Before the first row of a trajectory, the first row is repeated.
    """

    width: int
    length: int

    @property
    def size(self) -> int:
        """Numbers to remember: a started flag and the earlier rows."""
        return 1 + self.width * (self.length - 1)

    def features(self, data: Dataset, rows: Floats) -> Floats:
        """(n, length x width)."""
        out = np.empty((len(rows), self.length * self.width))
        for _, part in data.runs():
            index = np.arange(part.stop - part.start)
            for lag in range(self.length):
                columns = slice(lag * self.width, (lag + 1) * self.width)
                out[part, columns] = rows[part][np.maximum(index - lag, 0)]
        return out

    def in_graph(self, graph: Graph, row: Value, memory: Value, tick: Value) -> tuple[Value, Value]:
        """The features and the new memory."""
        held = self.width * (self.length - 1)
        sizes = graph.constant([1, held], np.int64)
        started, earlier = graph.ops("Split", 2, memory, sizes, axis=1)
        repeated = graph.op("Concat", *[row] * (self.length - 1), axis=1)
        earlier = graph.mix(started, earlier, repeated)
        window = graph.op("Concat", row, earlier, axis=1)
        shifted = graph.columns(window, range(held))
        begun = graph.ones_like(started)
        kept = graph.mix(tick, shifted, earlier)
        return window, graph.op("Concat", begun, kept, axis=1)
