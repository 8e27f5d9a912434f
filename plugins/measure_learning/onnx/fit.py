"""What an estimator has learnt, as a graph: its correction, and how far to trust it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from measure.errors import DivergedError
from measure.host.dataset import Dataset, recording_of
from measure.robots import StateSchema
from measure_learning.onnx import judging
from measure_learning.onnx.graph import Graph, Value
from measure_learning.onnx.model import FORMAT, OnnxModel, contract
from measure_learning.onnx.rotation import LEVER_MM

_MAX_CORRECTION_MM = 1e6  # larger corrections mean a diverged fit
_END = 2**31 - 1  # of a slice: all that follows


@dataclass(frozen=True, eq=False)
class Core:
    """Outputs of a plugin's part of the graph."""

    error: Value  # (N, 3) mm
    memory: Value | None = None  # (N, S), the new memory; None if the estimator has none
    # (N, 1) mm^2, variance within the estimator (of an ensemble, say); None if unknown.
    spread: Value | None = None
    memory_size: int = 0  # S


Compute = Callable[[Graph, Value, Value, Value], Core]  # see `OnnxEstimator.compute`


@dataclass(frozen=True, eq=False)
class _Outputs:
    """Of an estimator with all that judges it."""

    error: Value  # (N, 3) mm
    covariance: Value  # (N, 9) mm^2
    strangeness: Value  # (N, 1)
    contradiction: Value  # (N, 1)
    memory: Value  # (N, S), the new memory
    memory_size: int  # S, may be 0


