"""Who learns what of a stiff arm with play: `python -m benchmarks.stiff_arm`.

A simulated UR5e whose links are off by 0.5 mm and 0.05 deg (SD) and whose gears have play. Six
recordings of 90 s, homed a little differently each, are seen 15 times a second in the base's frame
with 0.05 mm of noise; three others are judged by the true tip, and three that move half as far
again. Printed of each estimator: what it leaves of both in mm RMS, and how large that is relative
to the covariance that it states.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.command import run_command
from benchmarks.registration import HOME_DEG, SWING_DEG, schema, ur5e
from measure.host import Dataset, Estimator, Registry, discover
from measure.host.interfaces import quiet
from measure.robots import SerialChain
from measure_learning.core import evaluate, join

PLAY_DEG = np.array([0.03, 0.03, 0.03, 0.06, 0.06, 0.06])
"""Half-widths of the joints' play."""
HOMED_DEG = 0.01
"""Standard deviation of a joint's zero from one recording to the next."""
_LOG_HZ, _EVERY, _NOISE_MM = 120.0, 8, 0.05
SMALL = {"grus": 1, "gru_epochs": 40, "perceptrons": 2, "perceptron_epochs": 30}
"""Settings of `stream`, which is trained in a minute with them."""
ESTIMATORS = ("kinematic", "ridge", "ridge after kinematic", "stream", "stream after kinematic")


def recording(
    seed: int, true: SerialChain, seconds: float = 90.0, noise: float = 0.0, swing: float = 1.0
) -> Dataset:
    """What cameras with `noise` mm measure of an arm whose controller believes it as published.

    Args:
        swing: factor on how far the joints move.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 1 / _LOG_HZ)
    q = np.tile(np.deg2rad(HOME_DEG), (len(times), 1))
    for _ in range(4):
        turn, phase = rng.uniform(0.3, 2.8, 6), rng.uniform(0, 2 * np.pi, 6)
        size = swing * np.deg2rad(SWING_DEG) * rng.uniform(0.3, 0.7, 6)
        q += size * np.sin(turn * times[:, None] + phase)
    driven, slack = q.copy(), np.deg2rad(PLAY_DEG)
    for row in range(1, len(q)):
        driven[row] = np.clip(driven[row - 1], q[row] - slack, q[row] + slack)
    driven += np.deg2rad(HOMED_DEG) * rng.normal(size=6)
    q, driven, times = q[::_EVERY], driven[::_EVERY], times[::_EVERY]
    known, rows = ur5e(), len(times)
    errors = true.tip_mm(driven) - known.tip_mm(q) + noise * rng.normal(size=(rows, 3))
    return Dataset(
        schema=schema(known),
        states=np.concatenate([q, known.tip_mm(q)], axis=1),
        times_s=times,
        trajectory=np.zeros(rows, dtype=np.int64),
        names=(f"day{seed}/0",),
        errors_mm=errors,
        covariances=np.tile(noise**2 * np.eye(3), (rows, 1, 1)),
        usable=np.ones(rows, dtype=bool),
    )


def main() -> None:
    """Train each, and print what it leaves of recordings that it has not seen."""
    parser = argparse.ArgumentParser(prog="benchmarks.stiff_arm", description=__doc__)
    parser.add_argument("--only", default="", help="estimators whose name contains this")
    given = parser.parse_args()
    true, registry = ur5e(mm=0.5, deg=0.05, seed=4), Registry(discover())
    data = [recording(seed, true, noise=_NOISE_MM) for seed in range(6)]
    tests = [join([recording(s, true, swing=swing) for s in range(6, 9)]) for swing in (1.0, 1.5)]
    for name in ESTIMATORS:
        if given.only in name:
            estimator = registry.build(Estimator, name, SMALL if name.startswith("stream") else {})
            estimator.folds = 2
            estimator.fit(join(data[:5]), data[5], seed=0, report=quiet)
            model = estimator.model  # type: ignore[attr-defined]
            found = [evaluate(test, model.predict(test)) for test in tests]
            sizes = (f"{f.before.rms_mm:.3f} -> {f.after.rms_mm:.3f} mm" for f in found)
            ratios = " and ".join(f"{f.consistency**0.5:.2f}" for f in found)
            print(f"{name:24} {'; farther '.join(sizes)}; {ratios} x stated", flush=True)


if __name__ == "__main__":
    run_command(main)
