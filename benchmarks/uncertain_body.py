"""Pose errors by balls that are off, where the body file states their tolerance.

    python -m benchmarks.uncertain_body SESSION [--draws 6]

SESSION is a recording with truth whose body file is exact. Its balls are shifted at random (1 sd
per axis), and the recording is measured with the body file that results, which states the
tolerance or does not. Printed for each, over all draws, is what `uncertain_cameras` prints; and how
far the distances between the balls are off (RMS), in that file and after the body has
been refined from the recording.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import truth_of
from benchmarks.uncertain_cameras import cells, judged
from measure.api import load_profile, measure_session
from measure.arrays import Floats
from measure.calibration import refine_measured
from measure.errors import CalibrationError
from measure.host import Registry
from measure.measuring import Measurement
from measure.model import Body, Camera
from measure.session import open_session, write_body

LEVELS_MM = (0.1, 0.2, 0.4)
HEADER = (
    "balls off by          position  stated   rotation  stated   95 % region  of all six  flagged"
    "   distances  refined\n"
    "    mm                      mm      mm        deg     deg             %           %        %"
    "          mm       mm"
)


def distance_errors(body: Body, true: Body) -> Floats:
    """How far the distances between the balls are off, mm."""
    exact = true.distances()
    return np.array([mm - exact[pair] for pair, mm in body.distances().items()])


def figures(
    session: Path, sd_mm: float, tolerance_mm: float, draws: int, registry: Registry
) -> tuple[Floats, float, float]:
    """Means (7,) of `judged`, and RMS errors of the distances before and after refining, mm."""
    truth = truth_of(session)
    with open_session(session) as exact:
        true = exact.body
    rows, before, after = [], [], []
    with TemporaryDirectory() as folder:
        for seed in range(draws):
            shifts = np.random.default_rng(seed).normal(0, sd_mm, true.centers.shape)
            body = replace(true.with_centers(true.centers + shifts), tolerance_mm=tolerance_mm)
            file = Path(folder) / "body.toml"
            write_body(file, body)
            with open_session(session, body=file) as opened:
                found = measure_session(opened, load_profile("precise"), registry)
                measured = [one for _, one in found]
                rows += [judged(one, truth) for one in measured]
                before.append(distance_errors(body, true))
                after.append(_refined(opened.cameras, body, measured, true))
    rms = [float(np.sqrt(np.mean(np.square(errors)))) for errors in (before, after)]
    return np.mean(rows, axis=0), *rms


def _refined(
    cameras: Sequence[Camera], body: Body, measured: Sequence[Measurement], true: Body
) -> Floats:
    """The same of the refined body; NaN if the recording does not determine it."""
    try:
        refined = refine_measured(tuple(cameras), body, measured).refinement
    except CalibrationError:
        return np.full(len(true.distances()), np.nan)
    return distance_errors(body.with_centers(refined.centers), true)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.uncertain_body", description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--draws", type=int, default=6, help="of the balls, at each level")
    given = parser.parse_args()
    registry = Registry.discover()
    print(HEADER)
    for sd_mm in LEVELS_MM:
        for tolerance_mm, words in ((0.0, "unsaid"), (sd_mm, "stated")):
            found, *off = figures(given.session, sd_mm, tolerance_mm, given.draws, registry)
            row = f"{sd_mm:6.2f}  {words}    {cells(found)}{off[0]:12.3f}{off[1]:9.3f}"
            print(row, flush=True)


if __name__ == "__main__":
    run_command(main)
