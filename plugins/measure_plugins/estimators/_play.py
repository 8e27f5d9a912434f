"""Play (backlash) operators: y <- min(max(y, x - w), x + w), the memory of slack cables.

Features are (x - y) / w in [-1, 1]: where inside its play each joint stands, over several widths.
A joint, and every sum and difference of joints that share cables, has its own operators.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.host import Dataset, Graph, Value
from measure.robots import StateSchema


@dataclass(frozen=True, eq=False)
class PlayBank:
    """Play operators over combinations of joints."""

    mixing: Floats  # (features, combinations): combinations of joints, from the raw state
    widths: Floats  # (combinations, widths) half-widths

    @classmethod
    def of(cls, data: Dataset, count: int, narrowest: float, widest: float) -> PlayBank:
        """Widths spaced geometrically over the range (1st to 99th percentile) of each combination.

        Args:
            data: training trajectories; a robot without joints plays on its reported position.
            narrowest: of the range.
            widest: of the range.
        """
        mixing = _mixing(data.schema)
        low, high = np.percentile(data.states @ mixing, [1, 99], axis=0)
        moving = high - low > 1e-9
        span = (high - low)[moving]
        return cls(mixing[:, moving], span[:, None] * np.geomspace(narrowest, widest, count))

    @property
    def size(self) -> int:
        """Number of play states, which is also that of the features."""
        return int(self.widths.size)

    def features(self, data: Dataset) -> Floats:
        """(n, size), every trajectory from rest."""
        from measure_plugins.estimators._play_kernel import play

        mixed = data.states @ self.mixing
        return np.concatenate([play(mixed[rows], self.widths) for _, rows in data.runs()])

    def in_graph(
        self, graph: Graph, features: Value, states: Value, started: Value
    ) -> tuple[Value, Value]:
        """Features (N, size) and new play states (N, size); `started` (N, 1) is zero at a reset."""
        repeated = np.repeat(self.mixing, self.widths.shape[1], axis=1)
        x = graph.op("MatMul", features, repeated)
        widths = self.widths.reshape(1, -1)
        before = graph.mix(started, states, x)
        after = graph.op(
            "Min", graph.op("Max", before, graph.op("Sub", x, widths)), graph.op("Add", x, widths)
        )
        return graph.op("Mul", graph.op("Sub", x, after), 1.0 / widths), after


def _mixing(schema: StateSchema) -> Floats:
    readings = schema.reading_matrix(schema.joints or schema.position)
    count = readings.shape[1]
    rows = list(np.eye(count))
    for a, b in itertools.combinations(schema.coupled, 2):
        rows += [np.eye(count)[a] + np.eye(count)[b], np.eye(count)[a] - np.eye(count)[b]]
    return readings @ np.array(rows).T
