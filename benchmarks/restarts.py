"""After a restart, and with worn cables: `python -m benchmarks.restarts [MODEL]`.

For restarts of the simulated robot that no network has seen: the error as reported, corrected, and
corrected with the offset that the first minute shows (`--rezero`), all over the two minutes that
follow and judged by the true tip at the true time; the first minute is measured with noise, on a
clock that must be found. Where re-zeroing is refused, none is done. Then how many seconds of
measuring it takes until the drift monitor asks for training (-: never; refused: re-zeroing on all
three minutes is), for cables as they were and with their slack and friction grown.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import Dataset
from measure_learning import api
from measure_learning.core import DriftMonitor, LabelKind, simulated_dataset
from measure_learning.core.correction import rezero
from measure_learning.onnx import OnnxModel
from measure_learning.simulator import Cables

MINUTES, FIRST_S = 3.0, 60.0
SEEDS = range(21, 27)
WEARS = (1.0, 1.2, 1.4, 2.0)


def main() -> None:
    """Print a line for every wear."""
    parser = argparse.ArgumentParser(prog="benchmarks.restarts", description=__doc__)
    parser.add_argument("model", nargs="?", type=Path, default=api.shipped_model())
    model = OnnxModel.load(parser.parse_args().model)
    print("wear  reported  corrected  re-zeroed  residuals  alarm after, s")
    for wear in WEARS:
        found = [one(model, seed, wear) for seed in SEEDS]
        sizes = np.sqrt(np.mean([size for size, _, _ in found], axis=0))
        ratio = np.nanmedian([ratio for _, ratio, _ in found])
        alarms = "  ".join(alarm for _, _, alarm in found)
        reported, corrected, zeroed = sizes
        print(
            f"{wear:4.1f}  {reported:8.3f}  {corrected:9.3f}  {zeroed:9.3f}  {ratio:9.2f}  {alarms}"
        )


def one(model: OnnxModel, seed: int, wear: float) -> tuple[Floats, float, str]:
    """A restart's mean squares (reported, corrected, re-zeroed), residual size, time of alarm."""
    measured, true = (
        simulated_dataset(
            minutes=MINUTES,
            pairs=1059,
            restarts=1,
            seed=seed,
            cables=Cables(wear=wear),
            labels=LabelKind(exact),
        )[0]
        for exact in (False, True)
    )
    early = measured.times_s - measured.times_s[0] < FIRST_S
    left = true.errors_mm - model.predict(true).errors_mm
    try:
        zeroing, _ = rezero(model, replace(measured, usable=measured.usable & early))
        zeroed = left - zeroing.offset_mm(true.states)
    except EstimatorError:
        zeroed = left
    late = true.times_s - true.times_s[0] >= FIRST_S
    sizes = [(e[late] ** 2).sum(axis=1).mean() for e in (true.errors_mm, left, zeroed)]
    ratio, alarm = watch(model, measured)
    return np.array(sizes), ratio, alarm


def watch(model: OnnxModel, data: Dataset) -> tuple[float, str]:
    """Residuals over promised at the end of a stretch, and when the monitor first fired, in s."""
    fired: list[float] = []

    class Watched(DriftMonitor):
        def add(self, residual_mm: Floats, covariance: Floats) -> None:
            super().add(residual_mm, covariance)
            if self.due:
                fired.append(float(times[self.count - 1]))

    times = data.times_s[data.usable] - data.times_s[0]
    try:
        _, monitor = rezero(model, data, Watched())
    except EstimatorError:
        return float("nan"), "refused"
    return monitor.ratio**0.5, f"{fired[0]:.0f}" if fired else "-"


if __name__ == "__main__":
    run_command(main)
