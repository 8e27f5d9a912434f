"""Pose errors by cameras that are off, where the calibration states their covariance.

    python -m benchmarks.uncertain_cameras SESSION [--draws 8] [--solver contours]

SESSION is a recording with truth whose calibration is exact. Its cameras are moved by draws from a
covariance, which the calibration states, and the recording is measured with them. The covariance of
the poses should contain the resulting errors. Printed for each covariance (1 sd per axis), over all
draws: RMS errors of position and rotation, the standard deviations that are stated of them, the
share of poses whose 95 % regions hold the truth (of the position, and of all six), and of those
that are flagged. A missing pose counts as a failure: its error is infinite.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import in_region, pose_error, truth_of
from measure.api import choose, load_profile, measure_session
from measure.arrays import Floats
from measure.host import Registry
from measure.measuring import Measurement, Status
from measure.model import Camera
from measure.session import Calibration, Trajectory, open_session, write_calibration

LEVELS = ((0.02, 0.003), (0.05, 0.006), (0.1, 0.012), (0.2, 0.03))
"""In mm and degrees."""
HEADER = (
    "cameras off by    position  stated   rotation  stated   95 % region  of all six  flagged\n"
    "    mm     deg          mm      mm        deg     deg             %           %        %"
)


def moved(cameras: tuple[Camera, ...], covariance: Floats, seed: int) -> Calibration:
    """A calibration whose cameras are off by draws from a covariance (6, 6), and state it."""
    rng = np.random.default_rng(seed)
    off = rng.multivariate_normal(np.zeros(6), covariance, len(cameras))
    drawn = [
        Camera(c.name, c.intrinsics, c.world_from_camera.perturb(by), covariance)
        for c, by in zip(cameras, off, strict=True)
    ]
    return Calibration(tuple(drawn))


def judged(one: Measurement, truth: Trajectory) -> Floats:
    """Row (7,) of one frame set: squared errors, stated variances, in the regions, flagged."""
    flagged = float(one.status is Status.FLAGGED)
    if one.pose is None:
        return np.array([np.inf, np.inf, np.inf, np.inf, 0, 0, flagged])
    off = pose_error(one, truth)
    inside = [in_region(off, one.pose, count) for count in (3, 6)]
    squares, variances = off**2, np.diag(one.pose.covariance)
    parts = [np.sum(part) for part in (squares[:3], squares[3:], variances[:3], variances[3:])]
    return np.array([*parts, *inside, flagged])


def figures(session: Path, covariance: Floats, draws: int, solver: str) -> Floats:
    """Means (7,) of `judged` over all frame sets and draws."""
    rows, truth = [], truth_of(session)
    profile, registry = choose(load_profile("precise"), {"solver": solver}), Registry.discover()
    with open_session(session) as exact:
        cameras = exact.cameras
    with TemporaryDirectory() as folder:
        for seed in range(draws):
            file = Path(folder) / f"{seed}.toml"
            write_calibration(file, moved(tuple(cameras), covariance, seed))
            with open_session(session, file) as opened:
                measured = measure_session(opened, profile, registry)
                rows += [judged(one, truth) for _, one in measured]
    return np.mean(rows, axis=0)


def cells(found: Floats) -> str:
    """The means (7,) of `judged` as cells of the table."""
    position, rotation, position_sd, rotation_sd = np.sqrt(found[:4])
    inside, whole, flagged = 100 * found[4:]
    return (
        f"{position:12.3f}{position_sd:8.3f}{np.degrees(rotation):11.3f}"
        f"{np.degrees(rotation_sd):8.3f}{inside:14.0f}{whole:12.0f}{flagged:9.0f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.uncertain_cameras", description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--draws", type=int, default=8, help="of the cameras, at each level")
    parser.add_argument("--solver", default="contours", help="plugin that solves the pose")
    given = parser.parse_args()
    print(HEADER)
    for mm, deg in LEVELS:
        covariance = np.diag(np.repeat([mm, np.deg2rad(deg)], 3) ** 2)
        found = figures(given.session, covariance, given.draws, given.solver)
        print(f"{mm:6.2f}{deg:8.3f}{cells(found)}", flush=True)


if __name__ == "__main__":
    run_command(main)
