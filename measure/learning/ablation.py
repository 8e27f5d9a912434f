"""Importance of an estimator's inputs: shuffle them, or leave them out and fit again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.host import Dataset, Estimator, OnnxModel, Report
from measure.host.estimator import quiet
from measure.learning.fitting import fit
from measure.learning.scores import corrected_rms_mm
from measure.learning.splits import Split


@dataclass(frozen=True)
class Importance:
    """Increase of the test RMS without an input."""

    name: str  # of a feature or a group of features
    features: int
    permuted_mm: float  # RMS with the columns shuffled among rows; history is shuffled with them
    removed_mm: float | None  # RMS after fitting without them; None if not tried
    permutation_mm: float  # `permuted_mm` minus the RMS with all inputs
    removal_mm: float | None  # likewise


def ablate(
    model: OnnxModel,
    split: Split,
    groups: dict[str, Sequence[str]],
    *,
    refit: Callable[[], Estimator] | None = None,
    seed: int = 0,
    report: Report,
) -> tuple[float, list[Importance]]:
    """RMS in mm with all inputs, and the importance of every group of features, the largest first.

    `refit` makes an unfitted estimator; given, every group is also removed and refitted. A removed
    feature is held at its mean, so that files and schemas stay alike.
    """
    base = corrected_rms_mm(model, split.test)
    found = []
    for index, (name, members) in enumerate(groups.items()):
        report(index / len(groups), name)
        columns = split.test.schema.index(members)
        permuted = corrected_rms_mm(model, _shuffled(split.test, columns, seed))
        removed = None if refit is None else _removed(refit(), split, columns, seed)
        removal = None if removed is None else removed - base
        found.append(Importance(name, len(columns), permuted, removed, permuted - base, removal))
    report(1.0, "done")
    return base, sorted(found, key=lambda item: -item.permutation_mm)


def single_fields(data: Dataset) -> dict[str, Sequence[str]]:
    """Every feature on its own, those that never vary left out."""
    spread = np.ptp(data.states, axis=0)
    return {name: (name,) for name, s in zip(data.schema.names, spread, strict=True) if s > 0}


def field_groups(data: Dataset) -> dict[str, Sequence[str]]:
    """The robot's own groups of features, or single fields where it has none."""
    return dict(data.schema.groups) or single_fields(data)


def _shuffled(data: Dataset, columns: Sequence[int], seed: int) -> Dataset:
    order = np.random.default_rng(seed).permutation(len(data))
    return _with(data, columns, data.states[order][:, columns])


def _with(data: Dataset, columns: Sequence[int], values: Floats) -> Dataset:
    states = data.states.copy()
    states[:, columns] = values
    return replace(data, states=states)


def _removed(estimator: Estimator, split: Split, columns: Sequence[int], seed: int) -> float:
    middle = split.train.states[:, columns].mean(axis=0)
    train, validation, test = (
        _with(part, columns, middle) for part in (split.train, split.validation, split.test)
    )
    estimator.folds = 0
    fit(estimator, train, validation, seed=seed, report=quiet)
    return corrected_rms_mm(estimator.model, test)  # type: ignore[attr-defined]
