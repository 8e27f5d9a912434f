"""Mahler et al. 2014: Gaussian process regression with velocities and data cleaning."""

from __future__ import annotations

import numpy as np

from measure import host
from measure.arrays import Floats
from measure.geometry.covariance import MAD_TO_SD
from measure_learning.estimators._inputs import StateWindow, WithinTrajectoryEstimator
from measure_learning.estimators._kinematics import levers, tip_error


class GpSettings(host.Settings):
    """Settings of `gp`."""

    points: int = host.setting(700, "Number of training rows kept for prediction.", ge=20)
    tuning_points: int = host.setting(
        300, "Number of rows from which the kernel's parameters are chosen.", ge=20
    )
    cleaning_sds: float = host.setting(
        3.0, "Rows with residuals of more than this many standard deviations are dropped.", gt=0
    )


class GpEstimator(WithinTrajectoryEstimator):
    """Gaussian process on joints and velocities, cleaned of outliers (Mahler 2014).

    Where the robot's chain is known, it is of joint errors g that explain the tip error J(q) g.
    Rows are a random subset; the process's own variance joins the reported covariance.
    """

    name = "gp"
    Config = GpSettings
    config: GpSettings

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Choose the kernel by marginal likelihood; fit, drop outliers, fit again."""
        self._data_schema = data.schema
        self._reading = data.schema.reading_matrix(data.schema.joints or data.schema.position)
        self._window = StateWindow(self._reading.shape[1], 2)
        inputs = self._inputs(data)
        self._scaling = host.Scaling.of(inputs)
        inputs = self._scaling.apply(inputs)
        usable = np.flatnonzero(data.usable)
        self._mean = data.errors_mm[usable].mean(axis=0)
        labels = data.errors_mm - self._mean
        slopes, self._units = levers(data)
        dice = np.random.default_rng(seed)
        few = dice.choice(usable, min(self.config.tuning_points, len(usable)), replace=False)
        self._stretch, self._signal, self._noise = _tune(inputs[few], labels[few], slopes[few])
        report(0.5, "kernel chosen")
        rows = dice.choice(usable, min(2 * self.config.points, len(usable)), replace=False)
        first = rows[: self.config.points]
        self._solve(inputs[first], labels[first], slopes[first])
        guess = _kernel(inputs[rows], self._points, self._stretch) @ self._weights
        away = np.linalg.norm(labels[rows] - np.einsum("nij,nj->ni", slopes[rows], guess), axis=1)
        clean = rows[away < self.config.cleaning_sds * MAD_TO_SD * np.median(away)]
        first = clean[: self.config.points]
        self._solve(inputs[first], labels[first], slopes[first])
        report(1.0, "fitted")

    def compute(
        self, graph: host.Graph, features: host.Value, memory: host.Value, tick: host.Value
    ) -> host.Core:
        """Mean and variance of the process."""
        joints = graph.op("MatMul", features, self._reading)
        window, after = self._window.in_graph(graph, joints, memory, tick)
        count = self._reading.shape[1]
        moved = graph.op("Sub", joints, graph.columns(window, range(count, 2 * count)))
        inputs = self._scaling.in_graph(graph, graph.op("Concat", joints, moved, axis=1))
        x = graph.op("Mul", inputs, self._stretch)
        points = self._points * self._stretch
        cross = graph.op("MatMul", x, -2.0 * points.T)
        square = graph.op("ReduceSumSquare", x, axes=[1], keepdims=1)
        distance = graph.op("Add", graph.op("Add", cross, square), (points**2).sum(axis=1)[None])
        near = graph.op("Exp", graph.op("Mul", distance, np.float32(-0.5)))
        outputs = graph.op("MatMul", near, self._weights * self._units)
        error = tip_error(graph, self._data_schema, features, outputs)
        mean = graph.op("Add", error, self._mean)
        explained = graph.op(
            "ReduceSumSquare", graph.op("MatMul", near, self._whitener), axes=[1], keepdims=1
        )
        unknown = graph.op("Sub", np.array([[self._variance]]), explained)
        variance = graph.op("Max", unknown, np.zeros((1, 1)))
        return host.Core(mean, after, variance, self._window.size)

    def _inputs(self, data: host.Dataset) -> Floats:
        """Joints and how far they moved since the last row."""
        joints = data.states @ self._reading
        window = self._window.features(data, joints)
        return np.concatenate([joints, joints - window[:, joints.shape[1] :]], axis=1)

    def _solve(self, points: Floats, labels: Floats, slopes: Floats) -> None:
        from scipy.linalg import cho_factor, cho_solve, solve_triangular

        self._points = points
        near = _kernel(points, points, self._stretch)
        factor = cho_factor(_gram(self._signal * near, slopes, self._noise), lower=True)
        pulled = cho_solve(factor, labels.ravel()).reshape(-1, 3)
        self._weights = self._signal * np.einsum("nij,ni->nj", slopes, pulled)
        # What is unknown of the tip error's mean axis, as if it were a process of its own.
        self._variance = self._signal * float((slopes**2).sum(axis=2).mean())
        alone = cho_factor(self._variance * near + self._noise * np.eye(len(near)), lower=True)
        inverse = solve_triangular(alone[0], np.eye(len(points)), lower=True)
        self._whitener = self._variance * inverse.T


def _kernel(a: Floats, b: Floats, stretch: Floats) -> Floats:
    from scipy.spatial.distance import cdist

    return np.exp(-0.5 * cdist(a * stretch, b * stretch, "sqeuclidean"))


def _gram(covariance: Floats, slopes: Floats, noise: float) -> Floats:
    """Covariance (3n, 3n) of tip errors, of that of each output (n, n)."""
    flat = slopes.reshape(-1, slopes.shape[2])
    gram = flat @ flat.T * covariance.repeat(3, axis=0).repeat(3, axis=1)
    gram[np.diag_indices_from(gram)] += noise
    return gram


def _tune(inputs: Floats, labels: Floats, slopes: Floats) -> tuple[Floats, float, float]:
    """Inverse lengths of positions and of velocities, signal and noise variance (mm^2).

    They maximise the marginal likelihood, the outputs being independent draws.
    """
    from scipy.linalg import cho_factor, cho_solve  # slow to load, as is scipy.optimize
    from scipy.optimize import minimize

    half = inputs.shape[1] // 2
    variance = float((labels**2).mean())

    def unpack(log: Floats) -> tuple[Floats, float, float]:
        stretch = np.exp(-np.repeat(log[:2], [half, inputs.shape[1] - half]))
        return stretch, variance * float(np.exp(log[2])), variance * float(np.exp(log[3]))

    def cost(log: Floats) -> float:
        stretch, signal, noise = unpack(log)
        gram = _gram(signal * _kernel(inputs, inputs, stretch), slopes, noise + 1e-9)
        factor = cho_factor(gram, lower=True)
        fit = float(labels.ravel() @ cho_solve(factor, labels.ravel()))
        return 0.5 * fit + float(np.log(np.diag(factor[0])).sum())

    best = minimize(
        cost,
        [1.0, 1.0, 0.0, -2.0],
        method="L-BFGS-B",
        bounds=[(-1, 4), (-1, 6), (-3, 3), (-7, 1)],
        options={"maxiter": 25},
    )
    return unpack(best.x)


@host.hookimpl
def measure_estimators() -> list[type[host.Estimator]]:
    """Register the estimator."""
    return [GpEstimator]
