"""How far errors of poses stay alike as a body moves.

    python -m benchmarks.alike RUN [RUN ...]

Each RUN is a run of a recording whose calibration and body file are exact, with truth: what is left
is light on the balls, and noise. Errors are divided by what the run states of them; printed is the
correlation of pairs of poses of a run, by how far the balls have moved from one to the other (RMS).
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import truth_of
from measure.arrays import Floats
from measure.errors import RunError
from measure.metrology.poses import ALIKE_OVER_MM
from measure.results import read_run
from measure.results.pose_table import poses_of, shared_errors

EDGES_MM = (0.0, 3.0, 6.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 100.0)


def pairs_of(folder: Path) -> Floats:
    """Rows (n, 5) of pairs of poses: mm apart; products and squares of errors, then of turns."""
    run = read_run(folder)
    if run.session is None:
        raise RunError(f"{folder}: its recording is gone, and the truth with it")
    poses = poses_of(run)
    off = poses.world_from_body.difference(truth_of(run.session).at(poses.times_s))
    alike = shared_errors(run).alike(poses.world_from_body)
    first, second = np.triu_indices(len(poses), 1)
    columns = [-ALIKE_OVER_MM * np.log(alike[first, second])]
    for part in (slice(0, 3), slice(3, 6)):
        roots = np.linalg.cholesky(poses.covariances[:, part, part])
        white = np.linalg.solve(roots, off[:, part, None])[..., 0]
        products = white @ white.T
        squares = np.diag(products)
        columns += [products[first, second], (squares[first] + squares[second]) / 2]
    return np.column_stack(columns)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.alike", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    pairs = np.concatenate([pairs_of(run) for run in parser.parse_args().runs])
    print("balls moved by    pairs  position  rotation   (correlation of the errors)")
    for low, high in pairwise(EDGES_MM):
        here = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high)]
        if len(here):
            sums = here.sum(axis=0)
            cells = f"{sums[1] / sums[2]:10.2f}{sums[3] / sums[4]:10.2f}"
            print(f"{low:5.0f} to {high:3.0f} mm {len(here):8}{cells}")


if __name__ == "__main__":
    run_command(main)
