"""The default: perceptrons and GRUs on play operators, averaged with a Gaussian process."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Self, TypeVar

import numpy as np

from measure import host
from measure.arrays import Floats
from measure_learning import onnx
from measure_learning.estimators import _nets
from measure_learning.estimators._inputs import WithinTrajectoryEstimator, informative_features
from measure_learning.estimators._play import PlayBank
from measure_learning.estimators._training import (
    AfterEpoch,
    Training,
    torch_or_explain,
    train_gru,
    train_perceptrons,
)
from measure_learning.estimators._training_set import OutputUnits, TrainingSet
from measure_learning.estimators.gp import GpEstimator, GpSettings, Kernel

N = TypeVar("N", _nets.Perceptrons, _nets.Grus)

_SHARE = 0.25  # weight of the process: left least of a real arm's recordings that were left out
_PERCEPTRON_SHARE = 0.2  # time of a perceptron's epoch, as a share of a GRU's


class StreamSettings(host.Settings):
    """Settings of `stream`."""

    perceptrons: int = host.setting(5, "Number of perceptrons in the ensemble.", ge=1)
    perceptron_units: int = host.setting(
        128, "Units in each of the two layers of a perceptron.", ge=4
    )
    perceptron_epochs: int = host.setting(
        40, "Passes over the data in the training of the perceptrons.", ge=1
    )
    grus: int = host.setting(3, "Number of GRUs in the ensemble.", ge=1)
    gru_units: int = host.setting(96, "Hidden units of a GRU.", ge=4)
    gru_epochs: int = host.setting(70, "Passes over the data in the training of a GRU.", ge=1)
    window: int = host.setting(128, "Steps in a training window of a GRU.", ge=8)
    play_widths: int = host.setting(8, "Number of play operators per joint combination.", ge=1)
    narrowest: float = host.setting(
        0.01, "Half-width of the narrowest play, as a share of the joint's range.", gt=0, lt=1
    )
    widest: float = host.setting(
        0.2, "Half-width of the widest play, as a share of the joint's range.", gt=0, le=1
    )
    dropout: float = host.setting(0.4, "Share of a GRU's outputs dropped in training.", ge=0, lt=1)
    decay: float = host.setting(0.05, "Weight decay of AdamW.", ge=0)
    noise: float = host.setting(
        0.02, "Standard deviation of the noise added to scaled inputs in training.", ge=0
    )
    points: int = host.setting(
        2500, "Training rows that the Gaussian process beside the nets keeps; 0 for none.", ge=0
    )


class StreamEstimator(WithinTrajectoryEstimator):
    """Perceptrons, stateful GRUs and a Gaussian process on play operators; the default.

    Joint errors go through the forward kinematics where the robot's chain is known. The nets are
    averaged, and the process joins them with a fixed weight: validation trajectories that are the
    ends of those learnt from would choose too large a one. The members' disagreement is part of the
    reported covariance.
    """

    name = "stream"
    Config = StreamSettings
    config: StreamSettings
    known: Kernel | None = None  # of the process, where a fit to more has chosen it
    kernel: Kernel | None = None  # the one that this fit has

    def draft(self) -> host.Settings:
        """Fewer nets, for half as long: what recordings left out show changes by a few percent."""
        c = self.config
        fewer = {
            "grus": 1,
            "gru_epochs": -(-c.gru_epochs // 2),
            "perceptrons": -(-c.perceptrons // 3),
            "perceptron_epochs": -(-c.perceptron_epochs // 2),
            "points": c.points // 2,
        }
        return c.model_copy(update=fewer)

    def twin(self) -> Self:
        """With the kernel that this one has."""
        twin = super().twin()
        twin.known = self.kernel
        return twin

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Compute inputs, then train every net in turn."""
        torch_or_explain()
        c = self.config
        self._data_schema = data.schema
        self._digests = data.digest(), validation.digest()
        self._columns = informative_features(data)
        self._scaling = onnx.Scaling.of(data.states[:, self._columns])
        self._moving = self._moving_inputs()
        self._bank = PlayBank.of(data, c.play_widths, c.narrowest, c.widest, halves=True)
        self._outputs = OutputUnits.of(data)
        training_set = TrainingSet(data, validation, self._inputs, self._outputs, self._moving)
        log = _CurveLog(
            _PERCEPTRON_SHARE * c.perceptrons * c.perceptron_epochs + c.grus * c.gru_epochs
        )
        self._perceptrons = self._fit_perceptrons(training_set, seed, log, report)
        self._grus = self._fit_grus(training_set, seed, log, report)
        self.curve = tuple(log.curve)
        self._process = self._fit_process(data, validation, seed)

    def _fit_process(
        self, data: host.Dataset, validation: host.Dataset, seed: int
    ) -> GpEstimator | None:
        if not (points := self.config.points):
            return None
        process = GpEstimator(GpSettings(points=points, play_widths=self.config.play_widths))
        process.known = self.known
        process.learn(data, validation, seed=seed, report=host.quiet)
        self.kernel = process.kernel
        return process

    def _fit_perceptrons(
        self, data: TrainingSet, seed: int, log: _CurveLog, report: host.Report
    ) -> _nets.Perceptrons:
        c, outputs = self.config, len(self._outputs.scale)
        how = Training(c.perceptron_epochs, noise=c.noise, decay=0.2 * c.decay)
        inputs = data.inputs.shape[1] + len(data.moving)
        sizes = (inputs, c.perceptron_units, c.perceptron_units, outputs)
        share = _PERCEPTRON_SHARE * c.perceptrons
        note = log.part("perceptrons", share, c.perceptron_epochs, report)
        return self._resumed(
            _nets.Perceptrons,
            "perceptrons",
            seed,
            lambda: train_perceptrons(data, sizes, c.perceptrons, how, seed, note),
        )

    def _fit_grus(
        self, data: TrainingSet, seed: int, log: _CurveLog, report: host.Report
    ) -> _nets.Grus:
        c, outputs = self.config, len(self._outputs.scale)
        how = Training(c.gru_epochs, noise=c.noise, decay=c.decay, dropout=c.dropout)
        found = []
        for index in range(c.grus):
            note = log.part(f"GRU {index + 1} of {c.grus}", 1.0, c.gru_epochs, report)
            fit = partial(
                train_gru, data, c.gru_units, outputs, c.window, how, seed + 1 + index, note
            )
            found.append(self._resumed(_nets.Grus, f"gru_{index}", seed, fit))
        return _nets.stack_grus(found)

    def _resumed(self, kind: type[N], name: str, seed: int, fit: Callable[[], N]) -> N:
        """A net from an interrupted fit of the same data and settings, or freshly trained."""
        key = seed, self.config.model_dump(mode="json"), self._digests
        saved = onnx.Checkpoint(self.checkpoint, name, key)
        net = saved.load(lambda state: kind.from_values(state["net"]))
        if net is None:
            net = fit()
            saved.store(now=True, net=net.values())
        return net

    def compute(
        self, graph: onnx.Graph, features: onnx.Value, memory: onnx.Value, tick: onnx.Value
    ) -> onnx.Core:
        """The nets, averaged with the process; the memory of the process stands last."""
        if (process := self._process) is None:
            return self._nets(graph, features, memory, tick)
        kept = sum(self._widths()), process.memory_size
        own, others = graph.ops("Split", 2, memory, graph.constant(kept, np.int64), axis=1)
        nets = self._nets(graph, features, own, tick)
        other = process.compute(graph, features, others, tick)
        apart = graph.op("Sub", other.error, nets.error)
        error = graph.op("Add", nets.error, graph.op("Mul", apart, np.float32(_SHARE)))
        # Variance of a mixture: within its parts, and between them.
        between = graph.op("ReduceSumSquare", apart, axes=[1], keepdims=1)
        spreads = [part.spread for part in (nets, other) if part.spread is not None]
        variances = graph.op("Concat", *spreads, between, axis=1)
        weights = np.array([[1.0 - _SHARE], [_SHARE], [_SHARE * (1.0 - _SHARE)]])
        spread = graph.op("MatMul", variances, weights)
        memories = [part.memory for part in (nets, other) if part.memory is not None]
        memory = graph.op("Concat", *memories, axis=1)
        return onnx.Core(error, memory, spread, sum(kept))

    def _nets(
        self, graph: onnx.Graph, features: onnx.Value, memory: onnx.Value, tick: onnx.Value
    ) -> onnx.Core:
        """Memory: a started flag, play states, hidden states, moving inputs of the last tick."""
        sizes = graph.constant(self._widths(), np.int64)
        started, states, before, last = graph.ops("Split", 4, memory, sizes, axis=1)
        play, states = self._bank.in_graph(graph, features, states, started)
        raw = graph.columns(features, self._columns)
        inputs = graph.op("Concat", self._scaling.in_graph(graph, raw), play, axis=1)
        moving = graph.columns(inputs, self._moving)
        last = graph.mix(started, last, moving)
        steps = graph.op("Mul", graph.op("Sub", moving, last), np.float32(_nets.STEP_GAIN))
        recurrent, after = self._grus.in_graph(graph, inputs, steps, before)
        stepped = graph.op("Concat", inputs, graph.op("Tanh", steps), axis=1)
        members = graph.op("Concat", self._perceptrons.in_graph(graph, stepped), recurrent, axis=0)
        mean = graph.total(members, 0, mean=True)
        away = graph.op("Mul", graph.op("Sub", members, mean), self._outputs.reach_mm)
        squares = graph.total(graph.op("Mul", away, away), 0, mean=True)
        spread = graph.op("ReduceSum", squares, graph.constant([1], np.int64), keepdims=1)
        begun = graph.ones_like(started)
        slow = graph.mix(
            tick,
            graph.op("Concat", after, moving, axis=1),
            graph.op("Concat", before, last, axis=1),
        )
        kept = graph.op("Concat", begun, states, slow, axis=1)
        error = self._outputs.error_in_graph(graph, self._data_schema, features, mean)
        return onnx.Core(error, kept, spread, sum(self._widths()))

    def _widths(self) -> list[int]:
        """Of the parts of the nets' memory."""
        hidden = self._grus.members * self._grus.hidden
        return [1, self._bank.size, hidden, len(self._moving)]

    def _moving_inputs(self) -> list[int]:
        """Places of the joints (or the position) among the inputs."""
        schema = self._data_schema
        read = np.any(schema.reading_matrix(schema.joints or schema.position) != 0, axis=1)
        return [place for place, column in enumerate(self._columns) if read[column]]

    def _inputs(self, data: host.Dataset) -> Floats:
        scaled = self._scaling.apply(data.states[:, self._columns])
        return np.concatenate([scaled, self._bank.features(data)], axis=1)


class _CurveLog:
    """The learning curve of all nets in a row, and the progress it means."""

    def __init__(self, total: float) -> None:
        self.curve: list[host.Epoch] = []
        self._total, self._done = total, 0.0

    def part(self, what: str, share: float, epochs: int, report: host.Report) -> AfterEpoch:
        """Begins the next net, whose epochs cost `share` each."""
        before = self._done
        self._done += share * epochs

        def note(epoch: int, train: float, score: float) -> None:
            self.curve.append(host.Epoch(len(self.curve), train, score))
            report((before + share * (epoch + 1)) / self._total, f"{what}: {score:.3f} mm")

        return note


@host.hookimpl
def measure_estimators() -> list[type[host.Estimator]]:
    """Register the estimator."""
    return [StreamEstimator]
