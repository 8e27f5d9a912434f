"""How far to trust a correction: distance from the states learnt from, and the covariance.

Both are fitted to rows that were not learnt from, of recordings left out where there are several.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from measure.arrays import Floats
from measure.host.dataset import Dataset
from measure.host.onnx_graph import Graph, Value
from measure.robots import StateSchema

_CLIP_SDS = 8.0  # scaled features are clipped to this many SDs
_STRANGE_SHARE = 0.01  # of rows that were not learnt from is called unfamiliar
_LIMITS = 0.8, 1.5  # least and largest distance from which on a state is
_FADING = 0.7  # of the travel, at each step of the training's rate
_ROUND = 3.0  # recordings' worth of offsets of one size in all directions: those of a 3-D prior
_ROUNDS, _LEAST = 6, 0.05  # of the fit of growth, and of the mean square that it may expect
DOUBTS = 4  # range, distance, travel, spread: what the covariance may grow with


@dataclass(frozen=True, eq=False)
class Scaling:
    """Zero mean and unit standard deviation; a feature that never varied is scaled to zero."""

    mean: Floats  # (columns,) of the training data
    sd: Floats  # (columns,) standard deviations of the training data

    @classmethod
    def of(cls, values: Floats) -> Scaling:
        """Measured on (n, columns)."""
        sd = values.std(axis=0)
        floor = 1e-6 * np.maximum(np.abs(values).max(axis=0), 1e-6)
        return cls(values.mean(axis=0), np.where(sd > floor, sd, np.inf))

    def apply(self, values: Floats) -> Floats:
        """Scaled and held within 8 SDs."""
        return np.clip((values - self.mean) / self.sd, -_CLIP_SDS, _CLIP_SDS)

    def in_graph(self, graph: Graph, x: Value) -> Value:
        """The same, as operators."""
        scaled = graph.op("Mul", graph.op("Sub", x, self.mean), 1.0 / self.sd)
        return graph.op("Clip", scaled, np.float32(-_CLIP_SDS), np.float32(_CLIP_SDS))


@dataclass(frozen=True, eq=False)
class Novelty:
    """Distances of a state from those learnt from, 1 at their edge: in range, and Mahalanobis."""

    middle: Floats
    half_range: Floats
    scaling: Scaling
    whitener: Floats

    @classmethod
    def of(cls, data: Dataset, validation: Dataset, watched: Sequence[int]) -> Novelty:
        """Of the columns `watched` only."""
        ignored = np.ones(data.states.shape[1], dtype=bool)
        ignored[list(watched)] = False
        states = np.concatenate([data.states, validation.states])
        low, high = states.min(axis=0), states.max(axis=0)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        floor = np.maximum(1e-3 * np.abs(middle), 1e-2)
        scaling = Scaling.of(data.states)
        scaling = Scaling(scaling.mean, np.where(ignored, np.inf, scaling.sd))
        scaled = scaling.apply(data.states)
        covariance = scaled.T @ scaled / len(scaled) + 0.05 * np.eye(scaled.shape[1])
        values, axes = np.linalg.eigh(covariance)
        whitener = axes / np.sqrt(values)
        distance = ((scaling.apply(states) @ whitener) ** 2).mean(axis=1)
        reach = np.where(ignored, np.inf, np.maximum(half, floor))
        edge = float(np.quantile(distance, 0.999))
        return cls(middle, reach, scaling, whitener / np.sqrt(edge))

    def in_graph(self, graph: Graph, features: Value) -> tuple[Value, Value]:
        """Both distances (N, 1)."""
        off = graph.op("Sub", features, self.middle)
        outside = graph.op("Abs", graph.op("Mul", off, 1.0 / self.half_range))
        white = graph.op("MatMul", self.scaling.in_graph(graph, features), self.whitener)
        return (
            graph.op("ReduceMax", outside, axes=[1], keepdims=1),
            graph.op("ReduceMean", graph.op("Mul", white, white), axes=[1], keepdims=1),
        )


@dataclass(frozen=True, eq=False)
class Travel:
    """How far joints (or the tip) moved lately, in their SDs; long moves leave larger errors."""

    reading: Floats  # (features, joints) from a state to scaled joints

    @classmethod
    def of(cls, schema: StateSchema, states: Floats) -> Travel:
        """Scaled by training states."""
        reading = schema.reading_matrix(schema.joints or schema.position)
        return cls(reading / np.maximum((states @ reading).std(axis=0), 1e-9))

    @property
    def size(self) -> int:
        """Of its memory: a started flag, the joints of the last tick, the travel until then."""
        return self.reading.shape[1] + 2

    def in_graph(
        self, graph: Graph, features: Value, memory: Value, tick: Value
    ) -> tuple[Value, Value]:
        """Travel (N, 1), fading with every tick, and the new memory."""
        sizes = graph.constant([1, self.size - 2, 1], np.int64)
        started, last, before = graph.ops("Split", 3, memory, sizes, axis=1)
        joints = graph.op("MatMul", features, self.reading)
        last = graph.mix(started, last, joints)
        moved = graph.op("ReduceL2", graph.op("Sub", joints, last), axes=[1], keepdims=1)
        travel = graph.op("Add", graph.op("Mul", before, np.float32(_FADING)), moved)
        now = graph.op("Concat", joints, travel, axis=1)
        kept = graph.mix(tick, now, graph.op("Concat", last, before, axis=1))
        return travel, graph.op("Concat", graph.ones_like(started), kept, axis=1)


@dataclass(frozen=True, eq=False)
class Judged:
    """Residuals of rows that were not learnt from, and what their size may depend on."""

    errors_mm: Floats  # (n, 3) before the correction
    residuals_mm: Floats  # (n, 3) after it
    labels: Floats  # (n, 3, 3) covariances of the labels, mm^2
    doubts: Floats  # (n, DOUBTS)
    offsets_mm: Floats  # (recordings, 3) means of the residuals

    @classmethod
    def join(cls, parts: Sequence[Judged]) -> Judged:
        """All rows of several."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def rms_mm(self) -> tuple[float, float]:
        """RMS of the error before and after the correction."""
        before, after = (
            float(np.sqrt((one**2).sum(axis=1).mean()))
            for one in (self.errors_mm, self.residuals_mm)
        )
        return before, after


