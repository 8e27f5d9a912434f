"""Errors of a body's position by the calibration alone, on a capture with exact truth.

    python -m benchmarks.calibration CAPTURE TRUTH [--draws 20] [--captures 8]

CAPTURE is a capture folder with marks.csv, TRUTH the calibration of its true cameras. True ball
centres are seen through the true cameras and located with the estimated ones, over 200 poses in a
box of +-50, +-50, +-30 mm round the workspace's middle, turned by up to 60 degrees. Compared are
plain OpenCV (calibrateCamera and solvePnP on the marks), the paper's method, the joint fit with the
marks by hand, and with markers found in the pictures; then the first three again over redraws of
0.3 px of mark noise about the true places; then hand marks against found markers over simulated
captures, each with its own lenses, boards, lamps and noise.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from benchmarks.errors import body_cost
from measure.calibration import Capture, calibrate_capture, open_capture
from measure.calibration.extrinsics import fit_rig_with_boards
from measure.calibration.procedure import RigCalibration
from measure.geometry import RigidTransform
from measure.model import (
    Camera,
    Intrinsics,
    MarkerObservation,
    RigObservations,
    Tolerances,
    paper_body,
)
from measure.session import read_calibration
from measure_paper.camera_fit import fit_rig_by_paper
from tests.simulated.capture import CaptureScene, write_capture

BODY = paper_body()
NOISE_PX = 0.3
Poses = list[RigidTransform]


def poses(middle: np.ndarray) -> Poses:
    """Poses of the body, world_from_body."""
    rng = np.random.default_rng(1)
    out = []
    for _ in range(200):
        axis = rng.normal(size=3)
        turn = np.deg2rad(rng.uniform(0, 60)) * axis / np.linalg.norm(axis)
        out.append(RigidTransform.from_rotvec(turn, middle + rng.uniform(-1, 1, 3) * [50, 50, 30]))
    return out


def plain_opencv(rig: RigCalibration, observations: RigObservations) -> tuple[Camera, ...]:
    """`calibrateCamera` on the same views, `solvePnP` on the marks."""
    out = []
    for camera in rig.cameras:
        lens = rig.lenses[camera.name]
        assert rig.observations.boards
        board = next(iter(rig.observations.boards.values())).points.astype(np.float32)
        views = lens.views.views
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            [board[v.ids] for v in views],
            [v.pixels.astype(np.float32) for v in views],
            lens.views.size_wh,
            None,
            None,
        )
        marks = observations.marks[camera.name]
        _, turn, shift = cv2.solvePnP(
            observations.markers[marks.ids], marks.pixels, matrix, distortion
        )
        pose = RigidTransform.from_rotvec(turn.ravel(), shift.ravel()).inverse()
        intrinsics = Intrinsics(
            lens.views.size_wh,
            np.asarray(matrix, dtype=np.float64),
            np.asarray(distortion, dtype=np.float64),
        )
        out.append(Camera(camera.name, intrinsics, pose))
    return tuple(out)


def cost(found: tuple[Camera, ...], true: tuple[Camera, ...], at: Poses) -> float:
    """Body position error, 3-D RMS in mm."""
    shifts = body_cost(found, true, BODY, at)
    return float(np.sqrt(np.mean(np.sum(shifts**2, axis=1))))


def redrawn(observations: RigObservations, true: tuple[Camera, ...], seed: int) -> RigObservations:
    """The sights with marks at their true places plus fresh noise."""
    rng = np.random.default_rng(seed)
    marks = {}
    for camera in true:
        ids = observations.marks[camera.name].ids
        pixels = camera.project(observations.markers[ids])
        marks[camera.name] = MarkerObservation(ids, pixels + rng.normal(0, NOISE_PX, pixels.shape))
    return replace(observations, marks=marks)


def print_cameras(name: str, found: tuple[Camera, ...], true: tuple[Camera, ...]) -> None:
    """Each camera against the truth."""
    for camera, exact in zip(found, true, strict=True):
        error = exact.world_from_camera.difference(camera.world_from_camera)
        focal = (camera.intrinsics.vector - exact.intrinsics.vector)[:2]
        nees = ""
        if camera.pose_covariance is not None:
            value = error @ np.linalg.solve(camera.pose_covariance, error) / 6
            nees = f"  normalised squared error {value:.2f}"
        print(
            f"  {name:8} {camera.name}: {np.linalg.norm(error[:3]):.3f} mm, "
            f"{np.rad2deg(np.linalg.norm(error[3:])):.4f} deg, "
            f"f {focal[0]:+.2f} {focal[1]:+.2f} px{nees}"
        )


def mark_errors(observations: RigObservations, true: tuple[Camera, ...]) -> list[np.ndarray]:
    """Marks less the true places of their markers, by camera (n, 2) px."""
    marks = [(camera, observations.marks[camera.name]) for camera in true]
    return [seen.pixels - camera.project(observations.markers[seen.ids]) for camera, seen in marks]


def in_pictures(capture: Capture, lenses: dict[str, Intrinsics]) -> Capture:
    """The capture without its hand marks, its lenses taken as calibrated."""
    return replace(capture, lenses=lenses, marks={})


def normalised(found: tuple[Camera, ...], true: tuple[Camera, ...]) -> float:
    """Squared pose error in units of its covariance, per degree of freedom: about 1 if honest."""
    values = []
    for camera, exact in zip(found, true, strict=True):
        error = exact.world_from_camera.difference(camera.world_from_camera)
        assert camera.pose_covariance is not None
        values.append(error @ np.linalg.solve(camera.pose_covariance, error) / 6)
    return float(np.mean(values))


def simulated(seed: int, at: Poses) -> list[list[float]]:
    """Cost of the body, error of the marks and normalised error, by hand and found."""
    with TemporaryDirectory() as folder:
        capture = open_capture(write_capture(CaptureScene(seed=seed), folder))
        true = read_calibration(Path(folder) / "truth_calibration.toml").cameras
        by_hand = calibrate_capture(capture)
        lenses = {name: lens.intrinsics for name, lens in by_hand.lenses.items()}
        found = calibrate_capture(in_pictures(capture, lenses))
    return [
        [
            cost(rig.cameras, true, at),
            float(np.sqrt(np.mean(np.concatenate(mark_errors(rig.observations, true)) ** 2))),
            normalised(rig.cameras, true),
        ]
        for rig in (by_hand, found)
    ]


def print_simulated(count: int, at: Poses) -> None:
    """Hand marks against found markers over simulated captures."""
    if not count:
        return
    rows = np.array([simulated(seed, at) for seed in range(count)])
    for number, name in enumerate(("by hand", "found")):
        body, px = np.sqrt(np.mean(rows[:, number, :2] ** 2, axis=0))
        print(
            f"{count} simulated captures, {name}: body {body:.4f} mm, marks {px:.3f} px per axis, "
            f"normalised squared error {rows[:, number, 2].mean():.2f}"
        )
    wins = int(np.sum(rows[:, 1, 0] < rows[:, 0, 0]))
    print(f"found costs the body less than by hand in {wins} of {count}")


def print_methods(rows: dict[str, tuple[Camera, ...]], true: tuple[Camera, ...], at: Poses) -> None:
    """Print the body's error by each method's cameras, and the cameras' errors."""
    for name, cameras in rows.items():
        print(f"{name:8} body position error {cost(cameras, true, at):.4f} mm RMS")
        print_cameras(name, cameras, true)


