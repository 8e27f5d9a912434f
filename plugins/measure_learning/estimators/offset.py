"""One constant correction: what a restart's static offset costs, and nothing more."""

from __future__ import annotations

import numpy as np

from measure.host import Dataset, Estimator, Report, Settings, hookimpl
from measure_learning.estimators._inputs import WithinTrajectoryEstimator
from measure_learning.onnx import Core, Graph, Value


class OffsetEstimator(WithinTrajectoryEstimator):
    """The weighted mean of the training errors."""

    name = "offset"
    Config = Settings
    memoryless = True

    def learn(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Average."""
        used = data.usable
        self._mean = np.average(data.errors_mm[used], axis=0, weights=data.weights()[used])
        report(1.0, "averaged")

    def compute(self, graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        """The mean, whatever the state."""
        nothing = graph.op("Mul", graph.columns(features, [0]), np.zeros((1, 3)))
        return Core(graph.op("Add", nothing, self._mean))


@hookimpl
def measure_estimators() -> list[type[Estimator]]:
    """Register the estimator."""
    return [OffsetEstimator]
