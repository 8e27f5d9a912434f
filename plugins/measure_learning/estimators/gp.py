"""Gaussian process with data cleaning (Mahler et al. 2014), on the states of play operators."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from measure import host
from measure.arrays import Floats, Ints
from measure.geometry.covariance import MAD_TO_SD
from measure_learning import onnx
from measure_learning.estimators._inputs import WithinTrajectoryEstimator
from measure_learning.estimators._kinematics import levers, tip_error, tip_slopes
from measure_learning.estimators._play import PlayBank

_NARROWEST, _WIDEST = 0.01, 0.2  # half-widths of plays, as shares of the joint's range
_STEP = 2.0  # by which a parameter of the kernel is multiplied or divided in the search
_MOST_TRIALS = 24  # kernels, after which the search ends
_LINEAR = 0.02  # variance of a linear part, per squared input, over that of the rest
_JUDGES = 3000  # largest number of validation labels that choose the kernel


class GpSettings(host.Settings):
    """Settings of `gp`."""

    points: int = host.setting(2500, "Number of training rows kept for prediction.", ge=1)
    tuning_points: int = host.setting(
        400, "Number of rows from which the kernel is chosen and outliers are known.", ge=20
    )
    play_widths: int = host.setting(8, "Number of play operators per joint combination.", ge=1)
    cleaning_sds: float = host.setting(
        3.0, "Rows with residuals of more than this many standard deviations are dropped.", gt=0
    )


@dataclass(frozen=True)
class Kernel:
    """A squared exponential of the inputs over their lengths, and a linear part beside it."""

    joints: float  # length over the SD of a joint (or of the position)
    plays: float  # length over the half-width of a play
    noise: float  # variance of a label's axis over that of an output, whose lever is 1 mm

    def stretch(self, joints: int, plays: int) -> Floats:
        """What the inputs (joints + plays) are multiplied by."""
        return 1.0 / np.repeat([self.joints, self.plays], [joints, plays])

    def neighbours(self) -> list[Kernel]:
        """A step away in one parameter."""
        return [
            replace(self, **{name: getattr(self, name) * factor})
            for name in ("noise", "plays", "joints")
            for factor in (_STEP, 1.0 / _STEP)
        ]


@dataclass(frozen=True, eq=False)
class _Rows:
    """What the process learns from: some rows of a data set."""

    inputs: Floats  # (n, columns)
    labels: Floats  # (n, 3) mm, less their mean
    slopes: Floats  # (n, 3, outputs)

    def some(self, which: Ints) -> _Rows:
        """A part of them."""
        return _Rows(self.inputs[which], self.labels[which], self.slopes[which])


class GpEstimator(WithinTrajectoryEstimator):
    """Gaussian process on joints and plays, cleaned of outliers (Mahler 2014, with velocities).

    Where the robot's chain is known, it is of joint errors g that explain the tip error J(q) g.
    Rows are a random subset; the process's own variance joins the reported covariance.
    """

    name = "gp"
    Config = GpSettings
    config: GpSettings
    known: Kernel | None = None  # the kernel, where a fit to more has chosen it
    kernel: Kernel  # once fitted

    def _twin(self) -> Self:
        twin = super()._twin()
        twin.known = self.kernel
        return twin

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Choose the kernel by the validation trajectories, drop outliers, and fit."""
        c = self.config
        self._data_schema = data.schema
        self._reading = data.schema.reading_matrix(data.schema.joints or data.schema.position)
        self._scaling = onnx.Scaling.of(data.states @ self._reading)
        self._bank = PlayBank.of(data, c.play_widths, _NARROWEST, _WIDEST)
        usable = np.flatnonzero(data.usable)
        self._mean = data.errors_mm[usable].mean(axis=0)
        slopes, self._units = levers(data)
        whole = _Rows(self._inputs(data), data.errors_mm - self._mean, slopes)
        dice = np.random.default_rng(seed)
        few = whole.some(dice.choice(usable, min(c.tuning_points, len(usable)), replace=False))
        self.kernel = self.known or self._chosen(few, validation, report)
        rows = dice.choice(usable, min(2 * c.points, len(usable)), replace=False)
        self._solve(few, self.kernel)
        picked = whole.some(rows)
        away = np.linalg.norm(picked.labels - self._tips(picked), axis=1)
        clean = rows[away < c.cleaning_sds * MAD_TO_SD * np.median(away)]
        self._finish(whole.some(clean[: c.points]), self.kernel)
        report(1.0, "fitted")

    def _chosen(self, few: _Rows, validation: host.Dataset, report: host.Report) -> Kernel:
        """The kernel of the least squares on validation trajectories, by steps in each parameter.

        The likelihood of the training rows would ask for shorter lengths: neighbours are alike.
        """
        used = np.flatnonzero(validation.usable)
        used = used[:: -(-len(used) // _JUDGES)]
        slopes = tip_slopes(validation)[used] * self._units
        labels = validation.errors_mm[used] - self._mean
        judge = _Rows(self._inputs(validation)[used], labels, slopes)
        scores = dict[Kernel, float]()

        def score(kernel: Kernel) -> float:
            if kernel not in scores:
                self._solve(few, kernel)
                scores[kernel] = float(((judge.labels - self._tips(judge)) ** 2).sum())
                report(min(0.5, 0.5 * len(scores) / _MOST_TRIALS), "choosing the kernel")
            return scores[kernel]

        best = Kernel(2.0, 6.0, 0.3)  # what the arms measured so far chose
        while len(scores) < _MOST_TRIALS:
            if (other := min((best, *best.neighbours()), key=score)) == best:
                break
            best = other
        return best

    def _inputs(self, data: host.Dataset) -> Floats:
        """Joints, and where in its play each stands."""
        joints = self._scaling.apply(data.states @ self._reading)
        return np.concatenate([joints, self._bank.features(data)], axis=1)

    def _near(self, inputs: Floats) -> Floats:
        """The kernel (n, points)."""
        a = (inputs * self._stretch).astype(np.float32)
        b = (self._points * self._stretch).astype(np.float32)
        squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
        return np.exp(-0.5 * np.maximum(squares, 0.0))

    def _tips(self, rows: _Rows) -> Floats:
        """Tip errors (n, 3), to first order."""
        outputs = self._near(rows.inputs) @ self._weights + rows.inputs @ self._linear
        return np.einsum("nij,nj->ni", rows.slopes, outputs)

    def _solve(self, rows: _Rows, kernel: Kernel) -> None:
        """The mean, in float32, as the graph computes."""
        from scipy.linalg import cho_factor, cho_solve  # slow to load

        self._points = rows.inputs
        self._stretch = kernel.stretch(self._reading.shape[1], self._bank.size)
        near, linear = self._near(rows.inputs), rows.inputs.astype(np.float32)
        slopes = rows.slopes.astype(np.float32)
        gram = _gram(near + _LINEAR * linear @ linear.T, slopes, kernel.noise)
        factor = cho_factor(gram, lower=True, overwrite_a=True)
        pulled = cho_solve(factor, rows.labels.astype(np.float32).ravel()).reshape(-1, 3)
        self._weights = np.einsum("nij,ni->nj", slopes, pulled).astype(np.float64)
        self._linear = _LINEAR * rows.inputs.T @ self._weights

    def _finish(self, rows: _Rows, kernel: Kernel) -> None:
        """The mean, and what is unknown of the tip error's mean axis, as a process of its own."""
        from scipy.linalg import solve_triangular  # slow to load

        self._solve(rows, kernel)
        left = rows.labels - self._tips(rows)
        signal = float((left**2).mean()) / kernel.noise
        self._variance = signal * float((rows.slopes**2).sum(axis=2).mean())
        near = self._near(rows.inputs[: self.config.tuning_points])[:, : self.config.tuning_points]
        alone = near * self._variance + signal * kernel.noise * np.eye(len(near))
        inverse = solve_triangular(np.linalg.cholesky(alone), np.eye(len(near)), lower=True)
        self._whitener = self._variance * inverse.T

    def compute(
        self, graph: onnx.Graph, features: onnx.Value, memory: onnx.Value, tick: onnx.Value
    ) -> onnx.Core:
        """Mean and variance of the process."""
        sizes = graph.constant([1, self._bank.size], np.int64)
        started, states = graph.ops("Split", 2, memory, sizes, axis=1)
        play, states = self._bank.in_graph(graph, features, states, started)
        joints = self._scaling.in_graph(graph, graph.op("MatMul", features, self._reading))
        inputs = graph.op("Concat", joints, play, axis=1)
        x = graph.op("Mul", inputs, self._stretch)
        points = self._points * self._stretch
        cross = graph.op("MatMul", x, -2.0 * points.T)
        square = graph.op("ReduceSumSquare", x, axes=[1], keepdims=1)
        distance = graph.op("Add", graph.op("Add", cross, square), (points**2).sum(axis=1)[None])
        near = graph.op("Exp", graph.op("Mul", distance, np.float32(-0.5)))
        curved = graph.op("MatMul", near, self._weights * self._units)
        straight = graph.op("MatMul", inputs, self._linear * self._units)
        outputs = graph.op("Add", curved, straight)
        error = tip_error(graph, self._data_schema, features, outputs)
        mean = graph.op("Add", error, self._mean)
        few = graph.columns(near, range(len(self._whitener)))
        explained = graph.op(
            "ReduceSumSquare", graph.op("MatMul", few, self._whitener), axes=[1], keepdims=1
        )
        unknown = graph.op("Sub", np.array([[self._variance]]), explained)
        variance = graph.op("Max", unknown, np.zeros((1, 1)))
        after = graph.op("Concat", graph.ones_like(started), states, axis=1)
        return onnx.Core(mean, after, variance, self.memory_size)

    @property
    def memory_size(self) -> int:
        """A started flag and the plays' states."""
        return 1 + self._bank.size


def _gram(near: Any, slopes: Any, noise: float) -> Any:
    """Covariance (3n, 3n) of tip errors, of that of each output (n, n), in float32."""
    count, flat = len(slopes), slopes.reshape(-1, slopes.shape[2])
    gram = (flat @ flat.T).reshape(count, 3, count, 3)
    gram *= near[:, None, :, None]
    gram = gram.reshape(3 * count, -1)
    gram[np.diag_indices(len(gram))] += noise
    return gram


@host.hookimpl
def measure_estimators() -> list[type[host.Estimator]]:
    """Register the estimator."""
    return [GpEstimator]
