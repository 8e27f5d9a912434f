"""The two kinds of small nets of `stream`: an ensemble of perceptrons, and stateful GRUs.

Both map scaled inputs to joint errors and a direct tip error (or the latter alone). Here they are
plain arrays and ONNX operators; `_training` trains them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure_learning.onnx import Graph, Value

_GATES = ("from_input", "from_hidden", "input_bias", "hidden_bias")
STEP_GAIN = 3.0  # scales differences between steps to the size of the other inputs


@dataclass(frozen=True, eq=False)
class Perceptrons:
    """Members of an ensemble: weights (members, in, out) and biases (members, 1, out) by layer."""

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]

    def values(self) -> dict[str, Any]:
        """As a checkpoint stores it."""
        return {name: list(map(_tensor, getattr(self, name))) for name in ("weights", "biases")}

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Perceptrons:
        """What `values` gave."""
        return cls(*(tuple(map(array_of, values[name])) for name in ("weights", "biases")))

    def in_graph(self, graph: Graph, inputs: Value) -> Value:
        """(members, N, outputs)."""
        x = inputs
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = graph.affine(x, weight, bias)
            if index < len(self.weights) - 1:
                x = graph.op("Mul", x, graph.op("Sigmoid", x))
        return x


@dataclass(frozen=True, eq=False)
class Grus:
    """Members of an ensemble of one-layer GRUs with a two-layer head on (hidden, inputs).

    Gates in torch's order: reset, update, new. Arrays have the members first.
    """

    from_input: Floats
    from_hidden: Floats
    input_bias: Floats
    hidden_bias: Floats
    head: Perceptrons

    def values(self) -> dict[str, Any]:
        """As a checkpoint stores it."""
        return {name: _tensor(getattr(self, name)) for name in _GATES} | {
            "head": self.head.values()
        }

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Grus:
        """What `values` gave."""
        gates = {name: array_of(values[name]) for name in _GATES}
        return cls(**gates, head=Perceptrons.from_values(values["head"]))

    @property
    def members(self) -> int:
        """Number of nets."""
        return int(self.from_hidden.shape[0])

    @property
    def hidden(self) -> int:
        """Hidden units of each."""
        return int(self.from_hidden.shape[1])

    def in_graph(
        self, graph: Graph, inputs: Value, steps: Value, memory: Value
    ) -> tuple[Value, Value]:
        """Outputs (members, N, outputs) and new memory (N, members x hidden).

        `steps` are the differences of the moving inputs since the memory was last kept, times
        `STEP_GAIN`.
        """
        seen = graph.op("Concat", inputs, steps, axis=1)
        h = graph.op(
            "Transpose", graph.reshape(memory, -1, self.members, self.hidden), perm=[1, 0, 2]
        )
        given = graph.ops("Split", 3, graph.affine(seen, self.from_input, self.input_bias), axis=2)
        kept = graph.ops("Split", 3, graph.affine(h, self.from_hidden, self.hidden_bias), axis=2)
        reset = graph.op("Sigmoid", graph.op("Add", given[0], kept[0]))
        update = graph.op("Sigmoid", graph.op("Add", given[1], kept[1]))
        fresh = graph.op("Tanh", graph.op("Add", given[2], graph.op("Mul", reset, kept[2])))
        h = graph.mix(update, h, fresh)
        spread = graph.op("Add", inputs, np.zeros((self.members, 1, 1)))
        out = self.head.in_graph(graph, graph.op("Concat", h, spread, axis=2))
        after = graph.op("Transpose", h, perm=[1, 0, 2])
        return out, graph.reshape(after, -1, self.members * self.hidden)


def stack_grus(nets: list[Grus]) -> Grus:
    """Several trained GRUs as one ensemble."""
    gates = {name: np.concatenate([getattr(net, name) for net in nets]) for name in _GATES}
    weights, biases = (
        tuple(map(np.concatenate, zip(*(getattr(net.head, name) for net in nets), strict=True)))
        for name in ("weights", "biases")
    )
    return Grus(**gates, head=Perceptrons(weights, biases))


def _tensor(values: Floats) -> Any:
    import torch

    return torch.from_numpy(values)


def array_of(tensor: Any) -> Floats:
    """The numbers of a torch tensor."""
    return np.asarray(tensor.detach().numpy(), dtype=np.float64)
