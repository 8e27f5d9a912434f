"""The last states as features: a shift register, advanced by the model's clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.host import Dataset, Graph, Value


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
