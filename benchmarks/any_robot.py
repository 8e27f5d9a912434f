"""A robot that is not RAVEN, by commands alone: `python -m benchmarks.any_robot FOLDER`.

What docs/how_to/correct_a_robot.md says, typed for a simulated UR5e that holds the balls before
four cameras in a frame of their own: measure its recordings, find its base, the body on its flange
and its clock, pair, learn, and correct another recording. FOLDER keeps what is done.
"""

from __future__ import annotations

import argparse
import csv
import shlex
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import rms
from measure.arrays import Floats
from measure.geometry import RigidTransform, align_points
from measure.robots import SerialChain
from measure.session import Trajectory
from measure.simulation import write_session
from measure.simulation.catalogue import WORKSPACE_MM, webcam_scene
from measure.simulation.recording import write_truth
from measure_learning.robots import find_schema
from measure_learning.robots.tables import Table

HOME_DEG = np.array([0.0, -100, -110, -60, 90, 0])
SWING_DEG = np.array([1.5, 1.2, 1.5, 18, 18, 25])
"""Small in the arm and large in the wrist: the balls stay before the cameras."""
FLANGE_FROM_BODY = RigidTransform.from_rotvec([0.3, -0.2, 0.5], [12.0, -8.0, 60.0])
CLOCK_OFFSET_S = 0.8
_LOG_HZ = 125.0
GEAR_DEG, _GEAR_TURNS = 0.06, 9.0
"""A harmonic drive's error: so large, so often in a turn of the joint."""
_LINK_MM, _LINK_DEG = 0.5, 0.05


@dataclass(frozen=True, eq=False)
class Arm:
    """The arm as it is: its links are off the published ones, and its gears err periodically."""

    chain: SerialChain
    phases: Floats  # (6,) rad, of the gears
    gear_deg: float  # how much they err

    def pose(self, q: Floats) -> RigidTransform:
        """base_from_flange at joints (n, 6) as reported."""
        gear = np.deg2rad(self.gear_deg) * np.sin(_GEAR_TURNS * q + self.phases)
        return self.chain.pose(q + gear)


def make_arm(seed: int = 5, gear_deg: float = GEAR_DEG) -> Arm:
    """An arm whose links and gears are drawn."""
    rng = np.random.default_rng(seed)
    chain = find_schema("ur5e").chain
    assert isinstance(chain, SerialChain)
    joints = []
    for joint in chain.joints:
        slip = RigidTransform.from_rotvec(
            np.deg2rad(_LINK_DEG) * rng.normal(size=3), _LINK_MM * rng.normal(size=3)
        )
        joints.append(replace(joint, link=joint.link @ slip.matrix))
    return Arm(replace(chain, joints=tuple(joints)), rng.uniform(0, 2 * np.pi, 6), gear_deg)


def render(
    folder: Path, arm: Arm, seconds: float, frame_hz: float, seed: int, slow: float = 1.0
) -> Path:
    """A session folder with the robot's log `robot.csv`, as RTDE writes it, and the truth.

    Args:
        slow: factor on the periods of the motion.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(-1.0, seconds + 1.0, 1 / _LOG_HZ)
    q = np.tile(np.deg2rad(HOME_DEG), (len(times), 1))
    for _ in range(3):
        turn, phase = rng.uniform(0.5, 2.2, 6) / slow, rng.uniform(0, 2 * np.pi, 6)
        size = np.deg2rad(SWING_DEG) * rng.uniform(0.4, 0.7, 6)
        q += size * np.sin(turn * times[:, None] + phase)
    flange = arm.pose(q)
    world_from_body = world_from_base(arm) @ flange @ FLANGE_FROM_BODY
    scene = replace(
        webcam_scene(seed),
        name="ur5e-simulated",
        trajectory=Trajectory(times, world_from_body),
        description=f"simulated UR5e, seed {seed}; frame: the cameras'",
    )
    write_session(scene, np.arange(0.0, seconds, 1 / frame_hz), folder)
    write_truth(folder / "truth.csv", times, world_from_body)
    write_truth(folder / "flange.csv", times, flange)
    chain = find_schema("ur5e").chain
    assert isinstance(chain, SerialChain)
    believed = chain.pose(q)
    names = ["timestamp", *(f"actual_{what}_{k}" for what in ("q", "TCP_pose") for k in range(6))]
    rows = np.column_stack(
        [times + CLOCK_OFFSET_S, q, believed.translation / 1000, believed.rotvec]
    )
    with (folder / "robot.csv").open("w", newline="") as file:
        table = csv.writer(file, delimiter=" ")
        table.writerows([names, *([f"{value:.9g}" for value in row] for row in rows)])
    return folder


def world_from_base(arm: Arm) -> RigidTransform:
    """Such that the body at home stands upright in the middle of the cameras' view."""
    home = arm.pose(np.deg2rad(HOME_DEG)[None])[0] @ FLANGE_FROM_BODY
    return RigidTransform(np.eye(3), WORKSPACE_MM) @ home.inverse()


