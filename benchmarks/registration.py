"""How well an arm is registered, and whether the stated covariance holds.

    python -m benchmarks.registration [--arms 100]

Simulated UR5e arms, their links off by 0.5 mm and 0.05 deg (SD of every length and angle of the
published table), move all joints for 90 s; cameras see a body on the tool 15 times a second with
0.05 mm of noise per axis. Base, tool and clock are unknown. Printed for each way: medians and 90th
percentiles of the errors, what is left, and in how many draws the errors are inside the 95 % that
is stated: of base, tool and clock one by one, and of all 13 numbers together.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from benchmarks.command import run_command
from measure.arrays import Floats
from measure.geometry import RigidTransform, chi_square_quantile
from measure.robots import Feature, Joint, Reading, RobotLog, SerialChain, StateSchema, dh_link
from measure_learning.core import PoseTrack
from measure_learning.core.registration import Recording, RegisterOptions, register

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


PARTS = {"base": slice(0, 6), "tool": slice(6, 12), "clock": slice(12, 13), "all": slice(0, 13)}


def main() -> None:
    """Draw arms, register them, print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arms", type=int, default=100)
    count = parser.parse_args().arms
    for kinematics in (False, True):
        rows, inside = zip(*(_one(seed, kinematics) for seed in range(count)), strict=True)
        print("with the links" if kinematics else "frames alone")
        print("         base mm   deg  tool mm   deg  clock ms  left mm  held out mm")
        for label, share in (("median", 0.5), ("90 %", 0.9)):
            b, bd, t, td, c, left, held = np.quantile(rows, share, axis=0)
            print(
                f"{label:8} {b:7.2f} {bd:5.3f} {t:8.2f} {td:5.3f} {c:9.3f} {left:8.3f} {held:12.3f}"
            )
        found = dict(zip(PARTS, np.sum(inside, axis=0), strict=True))
        print(f"inside 95 % of {count}: " + ", ".join(f"{k} {v}" for k, v in found.items()))


def _one(seed: int, kinematics: bool) -> tuple[list[float], list[bool]]:
    """Sizes of the errors and of what is left; whether each part's errors are inside 95 %."""
    arm = recorded(seed)
    found = register([Recording(arm.track, arm.log)], RegisterOptions(kinematics))
    d = np.concatenate(
        [
            found.world_from_base.difference(arm.world_from_base),
            found.flange_from_body.difference(arm.flange_from_body),
            [found.clock_offsets_s[arm.track.name] - arm.clock_offset_s],
        ]
    )
    mm, deg, tool_mm, tool_deg = (
        float(np.linalg.norm(d[at : at + 3])) * (np.degrees(1) if at % 6 else 1)
        for at in (0, 3, 6, 9)
    )
    facts = found.judgement
    row = [mm, deg, tool_mm, tool_deg, 1e3 * abs(d[12]), facts["rms_mm"], facts["held_out_rms_mm"]]
    P = found.covariance
    squares = {name: d[p] @ np.linalg.solve(P[p, p], d[p]) for name, p in PARTS.items()}
    return row, [bool(s <= chi_square_quantile(0.95, len(d[PARTS[n]]))) for n, s in squares.items()]


if __name__ == "__main__":
    run_command(main)
