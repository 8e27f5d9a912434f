"""Fisheye cameras against pinholes of the same px per degree: `python -m benchmarks.fisheye`.

Four cameras 120 degrees wide, and four pinholes of their focal length, stand in the same places;
once both look at the workspace, once the fisheyes are turned aside by 40 degrees, further than the
pinholes' pictures reach. Each rig is calibrated from rendered pictures of a board and markers, and
measures a rendered body with that calibration. Printed are the RMS errors of position and rotation,
the share of 95 % regions that hold the true position, and the frame sets without a pose.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import in_region, pose_error, truth_of
from benchmarks.off_axis import turned
from measure.api import calibrate, load_profile, measure_session
from measure.host import Registry
from measure.model import Camera, Intrinsics
from measure.session import open_session, write_calibration
from measure.simulation import write_session
from measure.simulation.catalogue import plain_scene
from tests.simulated.capture import CaptureScene, write_capture

SIZE_WH, WIDE_DEG = (1280, 720), 120.0
BENT = [-0.03, 0.006, -0.002, 0.0003]
BARREL = [-0.05, 0.01, 0.0008, -0.0006]


def rigs() -> dict[str, tuple[Camera, ...]]:
    """The cameras by name of the rig."""
    focal = SIZE_WH[0] / np.radians(WIDE_DEG)
    matrix = np.array([[focal, 0, 644.0], [0, 1.002 * focal, 355], [0, 0, 1]])
    pinhole = Intrinsics(SIZE_WH, matrix, np.array(BARREL))
    fisheye = Intrinsics(SIZE_WH, matrix, np.array(BENT), model="fisheye")
    cameras = plain_scene().cameras
    ahead = tuple(replace(camera, intrinsics=fisheye) for camera in cameras)
    return {
        "pinhole": tuple(replace(camera, intrinsics=pinhole) for camera in cameras),
        "fisheye": ahead,
        "40 deg aside": tuple(turned(c, 40.0, 180.0 * k) for k, c in enumerate(ahead)),
    }


def measured(cameras: tuple[Camera, ...], frames: int, seed: int, folder: Path) -> str:
    """Calibrate and measure with a rig; a line of figures."""
    write_capture(CaptureScene(cameras=cameras, seed=seed), folder / "capture")
    result = calibrate(folder / "capture")
    write_calibration(folder / "calibration.toml", result.calibration)
    write_session(replace(plain_scene(), cameras=cameras), np.arange(frames) / 30, folder / "rec")
    truth, registry = truth_of(folder / "rec"), Registry.discover()
    with open_session(folder / "rec", folder / "calibration.toml") as session:
        rows = [one for _, one in measure_session(session, load_profile("precise"), registry)]
    found = [(pose_error(one, truth), one.pose) for one in rows if one.pose is not None]
    off = np.array([error for error, _ in found]).reshape(-1, 6) ** 2
    position, rotation = (np.sqrt(np.mean(np.sum(off[:, k : k + 3], axis=1))) for k in (0, 3))
    inside = np.mean([in_region(error, pose, 3) for error, pose in found])
    return (
        f"{position:8.4f} mm {np.degrees(rotation):7.4f} deg {100 * inside:4.0f} % "
        f"{len(rows) - len(found)} of {len(rows)} without"
    )


def main() -> None:
    """Print a line for each rig."""
    parser = argparse.ArgumentParser(prog="benchmarks.fisheye", description=__doc__)
    parser.add_argument("--frames", type=int, default=8, help="frame sets measured by each rig")
    parser.add_argument("--seed", type=int, default=0, help="of the calibrations' pictures")
    given = parser.parse_args()
    for name, cameras in rigs().items():
        with TemporaryDirectory() as folder:
            print(
                f"{name:14}{measured(cameras, given.frames, given.seed, Path(folder))}", flush=True
            )


if __name__ == "__main__":
    run_command(main)
