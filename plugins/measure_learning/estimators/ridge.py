"""Linear regression, which on play states is a hysteresis model with one matrix product."""

from __future__ import annotations

from typing import Literal

import numpy as np

from measure import host
from measure.arrays import Floats
from measure_learning import onnx
from measure_learning.estimators._inputs import (
    StateWindow,
    WithinTrajectoryEstimator,
    informative_features,
)
from measure_learning.estimators._play import PlayBank
from measure_learning.onnx.kinematics import levers, tip_error


class RidgeSettings(host.Settings):
    """Settings of `ridge`."""

    features: Literal["pose", "window", "play"] = host.setting(
        "play", "Features: the state, the last states, or the state and its play operators."
    )
    window: int = host.setting(12, "Number of states in a window.", ge=2)
    play_widths: int = host.setting(8, "Number of play operators per joint combination.", ge=1)
    penalty: float = host.setting(0.03, "Ridge penalty, relative to the features' variance.", gt=0)


class RidgeEstimator(WithinTrajectoryEstimator):
    """Weighted ridge regression on the pose, a window of poses, or play (hysteresis) states.

    Where the robot's chain is known, it is of the joint errors W f that explain the tip error
    J(q) W f + V f: linear in W and V, so it is solved in closed form.
    """

    name = "ridge"
    Config = RidgeSettings
    config: RidgeSettings

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Solve the normal equations."""
        self._data_schema = data.schema
        self._columns = informative_features(data)
        self._scaling = onnx.Scaling.of(data.states[:, self._columns])
        self._bank = PlayBank.of(data, self.config.play_widths, 0.01, 0.2)
        self._window = StateWindow(len(self._columns), self.config.window)
        inputs = self._inputs(data)
        used = data.usable
        slopes, units = levers(data.rows(used))
        weight = _fit_outputs(
            inputs[used], data.errors_mm[used], data.weights()[used], self.config.penalty, slopes
        )
        self._weight = weight * units
        report(1.0, "solved")

    def _inputs(self, data: host.Dataset) -> Floats:
        pose = self._scaling.apply(data.states[:, self._columns])
        if self.config.features == "play":
            return np.concatenate([pose, self._bank.features(data)], axis=1)
        if self.config.features == "window":
            return self._window.features(data, pose)
        return pose

    def compute(
        self, graph: onnx.Graph, features: onnx.Value, memory: onnx.Value, tick: onnx.Value
    ) -> onnx.Core:
        """One matrix product on the chosen features."""
        pose = self._scaling.in_graph(graph, graph.columns(features, self._columns))
        inputs, after, size = pose, None, 0
        if self.config.features == "window":
            inputs, after = self._window.in_graph(graph, pose, memory, tick)
            size = self._window.size
        elif self.config.features == "play":
            sizes = graph.constant([1, self._bank.size], np.int64)
            started, states = graph.ops("Split", 2, memory, sizes, axis=1)
            play, states = self._bank.in_graph(graph, features, states, started)
            inputs = graph.op("Concat", pose, play, axis=1)
            after = graph.op("Concat", graph.ones_like(started), states, axis=1)
            size = 1 + self._bank.size
        outputs = graph.affine(inputs, self._weight[:-1], self._weight[-1:])
        error = tip_error(graph, self._data_schema, features, outputs)
        return onnx.Core(error, after, memory_size=size)


def _fit_outputs(
    inputs: Floats, labels: Floats, weights: Floats, penalty: float, slopes: Floats
) -> Floats:
    """Weights (inputs + 1, outputs) whose outputs, times slopes (n, 3, outputs), are the labels.

    The normal equations are put together block by block: J'J varies by row, f f' is common.
    """
    design = np.concatenate([inputs, np.ones((len(inputs), 1))], axis=1)
    size, outputs = design.shape[1], slopes.shape[2]
    normal = np.empty((outputs, size, outputs, size))
    for one in range(outputs):
        for other in range(one, outputs):
            product = weights * (slopes[:, :, one] * slopes[:, :, other]).sum(axis=1)
            normal[one, :, other] = design.T @ (design * product[:, None])
            normal[other, :, one] = normal[one, :, other].T
    pulled = np.einsum("nij,ni->nj", slopes, labels) * weights[:, None]
    shrink = np.full((outputs, size), penalty * len(inputs))
    shrink[-3:, -1] = 0.0  # a constant shift of the tip is free
    flat = normal.reshape(outputs * size, -1) + np.diag(shrink.ravel())
    return np.linalg.solve(flat, (pulled.T @ design).ravel()).reshape(outputs, size).T


@host.hookimpl
def measure_estimators() -> list[type[host.Estimator]]:
    """Register the estimator."""
    return [RidgeEstimator]
