"""Play (backlash) operators: y <- min(max(y, x - w), x + w), the memory of slack cables.

Features are (x - y) / w in [-1, 1]: where inside its play each joint stands, over several widths.
A joint has its own operators, and so have sums and differences of joints that share cables. Which
of them a motor moves is not known: each of a pair may count by half, too.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.host import Dataset
from measure.robots import StateSchema
from measure_learning.onnx import Graph, Value

_WHOLE = np.array([[1, 1], [1, -1]])
_HALF = np.array([[1, 0.5], [1, -0.5], [0.5, 1], [-0.5, 1]])


@dataclass(frozen=True, eq=False)
class PlayBank:
    """Play operators over combinations of joints."""

    mixing: Floats  # (features, combinations): combinations of joints, from the raw state
    widths: Floats  # (combinations, widths) half-widths

    @classmethod
    def of(
        cls, data: Dataset, count: int, narrowest: float, widest: float, *, halves: bool = False
    ) -> PlayBank:
        """Widths spaced geometrically over the range (1st to 99th percentile) of each combination.

        Args:
            data: training trajectories; a robot without joints plays on its reported position.
            narrowest: of the range.
            widest: of the range.
            halves: whether one joint of a pair may count by half.
        """
        mixing = _mixing(data.schema, np.concatenate([_WHOLE, _HALF]) if halves else _WHOLE)
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
        from measure_learning.estimators._play_kernel import play

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


def _mixing(schema: StateSchema, shares: Floats) -> Floats:
    readings = schema.reading_matrix(schema.joints or schema.position)
    alone = np.eye(readings.shape[1])
    pairs = (shares @ alone[list(pair)] for pair in itertools.combinations(schema.coupled, 2))
    return readings @ np.concatenate([alone, *pairs]).T
