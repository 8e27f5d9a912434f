"""The base of estimators that become one ONNX graph: left-out fits, saving, streaming."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from measure.arrays import Floats
from measure.errors import DivergedError, EstimatorError
from measure.host.dataset import Dataset, recording_of
from measure.host.interfaces import Correction, Estimator, LeftOut, Report, quiet
from measure.host.settings import Settings
from measure.robots import StateSchema
from measure_learning.onnx.graph import Graph, Value
from measure_learning.onnx.judging import (
    INGREDIENTS,
    UNJUDGED,
    Envelope,
    Judged,
    Novelty,
    Travel,
    Trust,
    ingredients_in_graph,
)
from measure_learning.onnx.model import FORMAT, OnnxModel, contract
from measure_learning.onnx.rotation import LEVER_MM, turns_as_errors

_MAX_CORRECTION_MM = 1e6  # larger corrections mean a diverged fit
_MIN_LABELS = 10
_LEAST_GAIN = 0.98  # of the rotation's RMS that may be left where it is worth correcting
_END = 2**31 - 1  # of a slice: all that follows


@dataclass(frozen=True, eq=False)
class Core:
    """Outputs of a plugin's part of the graph."""

    error: Value  # (N, 3) mm
    memory: Value | None = None  # (N, S), the new memory; None if the estimator has none
    # (N, 1) mm^2, variance within the estimator (of an ensemble, say); None if unknown.
    spread: Value | None = None
    memory_size: int = 0  # S


@dataclass(frozen=True, eq=False)
class _Outputs:
    """Of an estimator with all that judges it."""

    error: Value  # (N, 3) mm
    covariance: Value  # (N, 9) mm^2
    strangeness: Value  # (N, 1)
    contradiction: Value  # (N, 1)
    memory: Value  # (N, S), the new memory
    memory_size: int  # S, may be 0