def print_marks(by_hand: RigCalibration, found: RigCalibration, true: tuple[Camera, ...]) -> None:
    """Print the errors of the marks."""
    hand, offsets = mark_errors(by_hand.observations, true), mark_errors(found.observations, true)
    print(
        f"marks: by hand {np.sqrt(np.mean(np.concatenate(hand) ** 2)):.3f} px, found "
        f"{np.sqrt(np.mean(np.concatenate(offsets) ** 2)):.3f} px per axis "
        f"({sum(map(len, offsets))} found)"
    )


def redraws(
    by_hand: RigCalibration, tolerance_mm: float, true: tuple[Camera, ...], at: Poses, count: int
) -> np.ndarray:
    """Cost (count, 3) of OpenCV, the paper's method and the joint fit with fresh mark noise."""
    start, base = by_hand.cameras_before, by_hand.observations
    base = replace(base, tolerances=Tolerances(tolerance_mm))
    rows = []
    for seed in range(count):
        observations = redrawn(base, true, seed)
        joint, _ = fit_rig_with_boards(start, observations)
        by_paper = fit_rig_by_paper(start, observations).cameras
        cameras = (plain_opencv(by_hand, observations), by_paper, joint.cameras)
        rows.append([cost(c, true, at) for c in cameras])
    return np.array(rows)


def print_redraws(draws: np.ndarray, found_mm: float) -> None:
    """Their RMS, the joint fit against OpenCV, and found markers against the joint fit's draws."""
    rms = np.sqrt(np.mean(draws**2, axis=0))
    worst = np.max(draws[:, 2] / draws[:, 0])
    print(
        f"{len(draws)} redraws: opencv {rms[0]:.4f}, paper {rms[1]:.4f}, joint {rms[2]:.4f} mm\n"
        f"joint / opencv: {rms[2] / rms[0]:.2f} (worst single draw {worst:.2f})\n"
        f"found / joint: {found_mm / rms[2]:.2f}; found costs the body less than by hand in "
        f"{np.sum(found_mm < draws[:, 2])} of {len(draws)}"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture")
    parser.add_argument("truth")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--captures", type=int, default=0)
    options = parser.parse_args()
    capture, true = open_capture(options.capture), read_calibration(options.truth).cameras
    by_hand = calibrate_capture(capture)
    lenses = {name: lens.intrinsics for name, lens in by_hand.lenses.items()}
    found = calibrate_capture(in_pictures(capture, lenses))
    at = poses(np.array([0.0, 0.0, 250.0]))
    rows = {
        "opencv": plain_opencv(by_hand, by_hand.observations),
        "paper": fit_rig_by_paper(by_hand.cameras_before, by_hand.observations).cameras,
        "joint": by_hand.cameras,
        "found": found.cameras,
    }
    print_methods(rows, true, at)
    print_marks(by_hand, found, true)
    draws = redraws(by_hand, capture.markers.tolerance_mm, true, at, options.draws)
    print_redraws(draws, cost(found.cameras, true, at))
    print_simulated(options.captures, at)


if __name__ == "__main__":
    main()