def commands(estimator: str, options: str = "") -> list[tuple[str, str]]:
    """What each command makes, and its words."""
    log = "--robot-log {0}/robot.csv --robot ur5e"
    pair = f"dataset {{0}}-run {log} --frame frame.toml --out {{0}}.parquet"
    return [
        ("first-run/poses.csv", "run first --out first-run --no-recording"),
        ("frame.toml", f"register first-run {log.format('first')} -o frame.toml"),
        ("first.parquet", f"{pair.format('first')} --cut-s 10"),
        ("model.onnx", f"train first.parquet --out model.onnx --estimator {estimator} {options}"),
        ("out.csv", "estimate model.onnx --input second/robot.csv --out out.csv"),
    ]


def errors(folder: Path) -> tuple[float, float]:
    """RMS errors in mm of the second recording's flange, as reported and as corrected.

    About the truth, each after the rigid motion that fits it best: what a registered base and a
    constant offset of the tool cannot tell apart is no error of the arm.
    """
    truth = np.loadtxt(folder / "second" / "flange.csv", delimiter=",", skiprows=1)[:, 1:4]
    with (folder / "second" / "robot.csv").open() as file:
        rows = list(csv.DictReader(file, delimiter=" "))
    reported = np.array([[1000 * float(r[f"actual_TCP_pose_{k}"]) for k in range(3)] for r in rows])
    corrected = reported + Table.read(folder / "out.csv").numbers("ex", "ey", "ez")
    left = (truth - align_points(truth, tip).apply(tip) for tip in (reported, corrected))
    before, after = (rms(error) for error in left)
    return before, after


def main() -> None:
    """Run what has not been run, and print the errors."""
    parser = argparse.ArgumentParser(prog="benchmarks.any_robot", description=__doc__)
    parser.add_argument("folder", type=Path, help="keeps recordings, runs, data and models")
    parser.add_argument("--seconds", type=float, default=90.0, help="of the first recording")
    parser.add_argument("--second", type=float, default=30.0, help="seconds of the second one")
    parser.add_argument("--frame-hz", type=float, default=15.0, help="frame sets per second")
    parser.add_argument("--estimator", default="kinematic", help="what `measure train` trains")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    arm = make_arm()
    for name, seconds, hz, seed in (
        ("first", given.seconds, given.frame_hz, 1), ("second", given.second, 0.1, 2),
    ):  # fmt: skip
        if not (given.folder / name / "robot.csv").exists():
            render(given.folder / name, arm, seconds, hz, seed)
    for made, words in commands(given.estimator):
        if not (given.folder / made).exists():
            print(f"measure {words}", flush=True)
            command = [sys.executable, "-m", "measure", *shlex.split(words)]
            subprocess.run(command, cwd=given.folder, check=True)
    before, after = errors(given.folder)
    print(f"reported {before:.3f} mm RMS, corrected {after:.3f} mm RMS ({after / before - 1:+.1%})")


if __name__ == "__main__":
    run_command(main)