class OnnxEstimator(Estimator):
    """An estimator whose plugin implements `learn` and `compute`.

    Where there are several recordings, groups of them are left out in turn, and the covariance of
    a correction and what is called unfamiliar are fitted to what the others' fits leave of them;
    else to the validation trajectories. The covariance is the second moment of those recordings'
    offsets, and that of the rest of their residuals times factors of what tells those of one
    recording apart: the distance from the states learnt from (in range, Mahalanobis, and in how
    far the joints moved lately, unless memoryless), and the spread that `compute` states. One
    level of both is that of nine in ten recordings. Outside of the training no correction is
    longer than its largest label, the covariance grows to that of no correction, and a state whose
    joints contradict its tip gets none.

    Where labels hold the tip's rotation, another of its kind, by the settings of `draft`, learns
    the rotation's errors (see `turns_as_errors`), and becomes part of the same graph if it leaves
    less of them than there is.

    Attributes:
        memoryless: whether a correction depends on the present state alone.
        first: what learns before this one; see `after`.
    """

    memoryless = False
    first: OnnxEstimator | None = None

    def __init__(self, config: Settings) -> None:
        super().__init__(config)
        self._schema: StateSchema | None = None
        self._period_s = 0.0
        self._trust = UNJUDGED
        self._offset_sd_mm: float | None = None
        self._model: OnnxModel | None = None
        self._turning: OnnxEstimator | None = None

    @abstractmethod
    def learn(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Fit whatever `compute` needs."""

    @abstractmethod
    def compute(self, graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        """Add the estimator's operators, from raw `features` (N, F) and `memory` (N, S)."""

    def watched(self, data: Dataset) -> Sequence[int]:
        """Columns that must resemble the training; what the estimator ignores need not."""
        return range(data.states.shape[1])

    def draft(self) -> Settings:
        """Settings of the fits that leave recordings out; they may be those of a cheaper fit."""
        return self.config

    def after(self, first: Estimator) -> Self:
        """Learn what `first` leaves, which learns before, from the same; both are one graph."""
        if not isinstance(first, OnnxEstimator):
            return super().after(first)
        self.name = f"{self.name} after {first.name}"  # type: ignore[misc]  # of this pair alone
        self.first, self.memoryless = first, self.memoryless and first.memoryless
        return self

    def fit(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Learn from all, then with groups of recordings left out, and fit the covariance.

        EstimatorError: the data cannot be learnt from. DivergedError: corrections are not finite,
        or of kilometres.
        """
        self._turning, self.findings = None, ()
        turns = [turns_as_errors(part) for part in (data, validation)]
        known = [part for part in turns if part and part.usable.sum() >= _MIN_LABELS]
        fits = 2 if known[1:] else 1
        self._fit(data, validation, seed=seed, report=_part(report, 0, fits))
        if known[1:]:
            self._fit_turns(*known, seed=seed, report=_part(report, 1, fits, "rotation, "))
        self._model = OnnxModel(self._build({}))

    def _fit(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        _check_data(data, validation)
        groups = data.recording_groups(self.folds, _MIN_LABELS)
        fits = len(groups) + 1
        self._learn(data, validation, seed=seed, report=_part(report, 0, fits))
        judged = [
            self._left_out(
                held, data, validation, seed=seed, report=_part(report, index, fits, "left out, ")
            )
            for index, held in enumerate(groups, 1)
        ]
        found = Judged.join(judged) if judged else self._judge(validation)
        self._trust = Trust.of(found)
        if groups:
            self._offset_sd_mm = float(np.sqrt((found.offsets_mm() ** 2).mean()))
        before, after = found.rms_mm()
        turns = found.in_turn() if groups else ()
        self.left_out = LeftOut(len(data.recordings()), len(groups), before, after, turns)

    def _fit_turns(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Learn the rotation's errors beside those of the position, if that is of use."""
        twin = OnnxEstimator._twin(self)
        twin.folds = self.folds
        twin.checkpoint = self.checkpoint and self.checkpoint / "rotation"
        twin._fit(data, validation, seed=seed, report=report)  # noqa: SLF001 - its class
        left = twin.left_out
        assert left is not None
        deg = [np.degrees(mm / LEVER_MM) for mm in (left.before_mm, left.after_mm)]
        use = deg[1] < _LEAST_GAIN * deg[0]
        self._turning = twin if use else None
        where = f"{left.groups} groups of recordings left out" if left.groups else "validation"
        said = f"rotation of the tip, {where}: {deg[0]:.3f} deg RMS become {deg[1]:.3f}"
        self.findings += (said if use else f"{said}: it is not corrected",)

    def _left_out(
        self, held: Sequence[str], data: Dataset, validation: Dataset, *, seed: int, report: Report
    ) -> Judged:
        """What a fit without some trajectories, and others of their recordings, leaves of them."""
        twin = self._twin()
        twin.folds = 0
        if self.checkpoint is not None:
            twin.checkpoint = self.checkpoint / f"without_{held[0].replace('/', '_')}"
        recordings = {recording_of(name) for name in held}
        rest, other = (
            part.select([name for name in part.present() if recording_of(name) not in recordings])
            for part in (data, validation)
        )
        left = data.select(held)
        too_few = other.usable.sum() < _MIN_LABELS
        twin._fit(rest, left if too_few else other, seed=seed, report=report)  # noqa: SLF001
        return twin._judge(left)  # noqa: SLF001 - of its own class

    def _twin(self) -> Self:
        """The same, to be fitted to less."""
        twin = type(self)(self.draft())
        return twin if self.first is None else twin.after(self.first._twin())  # noqa: SLF001

    def _learn(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        self._schema = data.schema
        steps = np.concatenate([np.diff(data.times_s[rows]) for _, rows in data.runs()])
        known = steps[np.isfinite(steps) & (steps > 0)]
        self._period_s = float(np.median(known)) if len(known) else 0.0
        self._envelope = Envelope.of(data, validation)
        watched = {*self.watched(data), *(self.first.watched(data) if self.first else ())}
        self._novelty = Novelty.of(data, validation, sorted(watched))
        self._travel = None if self.memoryless else Travel.of(data)
        self._trust, self._offset_sd_mm = UNJUDGED, None
        reading = data.schema.reading_matrix(data.schema.joints or data.schema.position)
        self._joint_sd = (data.states @ reading).std(axis=0).tolist()
        if (first := self.first) is not None:
            first._learn(data, validation, seed=seed, report=quiet)  # noqa: SLF001
            done = OnnxModel(first._build({}))  # noqa: SLF001
            data, validation = (
                replace(part, errors_mm=part.errors_mm - done.predict(part).errors_mm)
                for part in (data, validation)
            )
            self.findings = first.findings
        self.learn(data, validation, seed=seed, report=report)

    def _compute(self, graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        """What `first` and this one correct together; the memory of `first` stands first."""
        if (first := self.first) is None:
            return self.compute(graph, features, memory, tick)
        size = first._compute(Graph(), features, memory, tick).memory_size  # noqa: SLF001
        head = first._compute(graph, features, _slice(graph, memory, 0, size), tick)  # noqa: SLF001
        tail = self.compute(graph, features, _slice(graph, memory, size, _END), tick)
        kept = [part.memory for part in (head, tail) if part.memory is not None]
        return Core(
            graph.op("Add", head.error, tail.error),
            graph.op("Concat", *kept, axis=1) if kept else None,
            tail.spread or head.spread,
            size + tail.memory_size,
        )

    def save(self, path: Path, card: Mapping[str, Any]) -> None:
        """Write the ONNX file."""
        path.write_bytes(self._build(card))

    @property
    def model(self) -> OnnxModel:
        """The fitted graph, ready to run; EstimatorError: nothing has been learnt yet."""
        if self._model is None:
            raise EstimatorError(f"estimator '{self.name}' has not been fitted: call fit first")
        return self._model

    def reset(self) -> None:
        """Forget all history."""
        self.model.reset()

    def update(self, state: Floats, time_s: float) -> Correction:
        """Estimate the error of the next state."""
        return self.model.update(state, time_s)

    def _build(self, card: Mapping[str, Any], *, judging: bool = False) -> bytes:
        assert self._schema is not None
        graph = Graph()
        if (turning := self._turning) is None:
            made, turned = self._whole(graph, "memory", judging=judging), {}
            memory, size = made.memory, made.memory_size
        else:
            size = self._whole(Graph(), "memory").memory_size
            made = self._whole(graph, _slice(graph, "memory", 0, size))
            other = turning._whole(graph, _slice(graph, "memory", size, _END))  # noqa: SLF001
            memory, size = made.memory, size + other.memory_size
            if size:
                memory = graph.op("Concat", memory, other.memory, axis=1)
            rad = graph.op("Mul", other.error, np.float32(1.0 / LEVER_MM))
            rad2 = graph.op("Mul", other.covariance, np.float32(1.0 / LEVER_MM**2))
            turned = {"turn_rad": (rad, (3,)), "turn_covariance": (rad2, (9,))}
        size = max(size, 1)
        return graph.build(
            {"features": len(self._schema.features), "memory": size, "tick": 1},
            {
                "error_mm": (made.error, (3,)),
                "covariance": (made.covariance, (9,)),
                "strangeness": (made.strangeness, (1,)),
                "contradiction": (made.contradiction, (1,)),
                "memory_out": (memory, (size,)),
                **turned,
            },
            {"measure": self._facts(size), "card": dict(card)},
            contract(len(self._schema.features), size, self._period_s, turns=bool(turned)),
        )

    def _whole(self, graph: Graph, given: Value, *, judging: bool = False) -> _Outputs:
        """Add all of this estimator, with its covariance, whose memory is `given`."""
        assert self._schema is not None
        memory, nothing = given, graph.op("Mul", "tick", np.float32(0.0))
        own, travel, size = None, nothing, 0
        if self._travel is not None:
            size = self._travel.size
            own, memory = _slice(graph, given, 0, size), _slice(graph, given, size, _END)
            travel, own = self._travel.in_graph(graph, "features", own, "tick")
        core = self._compute(graph, "features", memory, "tick")
        near = graph.op("Max", *self._novelty.in_graph(graph, "features"))
        farther = graph.op("Max", near, travel)
        familiar = np.float32(1.0 / self._trust.limit)
        near, strangeness = (graph.op("Mul", one, familiar) for one in (near, farther))
        contradiction = self._envelope.contradiction(graph, self._schema, "features")
        sound = graph.op("LessOrEqual", contradiction, np.ones((1, 1)))
        ingredients = ingredients_in_graph(graph, farther, core.spread or nothing)
        if judging:  # the covariance's nine places carry its ingredients
            error = core.error
            covariance = graph.op("Concat", ingredients, *[nothing] * (9 - INGREDIENTS), axis=1)
        else:
            covariance = self._trust.covariance(graph, ingredients)
            error, covariance = self._envelope.bounded(
                graph, core.error, covariance, strangeness, sound
            )
        parts = [part for part in (own, core.memory) if part is not None]
        after = graph.op("Concat", *parts, axis=1) if parts else nothing
        size += core.memory_size
        if size:
            after = self._envelope.kept(graph, near, sound, (_slice(graph, given, 0, size), after))
        strangeness = graph.op("Max", strangeness, contradiction)
        return _Outputs(error, covariance, strangeness, contradiction, after, size)

    def _facts(self, memory: int) -> dict[str, Any]:
        """The metadata `measure`, see `measure_learning.onnx.model`."""
        assert self._schema is not None
        return {
            "format": FORMAT,
            "estimator": self.name,
            "settings": self.config.model_dump(mode="json"),
            "robot": self._schema.robot,
            "schema": self._schema.to_dict(),
            "features": [[f.name, f.unit] for f in self._schema.features],
            "position_mm": self._schema.reading_matrix(self._schema.position).tolist(),
            "period_s": self._period_s,
            "memory": memory,
            "memoryless": self.memoryless,
            "joint_sd": self._joint_sd,
            "range": self._envelope.ranges.tolist(),
            "largest_mm": self._envelope.largest_mm,
            "gap_mm": self._envelope.gap_mm,
            **({} if self._offset_sd_mm is None else {"offset_sd_mm": self._offset_sd_mm}),
        }

    def _judge(self, data: Dataset) -> Judged:
        """What is left of the errors of other trajectories."""
        with np.errstate(over="ignore"):  # what is too large for float32 is found here
            estimates = OnnxModel(self._build({}, judging=True)).predict(data)
        if not (np.abs(estimates.errors_mm) < _MAX_CORRECTION_MM).all():
            raise DivergedError(
                f"the fit of estimator '{self.name}' diverged, its corrections are no numbers or "
                "of kilometres: choose other settings, such as a lower learning rate"
            )
        used = data.usable
        errors = data.errors_mm[used]
        ingredients = estimates.covariances[used].reshape(-1, 9)[:, :INGREDIENTS]
        left = errors - estimates.errors_mm[used]
        recordings = np.array([recording_of(name) for name in data.names])[data.trajectory[used]]
        labels, far = data.covariances[used], estimates.strangeness[used]
        return Judged(errors, left, labels, ingredients, far, recordings)


def _slice(graph: Graph, memory: Value, start: int, stop: int) -> Value:
    return graph.op("Slice", memory, *(graph.constant([v], np.int64) for v in (start, stop, 1)))


def _part(report: Report, index: int, count: int, prefix: str = "") -> Report:
    """The progress of one of several fits in a row."""
    return lambda done, what: report((index + done) / count, prefix + what)


def _check_data(data: Dataset, validation: Dataset) -> None:
    for what, part in (("training", data), ("validation", validation)):
        if part.usable.sum() < _MIN_LABELS:
            raise EstimatorError(
                f"the {what} part has {int(part.usable.sum())} usable labels, at least "
                f"{_MIN_LABELS} are needed: record more, or split otherwise"
            )
        if not np.all(np.isfinite(part.states)):
            row, column = np.argwhere(~np.isfinite(part.states))[0]
            raise EstimatorError(
                f"the {what} part has a state that is not a number: row {row}, feature "
                f"'{part.schema.names[column]}'"
            )
        if np.any(~np.isfinite(part.errors_mm[part.usable])):
            raise EstimatorError(f"the {what} part has usable labels that are not numbers")
    if shared := set(data.present()) & set(validation.present()):
        raise EstimatorError(
            f"trajectory {sorted(shared)[0]} is in training and validation: split by trajectory"
        )
