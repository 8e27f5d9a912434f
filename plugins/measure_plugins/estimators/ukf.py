"""Haghighipanah et al. 2015: a joint-level unscented Kalman filter on a cable model.

Each joint l follows its motor side m through slack of half-width w, l <- min(max(l, m - w), m + w),
and through a cable whose stretch shows in the motor's torque: l = m + o + c tau. The slack is the
process, which is not smooth: hence unscented. The torque is the measurement. The state has one
number per joint, so the sigma points are l and l +- sqrt(3 P).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import Dataset, Estimator, Report, Settings, hookimpl, setting
from measure.host.onnx_estimator import Core, OnnxEstimator
from measure.host.onnx_graph import Graph, Value
from measure_plugins.estimators._inputs import watched_features
from measure_plugins.estimators._kinematics import tip_change
from measure_plugins.estimators._play import PlayBank
from measure_plugins.estimators.ridge import fit_linear


class UkfSettings(Settings):
    """Settings of `ukf`."""

    play_widths: int = setting(10, "widths tried for each joint's slack", ge=2)
    process_share: float = setting(
        0.1, "process SD of a joint at each step, share of its slack", gt=0
    )


class UkfEstimator(OnnxEstimator):
    """Joint-level unscented Kalman filter on slack and stretch (Haghighipanah 2015).

    Needs a robot whose kinematics are known; torques are used if the state has them.
    """

    name = "ukf"
    Config = UkfSettings
    config: UkfSettings

    def watched(self, data: Dataset) -> list[int]:
        """What only tells recordings apart is not used, and may differ."""
        return watched_features(data)

    def learn(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Fit slack, offset and compliance of every joint through the Jacobian."""
        schema = data.schema
        if schema.chain is None:
            raise EstimatorError(
                f"'ukf' needs the robot's kinematics, and those of {schema.robot} are not known: "
                "describe its joints with alpha_deg in robot.toml, or use another estimator"
            )
        self._data_schema = schema
        count = schema.chain.size
        self._read = schema.reading_matrix(schema.joints)
        self._torque = schema.reading_matrix(schema.torques) if schema.torques else None
        spans = np.ptp(data.joints, axis=0)
        shares = np.geomspace(0.001, 0.2, self.config.play_widths)
        bank = PlayBank(self._read, np.maximum(spans, 1e-9)[:, None] * shares)
        slack = -bank.features(data).reshape(len(data), count, -1) * bank.widths
        torque = (
            np.zeros((len(data), count)) if self._torque is None else data.states @ self._torque
        )
        self._torque_mean = torque.mean(axis=0)
        jacobian = schema.chain.jacobian(data.joints)[:, :3]
        self._fit(data, bank.widths, slack, torque - self._torque_mean, jacobian, report)

    def _fit(
        self,
        data: Dataset,
        widths: Floats,
        slack: Floats,
        torque: Floats,
        jacobian: Floats,
        report: Report,
    ) -> None:
        """Coordinate descent over widths; the rest is linear: e = J (o + c tau + slack) + t."""
        used, count = data.usable, slack.shape[1]
        choice = np.zeros(count, dtype=int)
        base = np.concatenate(
            [
                jacobian[used],
                jacobian[used] * torque[used][:, None, :],
                np.tile(np.eye(3), (int(used.sum()), 1, 1)),
            ],
            axis=2,
        )  # (n, 3, 2 joints + 3)
        weights = np.repeat(data.weights()[used], 3)
        columns = base.shape[2]
        flat = base.reshape(-1, columns)
        scale = np.maximum(flat.std(axis=0), 1e-9)

        def solve(picked: Any) -> tuple[float, Floats]:
            play = np.take_along_axis(slack[used], picked[None, :, None], axis=2)[..., 0]
            left = data.errors_mm[used] - np.einsum("nij,nj->ni", jacobian[used], play)
            fitted = fit_linear(flat / scale, left.reshape(-1, 1), weights, 1e-6)[:-1]
            rest = left.reshape(-1, 1) - flat / scale @ fitted
            return float((weights[:, None] * rest**2).mean()), fitted[:, 0] / scale

        best, linear = solve(choice)
        for sweep in range(2):
            for joint in range(count):
                for width in range(widths.shape[1]):
                    trial = choice.copy()
                    trial[joint] = width
                    cost, found = solve(trial)
                    if cost < best:
                        best, linear, choice = cost, found, trial
            report((sweep + 1) / 2, f"slack fitted: {np.sqrt(3 * best):.3f} mm")
        self._width = widths[np.arange(count), choice]
        self._offset, self._compliance = linear[:count], linear[count : 2 * count]
        self._tip = linear[2 * count :]
        self._process = (self.config.process_share * self._width) ** 2 + 1e-12
        stretch = np.abs(self._compliance) * torque.std(axis=0)
        # What the torque says is blurred by motor friction: as much as it varies.
        self._measure = stretch**2 + self._width**2 + 1e-12

    def compute(self, graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        """Predict through the slack with three sigma points, then correct with the torque."""
        count = len(self._width)
        motor = graph.op("MatMul", features, self._read)
        sizes = graph.constant([1, count, count], np.int64)
        started, link, variance = graph.ops("Split", 3, memory, sizes, axis=1)
        link = graph.mix(started, link, motor)
        variance = graph.mix(started, variance, graph.constant(self._width[None] ** 2))
        spread = graph.op("Sqrt", graph.op("Mul", variance, np.float32(3.0)))
        low, high = (
            graph.op("Sub", motor, self._width[None]),
            graph.op("Add", motor, self._width[None]),
        )

        def through(point: Value) -> Value:
            return graph.op("Min", graph.op("Max", point, low), high)

        points = [
            through(link),
            through(graph.op("Add", link, spread)),
            through(graph.op("Sub", link, spread)),
        ]
        shares = [2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0]
        mean = graph.op(
            "Sum", *[graph.op("Mul", p, np.float32(s)) for p, s in zip(points, shares, strict=True)]
        )
        away = [graph.op("Sub", p, mean) for p in points]
        squares = [
            graph.op("Mul", graph.op("Mul", a, a), np.float32(s))
            for a, s in zip(away, shares, strict=True)
        ]
        predicted = graph.op("Sum", *squares, graph.constant(self._process[None]))
        stretched = np.zeros((len(self._data_schema.features), count))
        if self._torque is not None:
            stretched = self._torque * self._compliance
        stretch = graph.affine(features, stretched, -(self._torque_mean * self._compliance)[None])
        # The slack is the state; the stretch adds to it.
        gain = graph.op("Div", predicted, graph.op("Add", predicted, self._measure[None]))
        seen = graph.op("Sub", graph.op("Add", motor, stretch), mean)
        link_after = through(graph.op("Add", mean, graph.op("Mul", gain, seen)))
        link_after = link_after if self._torque is not None else mean
        variance_after = graph.op("Sub", predicted, graph.op("Mul", gain, predicted))
        variance_after = variance_after if self._torque is not None else predicted
        limit = graph.op("Min", variance_after, self._width[None] ** 2)
        slack = graph.op("Sub", link_after, motor)
        wrong = graph.op("Add", graph.op("Add", slack, stretch), self._offset[None])
        error = graph.op(
            "Add", tip_change(graph, self._data_schema, features, wrong), self._tip[None]
        )
        begun = graph.op("Add", graph.op("Mul", started, np.float32(0.0)), np.float32(1.0))
        kept = graph.op("Concat", begun, link_after, limit, axis=1)
        return Core(error, kept, None, 1 + 2 * count)


@hookimpl
def measure_estimators() -> list[type[Estimator]]:
    """Register the estimator."""
    return [UkfEstimator]
