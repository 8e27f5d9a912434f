"""Pictures of a waved board that choose themselves, against all of them.

    python -m benchmarks.waving [--seconds 60] [--rate 3] [--goal-mm 0.2]

A board is waved before four cameras and rendered. The cameras are calibrated by the pictures that
`measure capture` would keep until they are enough, and by all. Printed are errors of the body's
position against the truth over the workspace, in mm (RMS, 3-D): in the first camera's frame; after
the rigid motion that fits the positions best, which is what remains once the world is put where a
board or a body lies; what the cameras' covariances state; errors of distances between positions;
and the second again together with the noise of a measurement, 0.05 px of each ball's centre in each
picture.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np

from benchmarks.errors import aligned_rms, body_cost, rms
from measure.arrays import rms_length
from measure.calibration import BoardWave, Corners
from measure.calibration.common_views import fit_common_views
from measure.calibration.intrinsics import calibrate_lens
from measure.calibration.views import ALL_VIEWS, choose_views
from measure.estimation.expected_accuracy import body_pose_sd, noise_sd
from measure.geometry import RigidTransform
from measure.model import Camera, paper_body
from tests.studio.waved import SIZE_WH, board, picture, rig, waved

AZIMUTHS_DEG = (45.0, 75.0, 105.0, 135.0)
REACH_MM, NOISE_PX = 60.0, 0.05
Views = Mapping[str, Corners]


def looked_at(cameras: Sequence[Camera], times_s: Sequence[float]) -> list[Views]:
    """The board's corners in rendered pictures, by camera, at each time."""
    rng, out = np.random.default_rng(0), list[Views]()
    for time_s in times_s:
        shown = {c.name: picture(c, waved(time_s), rng) for c in cameras}
        grays = {
            name: np.asarray(cv2.cvtColor(p, cv2.COLOR_BGR2GRAY), np.uint8)
            for name, p in shown.items()
        }
        seen = {name: board().find(gray) for name, gray in grays.items()}
        out.append({name: view for name, view in seen.items() if view is not None})
    return out


def chosen(
    cameras: Sequence[Camera], instants: Sequence[Views], rate_hz: float, goal_mm: float
) -> tuple[list[Views], int]:
    """What is kept until it is enough, and after how many instants that is."""
    wave = BoardWave(board(), {c.name: SIZE_WH for c in cameras}, paper_body(), goal_mm)
    for number, views in enumerate(instants):
        wave.add(views, dict.fromkeys(views, number / rate_hz))
        if wave.state().enough:
            return list(wave.kept), number + 1
    return list(wave.kept), len(instants)


def calibrated(names: Sequence[str], instants: Sequence[Views]) -> tuple[Camera, ...]:
    """The cameras, the first one's frame the world."""
    lenses = {}
    for name in names:
        mine = [replace(v[name], source=str(i)) for i, v in enumerate(instants) if name in v]
        views = choose_views(board(), mine, SIZE_WH, name, None, ALL_VIEWS)
        lenses[name] = calibrate_lens(board(), views, name)
    return fit_common_views(board(), lenses)[0]


def errors_mm(found: Sequence[Camera], true: Sequence[Camera]) -> tuple[float, ...]:
    """What is printed of cameras, the first one's frame being their world."""
    world = true[0].world_from_camera.inverse()
    there = tuple(replace(c, world_from_camera=world @ c.world_from_camera) for c in true)
    rng = np.random.default_rng(1)
    poses = [
        world @ RigidTransform.from_rotvec(rng.normal(0, 0.4, 3), rng.uniform(-1, 1, 3) * REACH_MM)
        for _ in range(60)
    ]
    off = body_cost(tuple(found), there, paper_body(), poses)
    at = np.stack([pose.translation for pose in poses])
    left = aligned_rms(at, off)
    ends = np.array([*combinations(range(len(at)), 2)]).T
    far, near = (np.linalg.norm(p[ends[0]] - p[ends[1]], axis=1) for p in (at + off, at))
    noise = [noise_sd(pose, paper_body(), there, NOISE_PX)[0] for pose in poses]
    total = np.hypot(left, rms_length(np.array(noise)[:, None]))
    stated = rms_length(body_pose_sd(found, paper_body(), poses)[0][:, None])
    return rms(off), left, stated, rms((far - near)[:, None]), float(total)


def main() -> None:
    """Wave, calibrate twice, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=3.0)
    parser.add_argument("--goal-mm", type=float, default=0.2)
    given = parser.parse_args()
    cameras = rig(AZIMUTHS_DEG)
    instants = looked_at(cameras, np.arange(0.0, given.seconds, 1 / given.rate).tolist())
    kept, after = chosen(cameras, instants, given.rate, given.goal_mm)
    names = [c.name for c in cameras]
    print(f"enough after {after / given.rate:.0f} s: {len(kept)} of {len(instants)} instants kept")
    print("| calibrated by | first camera's frame | aligned | stated | distances | with noise |")
    print("|---|---|---|---|---|---|")
    for what, some in (("the pictures kept", kept), ("all pictures", instants)):
        row = errors_mm(calibrated(names, some), cameras)
        print(f"| {what} | " + " | ".join(f"{mm:.4f}" for mm in row) + " |")


if __name__ == "__main__":
    main()
