"""The base of estimators that become one ONNX graph: left-out fits, saving, streaming."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host.dataset import Dataset, recording_of
from measure.host.interfaces import Correction, Estimator, LeftOut, Report, quiet
from measure.host.settings import Settings
from measure_learning.onnx.fit import Compute, Core, Fit, in_turn
from measure_learning.onnx.graph import Graph, Value
from measure_learning.onnx.judging import Envelope, Judged, Novelty, Travel, Trust
from measure_learning.onnx.model import OnnxModel
from measure_learning.onnx.rotation import LEVER_MM, turns_as_errors

_MIN_LABELS = 10
_LEAST_GAIN = 0.98  # of the rotation's RMS that may be left where it is worth correcting

_Given = tuple[Dataset, Dataset]  # the training and the validation trajectories


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
        self._fit: Fit | None = None

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
        self.findings, given = (), (data, validation)
        turns = [turns_as_errors(part) for part in given]
        known = [part for part in turns if part and part.usable.sum() >= _MIN_LABELS]
        fit, self.left_out = _judged_fit(self, given, seed, _part(report, 0, len(known) or 1))
        if known[1:]:
            rest = _part(report, 1, 2, "rotation, ")
            turning, found = self._turning((known[0], known[1]), seed, rest)
            fit, self.findings = replace(fit, turning=turning), (*self.findings, found)
        self._fit = fit

    def _turning(self, given: _Given, seed: int, report: Report) -> tuple[Fit | None, str]:
        """A fit to the rotation's errors, if that is of use, and what it leaves of them."""
        twin = OnnxEstimator.twin(self)
        twin.folds = self.folds
        twin.checkpoint = self.checkpoint and self.checkpoint / "rotation"
        fit, left = _judged_fit(twin, given, seed, report)
        deg = [np.degrees(mm / LEVER_MM) for mm in (left.before_mm, left.after_mm)]
        where = f"{left.groups} groups of recordings left out" if left.groups else "validation"
        found = f"rotation of the tip, {where}: {deg[0]:.3f} deg RMS become {deg[1]:.3f}"
        if deg[1] < _LEAST_GAIN * deg[0]:
            return fit, found
        return None, f"{found}: it is not corrected"

    def twin(self) -> Self:
        """The same with the settings of `draft`, to be fitted to less."""
        twin = type(self)(self.draft())
        return twin if self.first is None else twin.after(self.first.twin())

    def save(self, path: Path, card: Mapping[str, Any]) -> None:
        """Write the ONNX file; EstimatorError: nothing has been learnt yet."""
        path.write_bytes(self._fitted.build(card))

    @property
    def model(self) -> OnnxModel:
        """The fitted graph, ready to run; EstimatorError: nothing has been learnt yet."""
        return self._fitted.model

    @property
    def _fitted(self) -> Fit:
        if self._fit is None:
            raise EstimatorError(f"estimator '{self.name}' has not been fitted: call fit first")
        return self._fit

    def reset(self) -> None:
        """Forget all history."""
        self.model.reset()

    def update(self, state: Floats, time_s: float) -> Correction:
        """Estimate the error of the next state."""
        return self.model.update(state, time_s)


def _judged_fit(
    one: OnnxEstimator, given: _Given, seed: int, report: Report
) -> tuple[Fit, LeftOut]:
    """A fit whose covariance is that of recordings left out, else of the validation."""
    data, validation = given
    groups = data.recording_groups(one.folds, _MIN_LABELS)
    fits = len(groups) + 1
    fit = _fit(one, given, seed, _part(report, 0, fits))
    judged = [
        _left_out(one, held, given, seed, _part(report, index, fits, "left out, "))
        for index, held in enumerate(groups, 1)
    ]
    found = Judged.join(judged) if judged else fit.judge(validation)
    fit, turns = replace(fit, trust=Trust.of(found)), found.in_turn() if groups else ()
    if groups:
        offset = float(np.sqrt((found.offsets_mm() ** 2).mean()))
        fit = replace(fit, facts={**fit.facts, "offset_sd_mm": offset})
    return fit, LeftOut(len(data.recordings()), len(groups), *found.rms_mm(), turns)


def _left_out(
    one: OnnxEstimator, held: Sequence[str], given: _Given, seed: int, report: Report
) -> Judged:
    """What a fit without some trajectories, and others of their recordings, leaves of them."""
    twin = one.twin()
    if one.checkpoint is not None:
        twin.checkpoint = one.checkpoint / f"without_{held[0].replace('/', '_')}"
    recordings = {recording_of(name) for name in held}
    rest, other = (
        part.select([name for name in part.present() if recording_of(name) not in recordings])
        for part in given
    )
    left = given[0].select(held)
    too_few = other.usable.sum() < _MIN_LABELS
    return _fit(twin, (rest, left if too_few else other), seed, report).judge(left)


def _fit(one: OnnxEstimator, given: _Given, seed: int, report: Report) -> Fit:
    """What `one` learns from the given, after what is `first`."""
    _check_data(*given)
    compute: Compute = one.compute
    (data, validation), watched, schema = given, {*one.watched(given[0])}, given[0].schema
    steps = np.concatenate([np.diff(data.times_s[rows]) for _, rows in data.runs()])
    known = steps[np.isfinite(steps) & (steps > 0)]
    reading = schema.reading_matrix(schema.joints or schema.position)
    facts = {
        "estimator": one.name,
        "settings": one.config.model_dump(mode="json"),
        "period_s": float(np.median(known)) if len(known) else 0.0,
        "memoryless": one.memoryless,
        "joint_sd": (data.states @ reading).std(axis=0).tolist(),
    }
    travel = None if one.memoryless else Travel.of(data)
    if (first := one.first) is not None:
        before = _fit(first, given, seed, quiet)
        model, compute = before.model, in_turn(before.compute, compute)
        watched |= {*first.watched(data)}
        data, validation = (
            replace(part, errors_mm=part.errors_mm - model.predict(part).errors_mm)
            for part in given
        )
        one.findings = first.findings
    one.learn(data, validation, seed=seed, report=report)
    novelty = Novelty.of(*given, sorted(watched))
    return Fit(facts, schema, compute, Envelope.of(*given), novelty, travel)


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
