"""A rendered recording of the simulated RAVEN-II with its balls: session, robot log and truth.

As in the paper, the cameras are calibrated in the robot's base frame, so that what they measure
and what the robot reports can be subtracted.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from measure.geometry import RigidTransform
from measure.model import paper_body
from measure.processes import Progress
from measure.robots import RobotLog
from measure.session import Trajectory
from measure.simulation import Lighting, Material, Scene, write_session
from measure.simulation.catalogue import WORKSPACE_MM, lamps, paper_rig, stems
from measure.simulation.recording import write_truth
from measure_learning.robots import raven_chain, raven_schema, write_log
from measure_learning.simulator import Cables, SimulatedRun, simulate

_WRIST_DEG = (25.0, 20.0, 20.0)  # the balls stay in view of most cameras
_LOG_HZ = 500.0
_HOME = np.array([np.deg2rad(40.0), np.deg2rad(90.0), 350.0, 0.0, 0.0, 0.0])


def render_recording(
    folder: Path,
    *,
    seconds: float,
    frame_hz: float,
    seed: int,
    clock_offset_s: float,
    wear: float,
    progress: Progress,
) -> None:
    """Write a session folder with the robot's log `robot.parquet`, its clock so far ahead."""
    cables = Cables(wear=wear)
    run = simulate(seconds, seed, log_hz=_LOG_HZ, cables=cables, wrist_deg=_WRIST_DEG)
    times = np.arange(0.1, seconds - 0.1, 1.0 / frame_hz)
    write_session(_scene(run, seed), times, folder, progress=progress)
    write_truth(folder / "truth.csv", run.times_s, run.world_from_tip)
    log = RobotLog(raven_schema(), run.times_s + clock_offset_s, run.states)
    write_log(folder / "robot.parquet", log)


def _scene(run: SimulatedRun, seed: int) -> Scene:
    home = raven_chain().pose(_HOME)
    base_from_rig = home @ RigidTransform(np.eye(3), -WORKSPACE_MM)
    rig_from_tip = base_from_rig.inverse() @ run.world_from_tip
    body, cameras = paper_body(), paper_rig()
    return Scene(
        "raven-simulated",
        body,
        cameras,
        Trajectory(run.times_s, rig_from_tip),
        Lighting(lamps(seed), (0.15, 0.15, 0.15), (0.12, 0.12, 0.12), shadows=True),
        finish=Material((1.0, 1.0, 1.0), 0.03, 0.08),
        attached=stems(body),
        seed=seed,
        stated_cameras=tuple(
            replace(camera, world_from_camera=base_from_rig @ camera.world_from_camera)
            for camera in cameras
        ),
        description=f"simulated RAVEN-II, seed {seed}; frame: the robot's base",
    )
