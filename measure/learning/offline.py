"""Correcting recorded states with the same code that runs online."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Bools, Floats
from measure.errors import EstimatorError
from measure.host import Correction, Dataset, OnnxModel
from measure.learning.guard import DriftMonitor, GuardedModel, runs_of
from measure.learning.zeroing import Zeroing, fit_zeroing
from measure.robots import Feature, Reading, StateSchema, check_robot, read_log
from measure.robots.tables import Table


@dataclass(frozen=True, eq=False)
class StateTable:
    """Recorded states of one or more runs.

    Attributes:
        run: (n,) labels; the model's history restarts where they change.
        index: (n,) the rows' own numbers.
        times_s: (n,) NaN where not recorded.
        states: (n, features).
    """

    run: Any
    index: Any
    times_s: Floats
    states: Floats


@dataclass(frozen=True, eq=False)
class Corrected:
    """Estimated errors (n, 3) mm, NaN where refused; SDs (n,) 3-D; flags; what was counted."""

    errors_mm: Floats
    sd_mm: Floats
    unfamiliar: Bools
    counts: dict[str, int]
    covariances: Floats


def read_states(path: Path, model: OnnxModel) -> StateTable:
    """States from Parquet or CSV (columns `run`, `i` and `t_s` or `time_s` optional) or a bag.

    Raises:
        EstimatorError: features are missing (they are named), the states are of another robot, or
            the file cannot be read.
    """
    if not path.exists():
        raise EstimatorError(f"{path}: no such file of states")
    if path.suffix not in (".parquet", ".csv"):
        log = read_log(path, schema_of(model))
        count = len(log.times_s)
        return StateTable(np.array([path.stem] * count), np.arange(count), log.times_s, log.states)
    table = Table.read(path)
    check_robot(table, model.robot)
    states = table.numbers(*model.features)
    run, times = np.array([path.stem] * len(table)), np.full(len(table), np.nan)
    for name in ("trajectory", "run"):
        run = np.array(table.labels(name)) if name in table else run
    for name in ("time_s", "t_s"):
        times = table.numbers(name)[:, 0] if name in table else times
    index = np.array(table.labels("i")) if "i" in table else np.arange(len(table))
    return StateTable(run, index, times, states)


def correct(table: StateTable, model: OnnxModel, zeroing: Zeroing | None = None) -> Corrected:
    """Stream every run through the model, from a reset each."""
    count = len(table.states)
    errors, covariances = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    unfamiliar = np.zeros(count, dtype=bool)
    guarded = GuardedModel(model, zeroing)
    for rows in runs_of(table.run.tolist()):
        guarded.reset()
        for row in range(rows.start, rows.stop):
            answer = guarded.update(table.states[row], float(table.times_s[row]))
            if isinstance(answer, Correction):
                errors[row], covariances[row] = answer.error_mm, answer.covariance
                unfamiliar[row] = answer.unfamiliar
    sd = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    return Corrected(errors, sd, unfamiliar, guarded.counters.values(), covariances)


def write_corrected(path: Path, table: StateTable, corrected: Corrected) -> None:
    """Write `run, i, t_s, ex, ey, ez, sd_mm, unfamiliar` as Parquet or CSV; errors in mm."""
    import pyarrow as pa

    columns = {
        "run": table.run,
        "i": table.index,
        "t_s": table.times_s,
        **{f"e{axis}": corrected.errors_mm[:, k] for k, axis in enumerate("xyz")},
        "sd_mm": corrected.sd_mm,
        "unfamiliar": corrected.unfamiliar,
    }
    out = pa.table(columns)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".csv":
        from pyarrow import csv

        csv.write_csv(out, path)
    else:
        from pyarrow import parquet

        parquet.write_table(out, path)


def rezero(
    model: OnnxModel, stretch: Dataset, monitor: DriftMonitor | None = None
) -> tuple[Zeroing, DriftMonitor]:
    """The offsets after a restart, from a measured stretch, and drift from its residuals.

    Args:
        model: a trained one.
        stretch: measured after the restart.
        monitor: one that goes on; a new one if absent.

    Raises:
        EstimatorError: another robot's data, or too few labels.
    """
    estimates = model.predict(stretch)
    used = stretch.usable
    residuals = (stretch.errors_mm - estimates.errors_mm)[used]
    zeroing = fit_zeroing(stretch.schema, stretch.states[used], residuals)
    monitor = monitor or DriftMonitor()
    stated = estimates.covariances[used] + stretch.covariances[used]
    stated = stated + zeroing.covariance
    left = residuals - zeroing.offset_mm(stretch.states[used])
    for residual, covariance in zip(left, stated, strict=True):
        monitor.add(residual, covariance)
    return zeroing, monitor


def schema_of(model: OnnxModel) -> StateSchema:
    """A schema from the metadata of a model file: enough to read its features from a log."""
    matrix = np.array(model.facts["position_mm"])
    x, y, z = (
        Reading(tuple((model.features[i], float(column[i])) for i in np.flatnonzero(column)))
        for column in matrix.T
    )
    features = tuple(Feature(name, unit) for name, unit in model.facts["features"])
    return StateSchema(model.robot, features, (x, y, z))
