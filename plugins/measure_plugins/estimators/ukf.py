"""Haghighipanah et al. 2015: a joint-level unscented Kalman filter on a cable model.

Each joint l follows its motor side m through slack of half-width w, l <- min(max(l, m - w), m + w),
and through a cable whose stretch shows in the motor's torque: l = m + o + c tau. The slack is the
process, which is not smooth: hence unscented. The torque is the measurement. The state has one
number per joint, so the sigma points are l and l +- sqrt(3 P).
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import Core, Dataset, Estimator, Graph, Report, Settings, Value, hookimpl, setting
from measure_plugins.estimators._inputs import WithinTrajectoryEstimator
from measure_plugins.estimators._kinematics import tip_change
from measure_plugins.estimators._play import PlayBank
from measure_plugins.estimators.ridge import fit_linear


class UkfSettings(Settings):
    """Settings of `ukf`."""

    play_widths: int = setting(10, "Number of half-widths tried for the slack of each joint.", ge=2)
    process_share: float = setting(
        0.1, "Process standard deviation of a joint per step, as a share of its slack.", gt=0
    )


class UkfEstimator(WithinTrajectoryEstimator):
    """Joint-level unscented Kalman filter on slack and stretch (Haghighipanah 2015).

    Needs a robot whose kinematics are known; torques are used if the state has them.
    """

    name = "ukf"
    Config = UkfSettings
    config: UkfSettings

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
        model = _CableModel(data, bank.widths, slack, torque - self._torque_mean)
        self._fit(model, report)

    def _fit(self, model: _CableModel, report: Report) -> None:
        """Coordinate descent over widths; the rest is linear: e = J (o + c tau + slack) + t."""
        count, tried = model.slack.shape[1:]
        choice = np.zeros(count, dtype=int)
        best, linear = model.solve(choice)
        for sweep in range(2):
            for joint, width in itertools.product(range(count), range(tried)):
                trial = choice.copy()
                trial[joint] = width
                cost, found = model.solve(trial)
                if cost < best:
                    best, linear, choice = cost, found, trial
            report((sweep + 1) / 2, f"slack fitted: {np.sqrt(3 * best):.3f} mm")
        self._width = model.widths[np.arange(count), choice]
        self._offset, self._compliance = linear[:count], linear[count : 2 * count]
        self._tip = linear[2 * count :]
        self._process = (self.config.process_share * self._width) ** 2 + 1e-12
        stretch = np.abs(self._compliance) * model.torque.std(axis=0)
        # Motor friction disturbs the torque by as much as the torque varies.
        self._measure = stretch**2 + self._width**2 + 1e-12

    def compute(self, graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        """Predict through the slack with three sigma points, then correct with the torque."""
        count = len(self._width)
        motor = graph.op("MatMul", features, self._read)
        sizes = graph.constant([1, count, count], np.int64)
        started, link, variance = graph.ops("Split", 3, memory, sizes, axis=1)
        link = graph.mix(started, link, motor)
        variance = graph.mix(started, variance, graph.constant(self._width[None] ** 2))
        link, variance = self._predict(graph, motor, link, variance)
        stretch = self._stretch(graph, features)
        if self._torque is not None:
            link, variance = self._correct(graph, motor, stretch, link, variance)
        limit = graph.op("Min", variance, self._width[None] ** 2)
        slack = graph.op("Sub", link, motor)
        wrong = graph.op("Add", graph.op("Add", slack, stretch), self._offset[None])
        error = graph.op(
            "Add", tip_change(graph, self._data_schema, features, wrong), self._tip[None]
        )
        begun = graph.ones_like(started)
        kept = graph.op("Concat", begun, link, limit, axis=1)
        return Core(error, kept, None, 1 + 2 * count)

    def _through(self, graph: Graph, motor: Value, link: Value) -> Value:
        """The slack: the link follows the motor within its half-width."""
        low = graph.op("Sub", motor, self._width[None])
        high = graph.op("Add", motor, self._width[None])
        return graph.op("Min", graph.op("Max", link, low), high)

    def _predict(
        self, graph: Graph, motor: Value, link: Value, variance: Value
    ) -> tuple[Value, Value]:
        """Mean and variance of three sigma points after the slack, process noise included."""
        spread = graph.op("Sqrt", graph.op("Mul", variance, np.float32(3.0)))
        points = [link, graph.op("Add", link, spread), graph.op("Sub", link, spread)]
        points = [self._through(graph, motor, point) for point in points]
        mean = _weighted(graph, points)
        away = [graph.op("Sub", point, mean) for point in points]
        scatter = _weighted(graph, [graph.op("Mul", a, a) for a in away])
        return mean, graph.op("Add", scatter, self._process[None])

    def _stretch(self, graph: Graph, features: Value) -> Value:
        """Stretch of the cables under the motors' torques."""
        stretched = np.zeros((len(self._data_schema.features), len(self._width)))
        if self._torque is not None:
            stretched = self._torque * self._compliance
        return graph.affine(features, stretched, -(self._torque_mean * self._compliance)[None])

    def _correct(
        self, graph: Graph, motor: Value, stretch: Value, link: Value, variance: Value
    ) -> tuple[Value, Value]:
        """Update of the slack with the stretch that the torque measures."""
        kalman = graph.op("Div", variance, graph.op("Add", variance, self._measure[None]))
        seen = graph.op("Sub", graph.op("Add", motor, stretch), link)
        after = graph.op("Add", link, graph.op("Mul", kalman, seen))
        left = graph.op("Sub", variance, graph.op("Mul", kalman, variance))
        return self._through(graph, motor, after), left


def _weighted(graph: Graph, points: list[Value]) -> Value:
    """The sigma points' mean: 2/3 for the middle one, 1/6 for each other."""
    shares = (2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0)
    return graph.op(
        "Sum", *[graph.op("Mul", p, np.float32(s)) for p, s in zip(points, shares, strict=True)]
    )


class _CableModel:
    """The labelled rows, and the linear part of the fit."""

    def __init__(self, data: Dataset, widths: Floats, slack: Floats, torque: Floats) -> None:
        assert data.schema.chain is not None
        used = data.usable
        self.widths, self.torque = widths, torque
        self.slack = slack[used]
        self._jacobian = data.schema.chain.jacobian(data.joints[used])[:, :3]
        self._errors = data.errors_mm[used]
        self._weights = np.repeat(data.weights()[used], 3)
        shift = np.tile(np.eye(3), (len(self._errors), 1, 1))
        bent = self._jacobian * torque[used][:, None, :]
        base = np.concatenate([self._jacobian, bent, shift], axis=2)  # (n, 3, 2 joints + 3)
        flat = base.reshape(-1, base.shape[2])
        self._scale = np.maximum(flat.std(axis=0), 1e-9)
        self._design = flat / self._scale

    def solve(self, picked: Any) -> tuple[float, Floats]:
        """Mean square left with some widths, and offsets, compliances, tip shift."""
        play = np.take_along_axis(self.slack, picked[None, :, None], axis=2)[..., 0]
        left = self._errors - np.einsum("nij,nj->ni", self._jacobian, play)
        fitted = fit_linear(self._design, left.reshape(-1, 1), self._weights, 1e-6)[:-1]
        rest = left.reshape(-1, 1) - self._design @ fitted
        cost = float((self._weights[:, None] * rest**2).mean())
        return cost, fitted[:, 0] / self._scale


@hookimpl
def measure_estimators() -> list[type[Estimator]]:
    """Register the estimator."""
    return [UkfEstimator]
