"""Simulated arms whose constants are drawn: `python -m benchmarks.arms [--arms N]`.

Every constant of `Cables` that is an assumption is drawn for each arm. The arm also has hysteresis
that no estimator contains (Maxwell slip that creeps), drift within a session, and cameras with a
bias in their labels. Each estimator is judged twice: by the paper's own protocol (one recording, a
tenth of its trajectories held out, measured labels) and as in use (other restarts, the true tip).
Printed are medians over the arms, and the 10 and 90 % quantiles.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import run_command
from measure.arrays import Floats
from measure.host import Dataset, Estimator, Registry, quiet
from measure_learning.core import AssemblySettings, LabelKind, evaluate, files, simulated_dataset
from measure_learning.simulator import Cables, Slip

ESTIMATORS: dict[str, dict[str, Any]] = {
    "offset": {},
    "mlp": {},
    "ridge": {},
    "gp": {"points": 600, "tuning_points": 150},
}
PROTOCOLS = "one recording, labels", "others unseen"
_PAIRS_PER_MIN = 353.0  # of the paper: 49 407 in 140 minutes
_CUT = AssemblySettings(cut_s=20.0)
_SPREAD = 0.35  # SD of the logarithm of a constant: a factor of 1.4
_PAYLOAD_KG = 0.1  # the most that is carried, in sessions that are not learnt from
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
        labels=LabelKind(exact), settings=_CUT,
    )[0]  # fmt: skip


def _biased(data: Dataset, bias: Floats) -> Dataset:
    """Labels with the cameras' own error, linear in the position."""
    apart = (data.reported_mm - data.reported_mm.mean(axis=0)) / 50.0
    return replace(data, errors_mm=data.errors_mm + apart @ bias)


def _changes(train: Dataset, validation: Dataset, test: Dataset) -> dict[str, list[float]]:
    """By estimator: changes of RMS and SD on a test, and what is left, mm."""
    found = {}
    for name, settings in ESTIMATORS.items():
        estimator = Registry.discover().build(Estimator, name, settings)
        estimator.folds = 0
        estimator.fit(train, validation, seed=0, report=quiet)
        scores = evaluate(test, estimator.model.predict(test))  # type: ignore[attr-defined]
        found[name] = [scores.rms_change, scores.sd_change, scores.after.rms_mm]
    return found


def of_one_arm(seed: int, minutes: float) -> list[dict[str, list[float]]]:
    """`_changes` by either protocol."""
    cables, dice = drawn_arm(seed), np.random.default_rng(1000 + seed)
    bias = dice.normal(0.0, _BIAS_MM, (3, 3))
    known = _biased(_sessions(cables, 10 * seed + 1, 4, minutes, exact=False), bias)
    loaded = replace(cables, payload_kg=float(dice.uniform(0.0, _PAYLOAD_KG)))
    later = _sessions(loaded, 10 * seed + 5, 3, minutes, exact=True)
    recordings = known.recordings()
    *learnt, last = recordings
    one = known.select(recordings[learnt[0]])
    order = dice.permutation(one.present()).tolist()
    tenth = max(1, len(order) // 10)
    held, chosen, rest = order[:tenth], order[tenth : 2 * tenth], order[2 * tenth :]
    several = [name for recording in learnt for name in recordings[recording]]
    return [
        _changes(one.select(rest), one.select(chosen), one.select(held)),
        _changes(known.select(several), known.select(recordings[last]), later),
    ]


def of_a_real_arm(folder: Path) -> list[list[dict[str, list[float]]]]:
    """`_changes` by either protocol, of every recording whose end is there."""
    known, ends = (files.read_dataset(folder / f"{part}.parquet") for part in ("train", "val"))
    found = []
    for name in (n for n in known.names if f"{n}_end" in ends.names):
        one, end = known.select([name]), ends.select([f"{name}_end"])
        late = np.arange(len(one)) > 0.9 * len(one)
        chosen = replace(one.rows(late), names=tuple(f"{n}/late" for n in one.names))
        others = [n for n in known.names if n != name]
        judges = [n for n in ends.names if n != f"{name}_end"]
        unseen = known.select(others), ends.select(judges), one
        found.append([_changes(one.rows(~late), chosen, end), _changes(*unseen)])
    return found


def rows(arm: str, found: Sequence[list[dict[str, list[float]]]]) -> list[str]:
    """Of the table: medians, and the 10 and 90 % quantiles."""
    lines = []
    for name in ESTIMATORS:
        for index, protocol in enumerate(PROTOCOLS):
            values = np.array([one[index][name] for one in found])
            low, middle, high = np.quantile(values, [0.1, 0.5, 0.9], axis=0)
            shares = [f"{middle[k]:+.1%} ({low[k]:+.1%} to {high[k]:+.1%})" for k in range(2)]
            left = f"{middle[2]:.2f} ({low[2]:.2f} to {high[2]:.2f})"
            lines.append(f"| {arm} | {name} | {protocol} | {shares[0]} | {shares[1]} | {left} |")
    return lines


def main() -> None:
    """Draw, train, print."""
    parser = argparse.ArgumentParser(prog="benchmarks.arms", description=__doc__)
    parser.add_argument("--arms", type=int, default=20, help="how many are drawn")
    parser.add_argument("--minutes", type=float, default=3.0, help="of each of seven sessions")
    parser.add_argument("--real", type=Path, help="folder with the data sets of a real arm")
    given = parser.parse_args()
    head = ("arm", "estimator", "protocol", "RMS", "SD", "RMS left, mm")
    lines = [f"| {' | '.join(head)} |", "| --- | --- | --- | ---: | ---: | ---: |"]
    if given.real is not None:
        lines += rows("real", of_a_real_arm(given.real))
    found = []
    for seed in range(given.arms):
        found.append(of_one_arm(seed, given.minutes))
        print(f"arm {seed + 1} of {given.arms}", flush=True)
    print("\n".join([*lines, *rows("drawn", found)]))


if __name__ == "__main__":
    run_command(main)
