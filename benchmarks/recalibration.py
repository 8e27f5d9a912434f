"""Twenty poses in the morning: `python -m benchmarks.recalibration DATA VALIDATION`.

DATA is a data set of several recordings of a real arm. Groups of them are left out in turn; every
recording is then a morning: the arm is recalibrated by 20 of its labels that `measure recalibrate`
chooses, by 20 evenly spread in time (means of five draws), or by 62 in a row (the first, from the
200th and from the 400th), and judged by all its other labels. Where choosing or re-zeroing is
refused, none is done.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

import numpy as np

from benchmarks.command import run_command
from measure.arrays import Floats, Ints
from measure.errors import EstimatorError
from measure.host import Dataset, Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import choose_poses, files, fit_zeroing
from measure_learning.onnx import OnnxModel

COUNT, DRAWS = 20, 5
Morning: TypeAlias = tuple[OnnxModel, Dataset, Floats]
"""A recording, a model that has not seen it, and what that leaves of its labels (n, 3)."""
IN_A_ROW, FIRST = 62, (0, 200, 400)


def main() -> None:
    """Print a line for every recording, and the roots of their mean squares."""
    parser = argparse.ArgumentParser(prog="benchmarks.recalibration", description=__doc__)
    parser.add_argument("data", type=Path, help="made by `measure dataset`")
    parser.add_argument("validation", type=Path, help="another, to choose and stop by")
    parser.add_argument("--estimator", default="gp")
    parser.add_argument("--folds", type=int, default=4)
    given = parser.parse_args()
    data, validation = files.read_dataset(given.data), files.read_dataset(given.validation)
    mornings = [
        (model, day, _left(model, day))
        for held in data.recording_groups(given.folds, 10)
        for model in [_fitted(given.estimator, data, validation, held)]
        for day in [data.select([name]) for name in held]
    ]
    _tell(mornings)
    print(f"{'recording':16} labels  as it is  {COUNT} chosen  {COUNT} spread  {IN_A_ROW} in a row")
    lines = list(map(_line, mornings))
    weights = np.array([count for count, _ in lines], dtype=np.float64)
    squares = np.array([sizes for _, sizes in lines]) ** 2
    for what, share in (("by recording", np.ones(len(lines))), ("by label", weights)):
        mean = np.sqrt(share @ squares / share.sum())
        print(f"{what:16} {weights.sum():6.0f}  " + "  ".join(f"{size:9.3f}" for size in mean))


def _fitted(name: str, data: Dataset, validation: Dataset, held: Sequence[str]) -> OnnxModel:
    estimator = Registry.discover().build(Estimator, name, {})
    estimator.folds = 0
    rest = data.select([name for name in data.present() if name not in held])
    estimator.fit(rest, validation, seed=0, report=quiet)
    return estimator.model  # type: ignore[attr-defined]


def _tell(mornings: Sequence[Morning]) -> None:
    """Each model what is left of the recordings left out, as `measure train` does."""
    offsets = np.array([left.mean(axis=0) for _, _, left in mornings])
    every = np.concatenate([left for _, _, left in mornings])
    after = float(np.sqrt((every**2).sum(axis=1).mean()))
    for model, _, _ in mornings:
        model.facts["offset_sd_mm"] = float(np.sqrt((offsets**2).mean()))
        model.card = {"left_out": {"after_mm": after}}


def _left(model: OnnxModel, day: Dataset) -> Floats:
    return (day.errors_mm - model.predict(day).errors_mm)[day.usable]


def _line(morning: Morning) -> tuple[int, list[float]]:
    model, day, left = morning
    labels = np.flatnonzero(day.usable)
    count = len(labels)
    with TemporaryDirectory() as folder:
        files.write_dataset(Path(folder, "day.parquet"), day, [], "a recording")
        chosen = np.empty(0, dtype=np.int64)
        with suppress(EstimatorError):  # most joints are where the training never had them
            chosen = choose_poses(model, Path(folder, "day.parquet"), COUNT).rows
    near = np.array([np.argmin(np.abs(labels - row)) for row in chosen], dtype=np.int64)
    near = np.unique(near)  # labels are usable
    apart = count / COUNT
    spread = [
        np.floor((np.arange(COUNT) + (draw + 0.5) / DRAWS) * apart).astype(np.int64)
        for draw in range(DRAWS)
    ]
    rows = [np.arange(first, first + IN_A_ROW) for first in FIRST if first + 2 * IN_A_ROW < count]
    sizes = [float(np.sqrt((left**2).sum(axis=1).mean()))]
    for sets in ([near], spread, rows):
        squares = [_after(model, day.states[labels], left, one) for one in sets]
        sizes.append(float(np.sqrt(np.mean(squares))))
    name = day.present()[0]
    print(f"{name[-16:]:16} {count:6d}  " + "  ".join(f"{size:9.3f}" for size in sizes), flush=True)
    return count, sizes


def _after(model: OnnxModel, states: Floats, left: Floats, picked: Ints) -> float:
    """Mean square of all other labels."""
    others = np.setdiff1d(np.arange(len(left)), picked)
    if not len(picked):
        return float((left**2).sum(axis=1).mean())
    try:
        zeroing = fit_zeroing(
            model.schema,
            states[picked],
            left[picked],
            offset_sd_mm=model.facts["offset_sd_mm"],
            spread_sd=np.array(model.facts["joint_sd"]),
            or_none=True,
        )
    except EstimatorError:
        return float((left[others] ** 2).sum(axis=1).mean())
    rest = left[others] - zeroing.offset_mm(states[others])
    return float((rest**2).sum(axis=1).mean())


if __name__ == "__main__":
    run_command(main)
