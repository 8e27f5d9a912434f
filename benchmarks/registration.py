"""How well an arm is registered, and whether the stated standard deviations hold.

    python -m benchmarks.registration [--arms 40] [--stops 8 15 30]

Simulated UR5e arms, their links off by 0.5 mm and 0.05 deg (SD of every length and angle of the
published table), are seen by cameras with 0.05 mm of noise per axis: standing at 8, 15 or 30 places
(pose and joints in pairs), or moving all joints for 90 s at 15 poses a second, with a clock to be
found. Printed for each way, with the links fitted and without: medians of the errors of base and
tool, and the error over the stated standard deviation, RMS over the arms: 1 is honest. Last, in how
many draws all errors together are inside the 95 % that is stated.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from benchmarks.command import run_command
from measure.arrays import Floats
from measure.geometry import RigidTransform, chi_square_quantile
from measure.metrology.poses import PoseTable
from measure.robots import Feature, Joint, Reading, RobotLog, SerialChain, StateSchema, dh_link
from measure_learning.core import PoseTrack
from measure_learning.core.registration import (
    LoggedTrack,
    RegisterOptions,
    register,
    register_stops,
)
from measure_learning.core.sightings import Stops

ALPHA_DEG = np.array([0.0, 90, 0, 0, 90, -90])
A_MM = np.array([0.0, 0, -425.0, -392.2, 0, 0])
D_MM = np.array([162.5, 0, 0, 133.3, 99.7, 99.6])
HOME_DEG = np.array([0.0, -100, -110, -60, 90, 0])
SWING_DEG = np.array([15.0, 12, 15, 35, 35, 40])


def ur5e(*, mm: float = 0.0, deg: float = 0.0, seed: int = 0) -> SerialChain:
    """With Craig's parameters off by draws of these standard deviations."""
    rng = np.random.default_rng(seed)
    alpha, theta = np.deg2rad(ALPHA_DEG + rng.normal(0, deg, 6)), np.deg2rad(rng.normal(0, deg, 6))
    a, d = A_MM + rng.normal(0, mm, 6), D_MM + rng.normal(0, mm, 6)
    links = [dh_link(alpha[k], a[k], theta[k], d[k]) for k in range(6)]
    return SerialChain(tuple(Joint(link, np.array([0.0, 0, 1])) for link in links), np.eye(4))


def schema(chain: SerialChain | None = None) -> StateSchema:
    """Joints in rad and the tip in mm."""
    names = [*(f"q{k}" for k in range(6)), "x", "y", "z"]
    x, y, z = (Reading.of(name) for name in "xyz")
    joints = tuple(Reading.of(f"q{k}") for k in range(6))
    features = tuple(Feature(name) for name in names)
    return StateSchema("ur5e-test", features, (x, y, z), joints, chain=chain)


@dataclass(frozen=True, eq=False)
class Arm:
    """One recording, and the truth of it."""

    track: PoseTrack
    log: RobotLog
    world_from_base: RigidTransform
    flange_from_body: RigidTransform
    clock_offset_s: float
    true_tip_mm: Floats  # (n, 3) in the base, at the poses' instants


def recorded(
    seed: int,
    *,
    seconds: float = 90.0,
    frame_hz: float = 15.0,
    noise_mm: float = 0.05,
    true: SerialChain | None = None,
    known: SerialChain | None = None,
    swing_deg: Floats = SWING_DEG,
    flange_from_body: RigidTransform | None = None,
) -> Arm:
    """An arm that moves all its joints, seen by cameras in a frame of their own.

    Args:
        true: the arm as it is; drawn if None.
        known: as its controller believes it to be; as published if None.
        flange_from_body: some 100 mm if None.
    """
    rng = np.random.default_rng(1000 + seed)
    true, known = true or ur5e(mm=0.5, deg=0.05, seed=seed), known or ur5e()
    logged = np.arange(-2.0, seconds + 2.0, 0.008)
    q = np.tile(np.deg2rad(HOME_DEG), (len(logged), 1))
    for _ in range(4):
        turn, phase = rng.uniform(0.3, 2.8, 6), rng.uniform(0, 2 * np.pi, 6)
        size = np.deg2rad(swing_deg) * rng.uniform(0.3, 0.7, 6)
        q += size * np.sin(turn * logged[:, None] + phase)
    base = RigidTransform.from_rotvec(rng.normal(0, 1, 3), rng.normal(0, 500, 3))
    hand = flange_from_body or RigidTransform.from_rotvec(rng.normal(0, 1, 3), rng.normal(0, 60, 3))
    offset = float(rng.uniform(-2, 2))
    times = np.arange(0.0, seconds, 1.0 / frame_hz)
    at = np.stack([np.interp(times, logged, column) for column in q.T], axis=1)
    seen = base @ true.pose(at) @ hand
    sd = noise_mm * np.array([1, 1, 1, 0.05, 0.05, 0.05])  # balls 20 mm from the middle
    seen = seen.perturb(sd * rng.normal(size=(len(times), 6)))
    P = np.tile(np.diag(sd**2), (len(times), 1, 1))
    track = PoseTrack(f"ur5e_{seed}", times, seen.translation, P[:, :3, :3], seen.rotation, P)
    states = np.concatenate([q, known.tip_mm(q)], axis=1)
    log = RobotLog(schema(known), logged + offset, states)
    return Arm(track, log, base, hand, offset, true.tip_mm(at))


