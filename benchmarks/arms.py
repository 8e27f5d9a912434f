"""Simulated arms whose constants are drawn: `python -m benchmarks.arms [--arms N]`.

Every constant of `Cables` that is an assumption is drawn for each arm. The arm also has hysteresis
that no estimator contains (Maxwell slip that creeps), drift within a session, and cameras with a
bias in their labels. Each estimator is judged twice: by the paper's own protocol (one recording, a
tenth of its trajectories held out, measured labels) and as in use (other restarts, the true tip).
Printed are medians over the arms, and the 10 and 90 % quantiles.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.command import run_command
from measure.arrays import Floats
from measure.host import Dataset, Estimator, Registry, quiet
from measure_learning.core import AssemblySettings, evaluate, simulated_dataset
from measure_learning.simulator import Cables, Slip

ESTIMATORS: dict[str, dict[str, Any]] = {"offset": {}, "ridge": {}, "gp": {"points": 1000}}
_PAIRS_PER_MIN = 353.0  # of the paper: 49 407 in 140 minutes
_CUT = AssemblySettings(cut_s=20.0)
_SPREAD = 0.35  # SD of the logarithm of a constant: a factor of 1.4
_BIAS_MM = 0.3  # SD per axis of what the cameras' bias changes over 50 mm; the paper's is .53 RMS


def drawn_arm(seed: int) -> Cables:
    """An arm whose every assumed constant is drawn."""
    dice, usual = np.random.default_rng(seed), Cables()

    def around(values: Any, spread: float = _SPREAD) -> Any:
        drawn = np.asarray(values) * np.exp(dice.normal(0.0, spread, np.shape(values)))
        return tuple(drawn.tolist()) if np.ndim(values) else float(drawn)

    def signed(values: Any) -> Any:
        return tuple((dice.normal(0.0, 1.0, len(values)) * np.abs(values)).tolist())

    wrist = np.array(usual.wrist) + np.where(np.eye(3) > 0, 0.0, dice.normal(0.0, 0.1, (3, 3)))
    slip = np.array([0.0017, 0.0017, 0.0002, 0.017, 0.035, 0.052, 0.052])  # rad, m
    return Cables(
        stiffness=around(usual.stiffness),
        stiffening=around(usual.stiffening),
        load=around(usual.load),
        backlash=around(usual.backlash),
        friction=around(usual.friction),
        bristle=around(usual.bristle),
        damping=around(usual.damping),
        wrist=tuple(map(tuple, wrist.tolist())),
        homing=signed(usual.homing),
        restart_sd=around(usual.restart_sd),
        registration_mm=signed(usual.registration_mm),
        registration_rotvec_deg=signed(usual.registration_rotvec_deg),
        registration_sd=around(usual.registration_sd),
        slip=Slip(around(slip), around(8.0), signed(0.3 * slip), around(900.0)),
    )


def _sessions(cables: Cables, seed: int, count: int, minutes: float, exact: bool) -> Dataset:
    pairs = round(_PAIRS_PER_MIN * minutes * count)
    return simulated_dataset(
        minutes=minutes * count, pairs=pairs, restarts=count, seed=seed, cables=cables,
        exact=exact, settings=_CUT,
    )[0]  # fmt: skip


def _biased(data: Dataset, bias: Floats) -> Dataset:
    """Labels with the cameras' own error, linear in the position."""
    apart = (data.reported_mm - data.reported_mm.mean(axis=0)) / 50.0
    return replace(data, errors_mm=data.errors_mm + apart @ bias)


def _changes(name: str, train: Dataset, validation: Dataset, test: Dataset) -> list[float]:
    """Changes of RMS and SD on a test, and what is left, mm."""
    estimator = Registry.discover().build(Estimator, name, ESTIMATORS[name])
    estimator.folds = 0
    estimator.fit(train, validation, seed=0, report=quiet)
    found = evaluate(test, estimator.model.predict(test))  # type: ignore[attr-defined]
    return [found.rms_change, found.sd_change, found.after.rms_mm]


def of_one_arm(seed: int, minutes: float) -> dict[str, list[list[float]]]:
    """By estimator: the paper's protocol and restarts unseen, each with `_changes`."""
    cables, dice = drawn_arm(seed), np.random.default_rng(1000 + seed)
    bias = dice.normal(0.0, _BIAS_MM, (3, 3))
    known = _biased(_sessions(cables, 10 * seed + 1, 4, minutes, exact=False), bias)
    later = _sessions(cables, 10 * seed + 5, 3, minutes, exact=True)
    recordings = known.recordings()
    *learnt, last = recordings
    one = known.select(recordings[learnt[0]])
    order = dice.permutation(one.present()).tolist()
    tenth = max(1, len(order) // 10)
    held, chosen, rest = order[:tenth], order[tenth : 2 * tenth], order[2 * tenth :]
    several = [name for recording in learnt for name in recordings[recording]]
    return {
        name: [
            _changes(name, one.select(rest), one.select(chosen), one.select(held)),
            _changes(name, known.select(several), known.select(recordings[last]), later),
        ]
        for name in ESTIMATORS
    }


def main() -> None:
    """Draw, train, print."""
    parser = argparse.ArgumentParser(prog="benchmarks.arms", description=__doc__)
    parser.add_argument("--arms", type=int, default=20, help="how many are drawn")
    parser.add_argument("--minutes", type=float, default=8.0, help="of each of seven sessions")
    given = parser.parse_args()
    found = []
    for seed in range(given.arms):
        found.append(of_one_arm(seed, given.minutes))
        print(f"arm {seed + 1} of {given.arms}", flush=True)
    print("| estimator | protocol | RMS | SD | RMS left, mm |\n| --- | --- | ---: | ---: | ---: |")
    for name in ESTIMATORS:
        for index, protocol in enumerate(("one recording, labels", "restarts unseen, truth")):
            values = np.array([arm[name][index] for arm in found])
            low, middle, high = np.quantile(values, [0.1, 0.5, 0.9], axis=0)
            shares = [f"{middle[k]:+.1%} ({low[k]:+.1%} to {high[k]:+.1%})" for k in range(2)]
            left = f"{middle[2]:.2f} ({low[2]:.2f} to {high[2]:.2f})"
            print(f"| {name} | {protocol} | {shares[0]} | {shares[1]} | {left} |")


if __name__ == "__main__":
    run_command(main)
