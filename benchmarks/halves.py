"""Do halves of a capture differ by as much as their covariances say?

    python -m benchmarks.halves CAPTURE [--splits 20] [--one-by-one]

A capture of common views is split at random into halves of its instants, and both are calibrated.
Printed are, of each camera's lens, the mean of d^T (P + Q)^-1 d / n, with d the difference of its n
parameters and P and Q their covariances (1 is honest, more is too little stated); and of a body's
positions over the workspace the difference after the rigid motion that fits best, RMS, and what the
two halves state of it. Errors that both halves share do not show. With --one-by-one covariances are
those of corners that err independently of each other, as they were without clusters of views.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.errors import aligned_rms, body_cost
from measure.arrays import rms_length
from measure.calibration import Board, calibrate_capture, open_capture
from measure.calibration.board_views import fit_lens, start_intrinsics
from measure.calibration.common_views import fit_common_views, instant_of
from measure.calibration.findings import workspace_of
from measure.calibration.intrinsics import LensCalibration
from measure.errors import CalibrationError
from measure.estimation.expected_accuracy import body_pose_sd
from measure.estimation.least_squares import LeastSquaresSolution
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, paper_body

Lenses = Mapping[str, LensCalibration]


def half(board: Board, whole: Lenses, chosen: set[int]) -> tuple[Camera, ...]:
    """The cameras by some instants, with lenses as free as those of the whole capture."""
    lenses = {}
    for name, lens in whole.items():
        views = tuple(v for v in lens.views.views if instant_of(v.source) in chosen)
        start = start_intrinsics(lens.views.size_wh, board.points, views, lens.model.projection)
        fit = fit_lens(start, board.points, views, lens.model)
        lenses[name] = replace(lens, fit=fit, views=replace(lens.views, views=views))
    return fit_common_views(board, lenses)[0]


def normalised(one: Intrinsics, other: Intrinsics) -> float:
    """Squared difference of two lenses over its covariance, by parameter."""
    off = one.vector - other.vector
    assert one.covariance is not None
    assert other.covariance is not None
    P = one.covariance + other.covariance
    free = np.flatnonzero(np.diag(P) > 0)
    return float(off[free] @ np.linalg.solve(P[np.ix_(free, free)], off[free]) / len(free))


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="benchmarks.halves", description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--splits", type=int, default=20)
    parser.add_argument("--one-by-one", action="store_true")
    given = parser.parse_args()
    with ExitStack() as changed:
        if given.one_by_one:
            changed.enter_context(patch.object(LeastSquaresSolution, "clustered_factor", 0.0))
        compare(given.capture, given.splits)


def compare(folder: Path, splits: int) -> None:
    """Split a capture, calibrate and print.

    Raises:
        CalibrationError: the capture has no common views.
    """
    capture = open_capture(folder)
    if capture.board is None or not capture.settings.common_views:
        raise CalibrationError(f"{folder}: take a capture with common_views")
    whole = calibrate_capture(capture)
    space, body = workspace_of(whole.cameras, whole.around), paper_body()
    poses = [RigidTransform(np.eye(3), place) for place in space.grid()]
    at = np.stack([pose.translation for pose in poses])
    seen = [view.source for lens in whole.lenses.values() for view in lens.views.views]
    instants = sorted({instant_of(source) for source in seen})
    rng, lenses, apart, stated = np.random.default_rng(0), [], [], []
    for _ in range(splits):
        mixed = rng.permutation(instants)
        parts = mixed[: len(mixed) // 2], mixed[len(mixed) // 2 :]
        one, other = (half(capture.board, whole.lenses, {*part.tolist()}) for part in parts)
        pairs = zip(one, other, strict=True)
        lenses.append([normalised(a.intrinsics, b.intrinsics) for a, b in pairs])
        off = body_cost(one, other, body, poses)
        apart.append(aligned_rms(at, off))
        sds = [body_pose_sd(cameras, body, poses)[0] for cameras in (one, other)]
        stated.append(rms_length(np.stack(sds, axis=1)))
    for camera, squares in zip(whole.cameras, np.mean(lenses, axis=0), strict=True):
        print(f"{camera.name}: lens {squares:.2f}")
    found, said = (np.sqrt(np.mean(np.square(one))) for one in (apart, stated))
    print(f"positions differ by {found:.3f} mm, {said:.3f} mm are stated")


if __name__ == "__main__":
    main()
