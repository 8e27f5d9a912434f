"""Gaussian process (Mahler et al. 2014) on the states of play operators, in closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from measure import host
from measure.arrays import Floats, Ints
from measure.host.dataset import recording_of
from measure_learning import onnx
from measure_learning.estimators._inputs import WithinTrajectoryEstimator
from measure_learning.estimators._nets import STEP_GAIN
from measure_learning.estimators._play import PlayBank
from measure_learning.onnx.kinematics import levers, tip_error, tip_slopes

_NARROWEST, _WIDEST = 0.01, 0.2  # half-widths of plays, as shares of the joint's range
_STEP = 2.0  # by which a parameter of the kernel is multiplied or divided in the search
_MOST_TRIALS = 24  # kernels, after which the search ends
_LINEAR = 0.02  # variance of a linear part, per squared input, over that of the rest
_JUDGES = 3000  # largest number of validation labels that choose the kernel


class GpSettings(host.Settings):
    """Settings of `gp`."""

    points: int = host.setting(2500, "Number of training rows kept for prediction.", ge=1)
    tuning_points: int = host.setting(
        400, "Number of rows from which the kernel is chosen and its own variance known.", ge=20
    )
    play_widths: int = host.setting(8, "Number of play operators per joint combination.", ge=1)


@dataclass(frozen=True)
class Kernel:
    """Matern's of 3/2 of the inputs over their lengths, and a linear part beside it."""

    joints: float  # length over the SD of a joint (or of the position), and of its steps
    plays: float  # length over the half-width of a play
    noise: float  # variance of a label's axis over that of an output, whose lever is 1 mm

    def stretch(self, joints: int, plays: int) -> Floats:
        """What the inputs (joints + plays + steps) are multiplied by."""
        return 1.0 / np.repeat([self.joints, self.plays, self.joints], [joints, plays, joints])

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
    """Gaussian process on joints, plays and last steps (Mahler 2014, with velocities).

    Where the robot's chain is known, it is of joint errors g that explain the tip error J(q) g.
    Rows are a random subset, in which a recording counts by the root of its labels; the process's
    own variance joins the reported covariance.
    """

    name = "gp"
    Config = GpSettings
    config: GpSettings
    known: Kernel | None = None  # the kernel, where a fit to more has chosen it
    kernel: Kernel  # once fitted

    def twin(self) -> Self:
        """With the kernel that this one has."""
        twin = super().twin()
        twin.known = self.kernel
        return twin

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Choose the kernel by the validation trajectories, and fit."""
        c = self.config
        self._data_schema = data.schema
        self._reading = data.schema.reading_matrix(data.schema.joints or data.schema.position)
        self._scaling = onnx.Scaling.of(data.states @ self._reading)
        self._bank = PlayBank.of(data, c.play_widths, _NARROWEST, _WIDEST, halves=True)
        usable = np.flatnonzero(data.usable)
        self._mean = data.errors_mm[usable].mean(axis=0)
        slopes, self._units = levers(data)
        whole = _Rows(self._inputs(data), data.errors_mm - self._mean, slopes)
        order = _drawn(data, np.random.default_rng(seed))
        few = whole.some(order[: c.tuning_points])
        self.kernel = self.known or self._chosen(few, validation, report)
        self._finish(whole.some(order[: c.points]), self.kernel)
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

        best = Kernel(2.0, 8.0, 0.3)  # what the arms measured so far chose
        while len(scores) < _MOST_TRIALS:
            if (other := min((best, *best.neighbours()), key=score)) == best:
                break
            best = other
        return best

    def _inputs(self, data: host.Dataset) -> Floats:
        """Joints, where in its play each stands, and their bounded last steps."""
        joints = self._scaling.apply(data.states @ self._reading)
        steps = np.concatenate(
            [np.diff(joints[rows], axis=0, prepend=joints[rows][:1]) for _, rows in data.runs()]
        )
        parts = [joints, self._bank.features(data), np.tanh(STEP_GAIN * steps)]
        return np.concatenate(parts, axis=1)

    def _near(self, inputs: Floats) -> Floats:
        """The kernel (n, points)."""
        a = (inputs * self._stretch).astype(np.float32)
        b = (self._points * self._stretch).astype(np.float32)
        squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
        lengths = np.sqrt(3.0 * np.maximum(squares, 0.0))
        return (1.0 + lengths) * np.exp(-lengths)

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
        """Mean and variance of the process; the last joints of its memory advance with ticks."""
        sizes = graph.constant([1, self._bank.size, self._reading.shape[1]], np.int64)
        started, states, last = graph.ops("Split", 3, memory, sizes, axis=1)
        play, states = self._bank.in_graph(graph, features, states, started)
        joints = self._scaling.in_graph(graph, graph.op("MatMul", features, self._reading))
        last = graph.mix(started, last, joints)
        steps = graph.op("Mul", graph.op("Sub", joints, last), np.float32(STEP_GAIN))
        inputs = graph.op("Concat", joints, play, graph.op("Tanh", steps), axis=1)
        x = graph.op("Mul", inputs, self._stretch)
        points = self._points * self._stretch
        cross = graph.op("MatMul", x, -2.0 * points.T)
        square = graph.op("ReduceSumSquare", x, axes=[1], keepdims=1)
        distance = graph.op("Add", graph.op("Add", cross, square), (points**2).sum(axis=1)[None])
        distance = graph.op("Mul", graph.op("Max", distance, np.zeros((1, 1))), np.float32(3.0))
        length = graph.op("Sqrt", distance)
        near = graph.op("Add", length, np.ones((1, 1)))
        near = graph.op("Mul", near, graph.op("Exp", graph.op("Neg", length)))
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
        last = graph.mix(tick, joints, last)
        after = graph.op("Concat", graph.ones_like(started), states, last, axis=1)
        return onnx.Core(mean, after, variance, self.memory_size)

    @property
    def memory_size(self) -> int:
        """A started flag, the plays' states, and the joints of the last tick."""
        return 1 + self._bank.size + self._reading.shape[1]


def _drawn(data: host.Dataset, dice: np.random.Generator) -> Ints:
    """Usable rows in random order; a recording's chance is by the root of its labels."""
    rows = np.flatnonzero(data.usable)
    recordings = np.array([recording_of(name) for name in data.names])[data.trajectory[rows]]
    _, place, counts = np.unique(recordings, return_inverse=True, return_counts=True)
    chances = 1.0 / np.sqrt(counts)[place]
    return dice.choice(rows, len(rows), replace=False, p=chances / chances.sum())


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
