"""Whether cameras located by the waved body err as much as their covariance states.

    python -m benchmarks.by_body [--draws 30] [--frames 90] [--open]

Four cameras, asynchronous, see a body wander; each draw has its own noise of single sightings, its
own constant shift of each ball in each camera, and places of the balls that are off by the body's
tolerance. The cameras start some millimetres off. Counted are the draws in which the error of the
rig's shape (all poses, and with `--open` lenses of which nothing is known) lies within the 95 %
region of the stated covariance; beside it the mean normalised squared error (1 is right), and the
RMS error of the body's position once the recording is laid onto the truth. Without pictures: of
what pictures err by, `cameras by the waved body` among the tests says more.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from benchmarks.command import run_command
from measure.arrays import Floats
from measure.calibration.by_body.adjustment import loose_prior, shape_of
from measure.calibration.by_body.lenses import with_lens_kind
from measure.calibration.common_views import shape_errors
from measure.calibration.refining.procedure import compare_halves
from measure.calibration.refining.recording import ball_places
from measure.calibration.refining.refine import refine_rig
from tests.calibration.refining.cases import BODY, Case, case, errors

SLIP = np.repeat([3.0, 0.006], 3)  # mm and rad, of cameras as single pictures place them
_WORLD = 7  # Place, turn and scale of the world, which are no part of the shape


def shape_error(given: Case, lenses_open: bool) -> tuple[float, int, float]:
    """Squared Mahalanobis distance of the shape's error, its dimensions, and mm of the body."""
    start = given.start
    if lenses_open:
        start = tuple(with_lens_kind(camera, ()) for camera in start)
    prior = loose_prior(start)
    halves = compare_halves(start, BODY, given.recording, None, prior)
    refinement = refine_rig(start, BODY, given.recording, None, prior, halves.variance_factor)
    shape = shape_of(refinement, BODY, given.recording)
    world = shape.cameras[0].world_from_camera @ given.true[0].camera_from_world
    free = [camera.intrinsics.free for camera in shape.cameras]
    off = np.concatenate([
        found.difference(
            replace(true, world_from_camera=world @ true.world_from_camera)
        )[found.free]
        for found, true in zip(shape.cameras, given.true, strict=True)
    ])  # fmt: skip
    points = ball_places(given.recording.world_from_body, BODY.centers)
    onto_shape, _, _ = shape_errors(shape.cameras, free, points, with_scale=True)
    scale = 1 / np.sqrt(np.diag(shape.joint))
    variances, axes = np.linalg.eigh(shape.joint * np.outer(scale, scale))
    known = slice(_WORLD, None)
    along = axes[:, known].T @ (scale * (onto_shape @ off))
    squares: Floats = along**2 / variances[known]
    return float(squares.sum()), len(squares), errors(shape.cameras, given)[1]


def main() -> None:
    """Print the coverage."""
    parser = argparse.ArgumentParser(prog="benchmarks.by_body", description=__doc__)
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--open", action="store_true", help="nothing is known of the lenses")
    options = parser.parse_args()
    inside, squares, off_mm = 0, list[float](), list[float]()
    for seed in range(options.draws):
        given = case(seed, options.frames, slip=SLIP, stated=False)
        square, dimensions, mm = shape_error(given, options.open)
        inside += square < chi2.ppf(0.95, dimensions)
        squares.append(square / dimensions)
        off_mm.append(mm)
        print(f"{seed:3}: {square / dimensions:.2f} of {dimensions}, {mm:.4f} mm", flush=True)
    print(
        f"within the 95 % region: {inside} of {options.draws}; mean normalised squared error "
        f"{np.mean(squares):.2f}; body off by {np.sqrt(np.mean(np.square(off_mm))):.4f} mm"
    )


if __name__ == "__main__":
    run_command(main)
