"""An estimator that is linear in the robot's state."""

from __future__ import annotations

import numpy as np

from measure.host import Dataset, Estimator, Report, Settings, hookimpl, setting
from measure_learning.onnx import Core, Graph, OnnxEstimator, Scaling, Value


class LinearSettings(Settings):
    """Settings of the `linear` estimator."""

    least_share: float = setting(
        1e-6, "Directions of the state that vary less, as a share, are left out.", gt=0, lt=1
    )


class LinearEstimator(OnnxEstimator):
    """Least squares on the scaled state."""

    name = "linear"
    Config = LinearSettings
    config: LinearSettings
    memoryless = True

    def learn(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Fit."""
        self._scaling = Scaling.of(data.states)
        used = data.usable
        inputs = np.column_stack([self._scaling.apply(data.states[used]), np.ones(used.sum())])
        self._solution = np.linalg.lstsq(
            inputs, data.errors_mm[used], rcond=self.config.least_share
        )[0]
        report(1.0, "solved")

    def compute(self, graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        """The same as operators."""
        scaled = self._scaling.in_graph(graph, features)
        return Core(graph.affine(scaled, self._solution[:-1], self._solution[-1]))


@hookimpl
def measure_estimators() -> list[type[Estimator]]:
    """Register `linear`."""
    return [LinearEstimator]
