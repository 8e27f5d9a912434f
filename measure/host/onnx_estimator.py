"""The base of estimators that become one ONNX graph: scaling, covariance, saving, streaming."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import DivergedError, EstimatorError
from measure.host.dataset import Dataset
from measure.host.estimator import Correction, Estimator, Report
from measure.host.onnx_facts import FORMAT
from measure.host.onnx_graph import Graph, Value
from measure.host.onnx_model import OnnxModel
from measure.host.settings import Settings
from measure.robots import StateSchema

_RANGE_MARGIN = 1.5  # range of familiar states, as a multiple of that in training
_MAX_CORRECTION_MM = 1e6  # larger corrections mean a diverged fit
_CLIP_SDS = 8.0  # scaled features are clipped to this many SDs


@dataclass(frozen=True, eq=False)
class Core:
    """Outputs of a plugin's part of the graph.

    Attributes:
        error: (N, 3) mm.
        memory: (N, S), the new memory; None if the estimator has none.
        spread: (N, 1) mm^2, variance within the estimator (of an ensemble, say); None if unknown.
        memory_size: S.
    """

    error: Value
    memory: Value | None = None
    spread: Value | None = None
    memory_size: int = 0


@dataclass(frozen=True, eq=False)
class Scaling:
    """Zero mean and unit standard deviation; a feature that never varied is scaled to zero.

    Attributes:
        mean: (columns,) of the training data.
        sd: (columns,) standard deviations of the training data.
    """

    mean: Floats
    sd: Floats

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


class OnnxEstimator(Estimator):
    """An estimator whose plugin implements `learn` and `compute`.

    The covariance of a correction is the second moment of the validation residuals, scaled by
    `a + b strangeness + c spread` with a, b, c >= 0 fitted to those residuals, so that it grows
    with the distance from the training states.

    Attributes:
        memoryless: whether a correction depends on the present state alone.
    """

    memoryless = False

    def __init__(self, config: Settings) -> None:
        super().__init__(config)
        self._schema: StateSchema | None = None
        self._period_s = 0.0
        self._moment = np.eye(3)
        self._growth = np.array([1.0, 0.0, 0.0])
        self._model: OnnxModel | None = None

    @abstractmethod
    def learn(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Fit whatever `compute` needs."""

    @abstractmethod
    def compute(self, graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        """Add the estimator's operators, from raw `features` (N, F) and `memory` (N, S)."""

    def watched(self, data: Dataset) -> Sequence[int]:
        """Columns that must resemble the training; what the estimator ignores need not."""
        return range(data.states.shape[1])

    def fit(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Learn, then fit the covariance to the validation trajectories.

        Raises:
            EstimatorError: the data cannot be learnt from.
            DivergedError: corrections are not finite, or of kilometres.
        """
        _check_data(data, validation)
        self._schema = data.schema
        steps = np.concatenate([np.diff(data.times_s[rows]) for _, rows in data.runs()])
        known = steps[np.isfinite(steps) & (steps > 0)]
        self._period_s = float(np.median(known)) if len(known) else 0.0
        self._novelty = _Novelty.of(data, validation, self.watched(data))
        self._moment, self._growth = np.eye(3), np.array([1.0, 0.0, 0.0])
        self.learn(data, validation, seed=seed, report=report)
        self._calibrate(validation)
        self._model = OnnxModel(self._build({}))

    def save(self, path: Path, card: Mapping[str, Any]) -> None:
        """Write the ONNX file."""
        path.write_bytes(self._build(card))

    @property
    def model(self) -> OnnxModel:
        """The fitted graph, ready to run.

        Raises:
            EstimatorError: nothing has been learnt yet.
        """
        if self._model is None:
            raise EstimatorError(f"estimator '{self.name}' has not been fitted: call fit first")
        return self._model

    def reset(self) -> None:
        """Forget all history."""
        self.model.reset()

    def update(self, state: Floats, time_s: float) -> Correction:
        """Estimate the error of the next state."""
        return self.model.update(state, time_s)

    def _build(self, card: Mapping[str, Any], *, judging: bool = False) -> bytes:
        assert self._schema is not None
        graph = Graph()
        core = self.compute(graph, "features", "memory", "tick")
        strangeness = self._novelty.in_graph(graph, "features")
        size = max(core.memory_size, 1)
        memory = core.memory or graph.op("Mul", "memory", np.float32(0.0))
        spread = core.spread or graph.op("Mul", strangeness, np.float32(0.0))
        parts = graph.op("Concat", strangeness, spread, axis=1)
        if judging:  # the covariance's nine places carry its ingredients
            covariance = graph.op("Concat", *[parts] * 4, strangeness, axis=1)
        else:
            scale = graph.affine(parts, self._growth[1:, None], self._growth[:1])
            covariance = graph.op("Mul", scale, self._moment.reshape(1, 9))
        facts = {
            "format": FORMAT,
            "estimator": self.name,
            "settings": self.config.model_dump(mode="json"),
            "robot": self._schema.robot,
            "schema": self._schema.to_dict(),
            "features": [[f.name, f.unit] for f in self._schema.features],
            "position_mm": self._schema.reading_matrix(self._schema.position).tolist(),
            "period_s": self._period_s,
            "memory": size,
            "memoryless": self.memoryless,
        }
        return graph.build(
            {"features": len(self._schema.features), "memory": size, "tick": 1},
            {
                "error_mm": (core.error, (3,)),
                "covariance": (covariance, (9,)),
                "strangeness": (strangeness, (1,)),
                "memory_out": (memory, (size,)),
            },
            {"measure": facts, "card": dict(card)},
        )

    def _calibrate(self, validation: Dataset) -> None:
        from scipy.optimize import nnls  # slow to load

        with np.errstate(over="ignore"):  # what is too large for float32 is found here
            estimates = OnnxModel(self._build({}, judging=True)).predict(validation)
        if not (np.abs(estimates.errors_mm) < _MAX_CORRECTION_MM).all():
            raise DivergedError(
                f"the fit of estimator '{self.name}' diverged, its corrections are no numbers or "
                "of kilometres: choose other settings, such as a lower learning rate"
            )
        used = validation.usable
        residual = (validation.errors_mm - estimates.errors_mm)[used]
        noise = validation.covariances[used].mean(axis=0)
        moment = residual.T @ residual / len(residual)
        values, axes = np.linalg.eigh(moment - noise)
        floor = 0.05 * np.linalg.eigvalsh(moment).max() + 1e-6
        self._moment = (axes * np.maximum(values, floor)) @ axes.T
        squared = (
            np.einsum("ni,ij,nj->n", residual, np.linalg.inv(self._moment + noise), residual) / 3.0
        )
        ingredients = np.ones((len(residual), 3))
        ingredients[:, 1:] = estimates.covariances[used].reshape(-1, 9)[:, :2]
        limit = np.quantile(squared, 0.99)  # outliers of the label must not inflate everything
        growth, _ = nnls(ingredients, np.minimum(squared, limit))
        mean = float((ingredients @ growth).mean())
        self._growth = growth / mean if mean > 0 else np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class _Novelty:
    """Distance of a state from the training states: in range of a feature, and Mahalanobis."""

    middle: Floats
    half_range: Floats
    scaling: Scaling
    whitener: Floats
    limit: float

    @classmethod
    def of(cls, data: Dataset, validation: Dataset, watched: Sequence[int]) -> _Novelty:
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
        limit = _RANGE_MARGIN * float(np.quantile(distance, 0.999))
        reach = np.where(ignored, np.inf, np.maximum(half, floor))
        return cls(middle, reach, scaling, whitener, limit)

    def in_graph(self, graph: Graph, features: Value) -> Value:
        off = graph.op("Sub", features, self.middle)
        outside = graph.op("Abs", graph.op("Mul", off, 1.0 / (_RANGE_MARGIN * self.half_range)))
        farthest = graph.op("ReduceMax", outside, axes=[1], keepdims=1)
        white = graph.op("MatMul", self.scaling.in_graph(graph, features), self.whitener)
        squared = graph.op("ReduceMean", graph.op("Mul", white, white), axes=[1], keepdims=1)
        return graph.op("Max", farthest, graph.op("Mul", squared, np.float32(1.0 / self.limit)))


def _check_data(data: Dataset, validation: Dataset) -> None:
    for what, part in (("training", data), ("validation", validation)):
        if part.usable.sum() < 10:
            raise EstimatorError(
                f"the {what} part has {int(part.usable.sum())} usable labels, at least 10 are "
                "needed: record more, or split otherwise"
            )
        if not np.all(np.isfinite(part.states)):
            row, column = np.argwhere(~np.isfinite(part.states))[0]
            raise EstimatorError(
                f"the {what} part has a state that is not a number: row {row}, feature "
                f"'{part.schema.names[column]}'"
            )
        if np.any(~np.isfinite(part.errors_mm[part.usable])):
            raise EstimatorError(f"the {what} part has usable labels that are not numbers")
    if shared := set(data.present()) & set(validation.present()):
        raise EstimatorError(
            f"trajectory {sorted(shared)[0]} is in training and validation: split by trajectory"
        )