@dataclass(frozen=True, eq=False)
class Fit:
    """An estimator fitted to some trajectories.

    Attributes:
        facts: what the metadata holds of the estimator, and of the states learnt from.
        compute: adds the estimator's operators to a graph.
        travel: None if a correction depends on the present state alone.
        trust: the covariance, once it is fitted to what was not learnt from.
        turning: corrects the rotation, beside this one; None if nothing does.
    """

    facts: Mapping[str, Any]
    schema: StateSchema
    compute: Compute
    envelope: judging.Envelope
    novelty: judging.Novelty
    travel: judging.Travel | None
    trust: judging.Trust = judging.UNJUDGED
    turning: Fit | None = None

    @cached_property
    def model(self) -> OnnxModel:
        """The graph, ready to run."""
        return OnnxModel(self.build({}))

    def build(self, card: Mapping[str, Any], *, bare: bool = False) -> bytes:
        """The ONNX file; where it is `bare`, the covariance's places carry its ingredients."""
        graph, features = Graph(), len(self.schema.features)
        if (turning := self.turning) is None:
            made, turned = self.in_graph(graph, "memory", bare=bare), {}
            memory, size = made.memory, made.memory_size
        else:
            size = self.in_graph(Graph(), "memory").memory_size
            made = self.in_graph(graph, _slice(graph, "memory", 0, size))
            other = turning.in_graph(graph, _slice(graph, "memory", size, _END))
            memory, size = made.memory, made.memory_size + other.memory_size
            if size:
                memory = graph.op("Concat", memory, other.memory, axis=1)
            rad = graph.op("Mul", other.error, np.float32(1.0 / LEVER_MM))
            rad2 = graph.op("Mul", other.covariance, np.float32(1.0 / LEVER_MM**2))
            turned = {"turn_rad": (rad, (3,)), "turn_covariance": (rad2, (9,))}
        size = max(size, 1)
        return graph.build(
            {"features": features, "memory": size, "tick": 1},
            {
                "error_mm": (made.error, (3,)),
                "covariance": (made.covariance, (9,)),
                "strangeness": (made.strangeness, (1,)),
                "contradiction": (made.contradiction, (1,)),
                "memory_out": (memory, (size,)),
                **turned,
            },
            {"measure": self._metadata(size), "card": dict(card)},
            contract(features, size, self.facts["period_s"], turns=bool(turned)),
        )

    def judge(self, data: Dataset) -> judging.Judged:
        """What is left of the errors of other trajectories; DivergedError: no corrections."""
        with np.errstate(over="ignore"):  # what is too large for float32 is found here
            estimates = OnnxModel(self.build({}, bare=True)).predict(data)
        if not (np.abs(estimates.errors_mm) < _MAX_CORRECTION_MM).all():
            raise DivergedError(
                f"the fit of estimator '{self.facts['estimator']}' diverged, its corrections are "
                "no numbers or of kilometres: choose other settings, such as a lower learning rate"
            )
        used = data.usable
        errors = data.errors_mm[used]
        ingredients = estimates.covariances[used].reshape(-1, 9)[:, : judging.INGREDIENTS]
        left = errors - estimates.errors_mm[used]
        recordings = np.array([recording_of(name) for name in data.names])[data.trajectory[used]]
        labels, far = data.covariances[used], estimates.strangeness[used]
        return judging.Judged(errors, left, labels, ingredients, far, recordings)

    def in_graph(self, graph: Graph, given: Value, *, bare: bool = False) -> _Outputs:
        """Add all of the estimator, with its covariance, whose memory is `given`."""
        memory, nothing = given, graph.op("Mul", "tick", np.float32(0.0))
        own, travel, size = None, nothing, 0
        if self.travel is not None:
            size = self.travel.size
            own, memory = _slice(graph, given, 0, size), _slice(graph, given, size, _END)
            travel, own = self.travel.in_graph(graph, "features", own, "tick")
        core = self.compute(graph, "features", memory, "tick")
        near = graph.op("Max", *self.novelty.in_graph(graph, "features"))
        farther = graph.op("Max", near, travel)
        familiar = np.float32(1.0 / self.trust.limit)
        near, strangeness = (graph.op("Mul", one, familiar) for one in (near, farther))
        contradiction = self.envelope.contradiction(graph, self.schema, "features")
        sound = graph.op("LessOrEqual", contradiction, np.ones((1, 1)))
        ingredients = judging.ingredients_in_graph(graph, farther, core.spread or nothing)
        if bare:
            error = core.error
            covariance = graph.op(
                "Concat", ingredients, *[nothing] * (9 - judging.INGREDIENTS), axis=1
            )
        else:
            covariance = self.trust.covariance(graph, ingredients)
            error, covariance = self.envelope.bounded(
                graph, core.error, covariance, strangeness, sound
            )
        parts = [part for part in (own, core.memory) if part is not None]
        after = graph.op("Concat", *parts, axis=1) if parts else nothing
        size += core.memory_size
        if size:
            after = self.envelope.kept(graph, near, sound, (_slice(graph, given, 0, size), after))
        strangeness = graph.op("Max", strangeness, contradiction)
        return _Outputs(error, covariance, strangeness, contradiction, after, size)

    def _metadata(self, memory: int) -> dict[str, Any]:
        """The metadata `measure`, see `measure_learning.onnx.model`."""
        schema = self.schema
        return {
            "format": FORMAT,
            **self.facts,
            "robot": schema.robot,
            "schema": schema.to_dict(),
            "features": [[f.name, f.unit] for f in schema.features],
            "position_mm": schema.reading_matrix(schema.position).tolist(),
            "memory": memory,
            "range": self.envelope.ranges.tolist(),
            "largest_mm": self.envelope.largest_mm,
            "gap_mm": self.envelope.gap_mm,
        }


def in_turn(first: Compute, then: Compute) -> Compute:
    """What both correct together; the memory of `first` stands first."""

    def compute(graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        size = first(Graph(), features, memory, tick).memory_size
        head = first(graph, features, _slice(graph, memory, 0, size), tick)
        tail = then(graph, features, _slice(graph, memory, size, _END), tick)
        kept = [part.memory for part in (head, tail) if part.memory is not None]
        return Core(
            graph.op("Add", head.error, tail.error),
            graph.op("Concat", *kept, axis=1) if kept else None,
            tail.spread or head.spread,
            size + tail.memory_size,
        )

    return compute


def _slice(graph: Graph, memory: Value, start: int, stop: int) -> Value:
    return graph.op("Slice", memory, *(graph.constant([v], np.int64) for v in (start, stop, 1)))
