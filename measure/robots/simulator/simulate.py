"""One restart of the simulated arm: a planned motion becomes `raven_state` and the true pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.robots import raven
from measure.robots.raven import Arm
from measure.robots.simulator import constants as k
from measure.robots.simulator.constants import Cables
from measure.robots.simulator.dynamics import integrate
from measure.robots.simulator.teleoperation import Teleoperation, plan


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """The recording of one restart.

    Attributes:
        times_s: (n,) of the kept steps.
        states: (n, 118) in the order of `raven_schema`.
        world_from_tip: the true poses (n), world = the base frame that the robot assumes.
    """

    times_s: Floats
    states: Floats
    world_from_tip: RigidTransform


def simulate(
    duration_s: float,
    seed: int,
    *,
    log_hz: float = 1000.0,
    arm: Arm = "left",
    cables: Cables | None = None,
    style: Teleoperation | None = None,
) -> SimulatedRun:
    """Switch the robot on, home it, and teleoperate it.

    Args:
        duration_s: length of the recording.
        seed: of the motion and of this restart's homing error.
        log_hz: states kept per second; the controller itself always runs at 1 kHz.
        arm: which arm moves.
        cables: the mechanics; the default robot if absent.
        style: how the operator moves.
    """
    cables = cables or Cables()
    rng = np.random.default_rng(seed)
    desired = plan(duration_s, rng, arm, style)
    every = max(1, round(1000.0 / log_hz))
    logged = integrate(desired, _gravity(desired, arm), cables, every)
    zero = np.array(cables.homing) + rng.normal(0.0, cables.restart_sd)
    encoder_offset = np.round(rng.uniform(-2e4, 2e4, raven.DRIVES))
    q_true = raven.joints_from_drives(logged[:, 3] + zero)
    world_from_base = RigidTransform.from_rotvec(
        np.deg2rad(cables.registration_rotvec_deg), cables.registration_mm
    )
    return SimulatedRun(
        times_s=np.arange(len(logged), dtype=np.float64) * (every * k.STEP_S),
        states=_messages(logged, encoder_offset, arm),
        world_from_tip=world_from_base @ raven.raven_chain(arm).pose(q_true),
    )


def _gravity(drives: Floats, arm: Arm, every: int = 20) -> Floats:
    """Generalised gravity (steps, 7) at the desired pose: it differs little from the true one."""
    chain = raven.raven_chain(arm)
    centres = np.array(k.LINK_CENTRE_LEFT_MM if arm == "left" else k.LINK_CENTRE_RIGHT_MM)
    coarse = np.append(np.arange(0, len(drives), every), len(drives) - 1)
    q = raven.joints_from_drives(drives[coarse])
    frames = chain.frames(q)
    torque = np.zeros((len(coarse), raven.DRIVES))
    for link, (mass, centre) in enumerate(zip(k.LINK_MASS_KG, centres, strict=True)):
        frame = frames[:, link]
        where = 1e-3 * (frame[:, :3, :3] @ centre + frame[:, :3, 3])
        for joint in range(link + 1):
            axis, origin = frames[:, joint, :3, 2], 1e-3 * frames[:, joint, :3, 3]
            slope = axis if joint == 2 else np.cross(axis, where - origin)
            torque[:, joint] += mass * (slope @ k.GRAVITY_BASE)
    return np.stack(
        [np.interp(np.arange(len(drives)), coarse, torque[:, i]) for i in range(raven.DRIVES)],
        axis=1,
    )


def _messages(logged: Floats, encoder_offset: Floats, arm: Arm) -> Floats:
    """The numbers of one arm, rounded as the message stores them: (n, 118)."""
    motor, motor_speed, dac, _, motor_goal, drive_goal = np.moveaxis(logged, 1, 0)
    drives, speeds = raven.drives_from_motors(motor), raven.drives_from_motors(motor_speed)
    chain, q = raven.raven_chain(arm), raven.joints_from_drives(drives)
    q_goal = raven.joints_from_drives(drive_goal)
    pose, goal = chain.pose(q), chain.pose(q_goal)
    q_speed = raven.joints_from_drives(speeds)
    twist = np.einsum("nij,nj->ni", chain.jacobian(q), q_speed)
    degrees = np.degrees
    count = len(motor)
    counts = np.round(motor * raven.ENCODER_COUNTS_PER_RAD)
    values = {
        "type": np.full((count, 1), raven.ARM_TYPE[arm]),
        "pos": np.round(1e3 * pose.translation),
        "ori": pose.rotation.reshape(count, 9),
        "ori_d": goal.rotation.reshape(count, 9),
        "pos_d": np.round(1e3 * goal.translation),
        "encVals": _eight(counts + encoder_offset),
        "dac_val": _eight(np.round(dac)),
        "tau": _eight(dac / k.COUNTS_PER_TORQUE),
        "mpos": _eight(degrees(motor)),
        "jpos": _eight(degrees(drives)),
        "mvel": _eight(degrees(motor_speed)),
        "jvel": _eight(degrees(speeds)),
        "mpos_d": _eight(degrees(motor_goal)),
        "jpos_d": _eight(degrees(drive_goal)),
        "grasp_d": (drive_goal[:, 5] + drive_goal[:, 6])[:, None],
        "encoffsets": _eight(np.tile(encoder_offset, (count, 1))),
        "jac_vel": twist,
        "jac_f": twist,
    }
    out = np.concatenate([values[field.name] for field in raven.FIELDS], axis=1)
    return out.astype(np.float32).astype(np.float64)


def _eight(values: Floats) -> Floats:
    out = np.zeros((len(values), 8))
    out[:, raven.PLACES] = values
    return out