def robot_toml() -> str:
    """What a user writes of this arm."""
    columns = ", ".join(f'{{name = "{feature.name}"}}' for feature in schema().features)
    joints = ",\n".join(
        f'  {{feature = "q{k}", alpha_deg = {ALPHA_DEG[k]}, a_mm = {A_MM[k]}, d_mm = {D_MM[k]}}}'
        for k in range(6)
    )
    return (
        f'robot = "ur5e-test"\nposition = ["x", "y", "z"]\nfeatures = [{columns}]\n'
        f"joints = [\n{joints},\n]\n"
    )


def stopped(
    seed: int, count: int, *, noise_mm: float = 0.05, true: SerialChain | None = None
) -> tuple[Stops, Arm]:
    """An arm that stood at `count` places, its joints spread by what `SWING_DEG` says."""
    arm = recorded(seed, seconds=1.0, noise_mm=noise_mm, true=true)
    true = true or ur5e(mm=0.5, deg=0.05, seed=seed)
    rng = np.random.default_rng(2000 + seed)
    q = np.deg2rad(HOME_DEG + 1.5 * SWING_DEG * rng.uniform(-1, 1, (count, 6)))
    sd = noise_mm * np.array([1, 1, 1, 0.05, 0.05, 0.05])
    seen = arm.world_from_base @ true.pose(q) @ arm.flange_from_body
    seen = seen.perturb(sd * rng.normal(size=(count, 6)))
    P = np.tile(np.diag(sd**2), (count, 1, 1))
    poses = PoseTable(np.arange(count, dtype=np.float64), seen, P)
    states = np.concatenate([q, ur5e().tip_mm(q)], axis=1)
    called = tuple(f"stop {k + 1}" for k in range(count))
    return Stops(f"stops_{seed}", poses, states, called), arm


def main() -> None:
    """Draw arms, register them, print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arms", type=int, default=40)
    parser.add_argument("--stops", type=int, nargs="*", default=[8, 15, 30])
    args = parser.parse_args()
    print("                        median error            error / stated SD       inside 95 %")
    print("               base mm   deg tool mm   deg   base mm  deg tool mm  deg  of", args.arms)
    for kinematics in (False, True):
        print("with the links" if kinematics else "frames alone")
        for count in (*args.stops, None):
            found = [_one(seed, count, kinematics) for seed in range(args.arms)]
            errors, ratios, inside = (np.array(column) for column in zip(*found, strict=True))
            b, bd, t, td = np.median(errors, axis=0)
            rb, rbd, rt, rtd = np.sqrt(np.mean(ratios**2, axis=0))
            print(
                f"{f'{count} stops' if count else '90 s of motion':14} {b:7.2f} {bd:5.3f} {t:7.2f} "
                f"{td:5.3f} {rb:9.2f} {rbd:4.2f} {rt:7.2f} {rtd:4.2f} {inside.sum():11d}",
                flush=True,
            )


def _one(seed: int, count: int | None, kinematics: bool) -> tuple[Floats, Floats, bool]:
    """Sizes of four errors (mm, deg), these over their SDs, and whether all are inside 95 %."""
    options = RegisterOptions(kinematics)
    if count is None:
        arm = recorded(seed)
        found = register([LoggedTrack(arm.track, arm.log)], options)
    else:
        stops, arm = stopped(seed, count)
        found = register_stops([stops], schema(ur5e()), options)
    d = np.concatenate(
        [
            found.world_from_base.difference(arm.world_from_base),
            found.flange_from_body.difference(arm.flange_from_body),
        ]
    )
    P = found.covariance[:12, :12]
    sizes = np.linalg.norm(d.reshape(4, 3), axis=1)
    sds = np.sqrt(np.diag(P).reshape(4, 3).sum(axis=1))
    inside = d @ np.linalg.solve(P, d) <= chi_square_quantile(0.95, 12)
    return sizes * [1, np.degrees(1), 1, np.degrees(1)], sizes / sds, bool(inside)


if __name__ == "__main__":
    run_command(main)
