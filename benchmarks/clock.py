"""Whether a clock offset's stated uncertainty holds: `python -m benchmarks.clock [--draws 30]`.

Simulated recordings of 60 s, 15 poses a second, 0.1 mm of noise per axis, on a clock 1.5 s behind.
A tip on slack or soft cables follows its motors late, which looks like another offset. So cables
are drawn, too: wear, stiffness of all, and damping between a half and twice the usual. Printed for
the usual robot, drawn cables and a nearly rigid robot, in ms: the offset's error (mean, SD), what
is stated, and in how many draws the error is inside 95 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.command import run_command
from measure_learning.core import estimate_offset
from measure_learning.core.simulated import recording
from measure_learning.simulator import Cables, simulate

OFFSET_S = 1.5
NOTHING = (0.0,) * 7


def usual(_: np.random.Generator) -> Cables:
    """The robot of the package."""
    return Cables()


def drawn(rng: np.random.Generator) -> Cables:
    """One with other cables."""
    wear, stiff, damp = 2.0 ** rng.uniform(-1, 1, 3)
    stiffness = tuple(stiff * value for value in Cables.stiffness)
    return Cables(wear=wear, stiffness=stiffness, damping=damp * Cables.damping)


def rigid(_: np.random.Generator) -> Cables:
    """One whose cables are a hundred times as stiff, without slack and friction."""
    return replace(
        Cables(),
        stiffness=tuple(100.0 * value for value in Cables.stiffness),
        inertia=tuple(10.0 * value for value in Cables.inertia),
        backlash=NOTHING,
        friction=NOTHING,
    )


def main() -> None:
    """Print a line for every kind of robot."""
    parser = argparse.ArgumentParser(prog="benchmarks.clock", description=__doc__)
    parser.add_argument("--draws", type=int, default=30)
    count = parser.parse_args().draws
    print("cables   error: mean    SD   largest   stated SD   error over SD, RMS   inside 95 %")
    kinds: tuple[Callable[[np.random.Generator], Cables], ...] = (usual, drawn, rigid)
    for kind in kinds:
        found = np.array([one(kind, seed) for seed in range(200, 200 + count)])
        error, sd = 1e3 * found.T
        inside = int((np.abs(error) < 1.96 * sd).sum())
        size = float(np.sqrt(((error / sd) ** 2).mean()))
        print(
            f"{kind.__name__:8} {error.mean():11.2f} {error.std(ddof=1):5.2f} "
            f"{np.abs(error).max():9.2f} {sd.mean():11.2f} {size:20.2f} {inside:7d} of {count}"
        )


def one(kind: Callable[[np.random.Generator], Cables], seed: int) -> tuple[float, float]:
    """Error and stated SD of the offset of one recording, in s."""
    run = simulate(60.0, seed, log_hz=50.0, cables=kind(np.random.default_rng(seed)))
    track, log = recording(run, "one", seed, frame_hz=15.0, clock_offset_s=OFFSET_S)
    place = log.schema.position_mm(log.states)
    found = estimate_offset(track.times_s, track.positions_mm, log.times_s, place)
    return found.offset_s - OFFSET_S, found.sd_s


if __name__ == "__main__":
    run_command(main)
