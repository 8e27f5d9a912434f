"""Linear regression, which on play states is a hysteresis model with one matrix product."""

from __future__ import annotations

from typing import Literal

import numpy as np

from measure import host
from measure.arrays import Floats
from measure_plugins.estimators._inputs import (
    StateWindow,
    WithinTrajectoryEstimator,
    informative_features,
)
from measure_plugins.estimators._play import PlayBank


class RidgeSettings(host.Settings):
    """Settings of `ridge`."""

    features: Literal["pose", "window", "play"] = host.setting(
        "play", "Features: the state, the last states, or the state and its play operators."
    )
    window: int = host.setting(12, "Number of states in a window.", ge=2)
    play_widths: int = host.setting(8, "Number of play operators per joint combination.", ge=1)
    penalty: float = host.setting(1e-3, "Ridge penalty, relative to the features' variance.", ge=0)


class RidgeEstimator(WithinTrajectoryEstimator):
    """Weighted ridge regression on the pose, a window of poses, or play (hysteresis) states."""

    name = "ridge"
    Config = RidgeSettings
    config: RidgeSettings

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Solve the normal equations."""
        self._columns = informative_features(data)
        self._scaling = host.Scaling.of(data.states[:, self._columns])
        self._bank = PlayBank.of(data, self.config.play_widths, 0.01, 0.2)
        self._window = StateWindow(len(self._columns), self.config.window)
        inputs = self._inputs(data)
        used = data.usable
        self._weight = fit_linear(
            inputs[used], data.errors_mm[used], data.weights()[used], self.config.penalty
        )
        report(1.0, "solved")

    def _inputs(self, data: host.Dataset) -> Floats:
        pose = self._scaling.apply(data.states[:, self._columns])
        if self.config.features == "play":
            return np.concatenate([pose, self._bank.features(data)], axis=1)
        if self.config.features == "window":
            return self._window.features(data, pose)
        return pose

    def compute(
        self, graph: host.Graph, features: host.Value, memory: host.Value, tick: host.Value
    ) -> host.Core:
        """One matrix product on the chosen features."""
        pose = self._scaling.in_graph(graph, graph.columns(features, self._columns))
        weight, bias = self._weight[:-1], self._weight[-1:]
        if self.config.features == "pose":
            return host.Core(graph.affine(pose, weight, bias))
        if self.config.features == "window":
            inputs, after = self._window.in_graph(graph, pose, memory, tick)
            return host.Core(
                graph.affine(inputs, weight, bias), after, memory_size=self._window.size
            )
        sizes = graph.constant([1, self._bank.size], np.int64)
        started, states = graph.ops("Split", 2, memory, sizes, axis=1)
        play, states = self._bank.in_graph(graph, features, states, started)
        begun = graph.ones_like(started)
        inputs = graph.op("Concat", pose, play, axis=1)
        after = graph.op("Concat", begun, states, axis=1)
        return host.Core(graph.affine(inputs, weight, bias), after, memory_size=1 + self._bank.size)


def fit_linear(inputs: Floats, labels: Floats, weights: Floats, penalty: float) -> Floats:
    """Weighted ridge regression; (inputs + 1, outputs), the last row being the intercept."""
    design = np.concatenate([inputs, np.ones((len(inputs), 1))], axis=1)
    normal = design.T @ (design * weights[:, None])
    shrink = penalty * len(inputs) * np.eye(len(normal))
    shrink[-1, -1] = 0.0
    return np.asarray(
        np.linalg.lstsq(normal + shrink, design.T @ (labels * weights[:, None]), rcond=None)[0]
    )


@host.hookimpl
def measure_estimators() -> list[type[host.Estimator]]:
    """Register the estimator."""
    return [RidgeEstimator]
