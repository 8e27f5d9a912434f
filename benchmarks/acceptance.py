"""How often the acceptance test rejects good rigs, and finds a wrong scale.

    python -m benchmarks.acceptance [--rigs 200]

Rigs are made up: a body is carried to six places and stands still at each, with errors drawn from
the stated covariance of its poses, part of them the same everywhere or alike nearby, the rest
noise. Printed for each kind of error and each error of scale: in how many of the rigs nine
distances between the places contradict what the rig states (`measure accept` then exits with 3).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks.command import run_command
from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.metrology.poses import PoseTable, SharedErrors
from measure.metrology.rests import find_rests
from measure.model import Body, paper_body
from measure_lab.lengths import Acceptance, between_rests, judge

STATED = np.diag([0.02, 0.02, 0.03, *[np.deg2rad(0.035)] * 3]) ** 2
"""Of every pose: 0.041 mm and 0.06 deg, 3-D."""
RATE_HZ = 30.0
PLACES = np.array(
    [[0.0, 0, 200], [100, 0, 200], [100, 100, 200], [0, 100, 200], [0, 0, 260], [100, 100, 260]]
)
PAIRS = ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3), (0, 4), (0, 5), (4, 5))


@dataclass(frozen=True)
class Errors:
    """How errors hang together, as shares of the stated variance; the rest is noise.

    Attributes:
        everywhere: the same in all poses.
        nearby: alike where the balls have moved little.
        scale: by which every translation is longer than it is.
    """

    everywhere: float = 0.0
    nearby: float = 0.0
    scale: float = 1.0


def poses_with(
    truth: RigidTransform, errors: Errors, body: Body, rng: np.random.Generator
) -> PoseTable:
    """Poses that are off by draws from `STATED`."""
    n, root = len(truth.translation), np.linalg.cholesky(STATED)
    alone = 1.0 - errors.everywhere - errors.nearby
    off = np.sqrt(alone) * rng.normal(size=(n, 6)) + np.sqrt(errors.everywhere) * rng.normal(size=6)
    if errors.nearby:
        # Poses at rest are one place: the correlation of different places only is factored.
        places, which = np.unique(truth.matrix.reshape(n, 16), axis=0, return_inverse=True)
        alike = SharedErrors((), body).alike(RigidTransform.from_matrix(places.reshape(-1, 4, 4)))
        factor = np.linalg.cholesky(alike + 1e-9 * np.eye(len(places)))
        draws = factor @ rng.normal(size=(len(places), 6))
        off = off + np.sqrt(errors.nearby) * draws[which.reshape(-1)]
    scaled = RigidTransform(truth.rotation, errors.scale * truth.translation)
    stated = np.broadcast_to(STATED, (n, 6, 6)).copy()
    return PoseTable(np.arange(n) / RATE_HZ, scaled.perturb(off @ root.T), stated)


def with_rests(places: Floats, rest_s: float = 1.0, move_s: float = 0.4) -> RigidTransform:
    """A body carried from place to place (k, 3) in mm, that stands still at each."""
    still, moving = round(rest_s * RATE_HZ), round(move_s * RATE_HZ)
    path = [np.repeat(places[:1], still, axis=0)]
    share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, moving) / moving)[:, None]
    for start, end in pairwise(places):
        path += [start + share * (end - start), np.repeat(end[None], still, axis=0)]
    points = np.concatenate(path)
    return RigidTransform(np.broadcast_to(np.eye(3), (len(points), 3, 3)), points)


def accepted(errors: Errors, rng: np.random.Generator) -> Acceptance:
    """The acceptance test of one rig."""
    body = paper_body()
    poses = poses_with(with_rests(PLACES, 0.7, 0.3), errors, body, rng)
    measured = between_rests(find_rests(poses, SharedErrors((), body)), PAIRS)
    known = np.array([float(np.linalg.norm(PLACES[b] - PLACES[a])) for a, b in PAIRS])
    names = [f"{a} - {b}" for a, b in PAIRS]
    return judge(names, measured, known, np.zeros(len(known)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.acceptance", description=__doc__)
    parser.add_argument("--rigs", type=int, default=200, help="of each kind")
    rigs = parser.parse_args().rigs
    print("same everywhere  alike nearby  scale error   rejected of", rigs)
    for everywhere, nearby in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.0, 0.9)):
        for scale in (1.0, 1.001, 1.003, 1.01):
            rng = np.random.default_rng(1)
            errors = Errors(everywhere, nearby, scale)
            count = sum(bool(accepted(errors, rng).contradictions) for _ in range(rigs))
            print(
                f"{everywhere:15.1f}{nearby:14.1f}{100 * (scale - 1):11.1f} %{count:13}", flush=True
            )


if __name__ == "__main__":
    run_command(main)