@dataclass(frozen=True, eq=False)
class Trust:
    """The covariance of a correction, and the distance beyond which a state is unfamiliar.

    The covariance is `moment` times (1, range, distance, travel, spread) @ `growth`, all >= 0.
    """

    moment: Floats
    growth: Floats
    limit: float

    @classmethod
    def of(cls, judged: Judged) -> Trust:
        """Fit the second moment of the residuals, less the labels' own, and how it grows."""
        from scipy.optimize import nnls  # slow to load

        residual, noise = judged.residuals_mm, judged.labels.mean(axis=0)
        moment = residual.T @ residual / len(residual)
        offsets, count = judged.offsets_mm, len(judged.offsets_mm)
        offset = offsets.T @ offsets / count  # its shape, of a few, is half chance
        round_ = np.trace(offset) / 3.0 * np.eye(3)
        moment += _ROUND / (count + _ROUND) * (round_ - offset)
        values, axes = np.linalg.eigh(moment - noise)
        floor = 0.05 * np.linalg.eigvalsh(moment).max() + 1e-6
        moment = (axes * np.maximum(values, floor)) @ axes.T
        white = np.linalg.solve(moment + noise, residual.T).T
        squared = (residual * white).sum(axis=1) / 3.0
        ingredients = np.concatenate([np.ones((len(residual), 1)), judged.doubts], axis=1)
        limit = np.quantile(squared, 0.99)  # outliers of the label must not inflate everything
        squared, expected = np.minimum(squared, limit), np.ones(len(squared))
        for _ in range(_ROUNDS):  # what is expected to be large varies as much more
            growth, _ = nnls(ingredients / expected[:, None], squared / expected)
            expected = np.maximum(ingredients @ growth, _LEAST)
        mean = float((ingredients @ growth).mean())
        growth = growth / mean if mean > 0 else np.eye(DOUBTS + 1)[0]
        distance = judged.doubts[:, :2].max(axis=1)
        edge = float(np.quantile(distance, 1.0 - _STRANGE_SHARE))
        return cls(moment, growth, float(np.clip(edge, *_LIMITS)))

    def covariance(self, graph: Graph, doubts: Value) -> Value:
        """(N, 9)."""
        scale = graph.affine(doubts, self.growth[1:, None], self.growth[:1])
        return graph.op("Mul", scale, self.moment.reshape(1, 9))


UNJUDGED = Trust(np.eye(3), np.eye(DOUBTS + 1)[0], 1.0)
