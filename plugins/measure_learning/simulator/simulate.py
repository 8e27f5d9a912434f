"""One restart of the simulated arm: a planned motion becomes `raven_state` and the true pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure_learning.robots import raven
from measure_learning.robots.raven import DRIVES, Arm, raven_chain
from measure_learning.simulator import mechanics as k
from measure_learning.simulator.mechanics import Cables, integrate

PLAN_HZ = 50.0
_GRAVITY_STEPS = 20  # between which gravity is interpolated
_CENTRE = np.array([np.deg2rad(40.0), np.deg2rad(90.0), 350.0, 0.0, 0.0, 0.0])


# How the operator moves: assumptions, of the size of a surgical training task.
_HALF_BOX_MM = np.array([35.0, 35.0, 30.0])  # half the sides of the workspace, in the base frame
_REACH_MM = 22.0  # SD of one reach, per axis
_REACH_S = (0.7, 2.5)  # shortest and longest duration of a reach
_PAUSE, _LONGEST_PAUSE_S = 0.25, 1.5  # chance of a pause after a reach
WRIST_DEG = (60.0, 40.0, 35.0)  # largest roll, wrist and jaw-pair angle
_TREMOR_MM, _TREMOR_HZ = 0.03, 9.0  # SD per axis


def _plan(
    duration_s: float, rng: np.random.Generator, arm: Arm, wrist_deg: tuple[float, float, float]
) -> Floats:
    """Desired drive positions (steps, 7) at 1 kHz, in rad and m."""
    times = np.arange(0.0, duration_s + 2.0 / PLAN_HZ, 1.0 / PLAN_HZ)
    offset = _reaches(times, _HALF_BOX_MM, _REACH_MM, rng) + _tremor(times, rng)
    limits = np.deg2rad(wrist_deg)
    wrist = [_reaches(times, limits[i : i + 1], 0.4 * limits[i], rng) for i in range(3)]
    opening = np.deg2rad(20.0) + _reaches(times, np.deg2rad([20.0]), np.deg2rad(15.0), rng)
    chain, centre = raven_chain(arm), _CENTRE if arm == "left" else _CENTRE * [1, 1, 1, -1, 1, 1]
    start = np.tile(centre, (len(times), 1))
    start[:, 3:] = np.concatenate(wrist, axis=1)
    home = chain.tip_mm(centre)
    q = chain.solve_tip(home + offset, start, (0, 1, 2), tolerance_mm=1e-4)
    drives = np.empty((len(times), DRIVES))
    drives[:, :2], drives[:, 2], drives[:, 3:5] = q[:, :2], 1e-3 * q[:, 2], q[:, 3:5]
    drives[:, 5] = q[:, 5] + 0.5 * opening[:, 0]
    drives[:, 6] = -q[:, 5] + 0.5 * opening[:, 0]
    fine = np.arange(round(duration_s * 1000)) * 1e-3
    return np.ascontiguousarray(CubicSpline(times, drives)(fine))


def _reaches(times: Floats, half: Floats, size: float, rng: np.random.Generator) -> Floats:
    """Minimum-jerk reaches between random points of a box, with pauses: (times, axes)."""
    count = int(times[-1] / _REACH_S[0]) + 4
    moves = rng.uniform(*_REACH_S, count)
    rests = np.where(rng.random(count) < _PAUSE, rng.uniform(0.1, _LONGEST_PAUSE_S, count), 0.0)
    starts = np.concatenate([[0.0], np.cumsum(moves + rests)[:-1]])
    points = np.zeros((count + 1, len(half)))
    for index in range(count):
        step = points[index] + rng.normal(0.0, size, len(half))
        points[index + 1] = half - np.abs((step + half) % (4.0 * half) - 2.0 * half)
    which = np.clip(np.searchsorted(starts, times, "right") - 1, 0, count - 1)
    s = np.clip((times - starts[which]) / moves[which], 0.0, 1.0)
    blend = (s**3 * (10.0 - 15.0 * s + 6.0 * s**2))[:, None]
    return points[which] + blend * (points[which + 1] - points[which])


def _tremor(times: Floats, rng: np.random.Generator) -> Floats:
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    swell = 1.0 + 0.5 * np.sin(2.0 * np.pi * 0.3 * times)[:, None]
    turn = 2.0 * np.pi * _TREMOR_HZ * times[:, None] + phase
    return np.sqrt(2.0) * _TREMOR_MM * swell * np.sin(turn)


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """The recording of one restart."""

    times_s: Floats  # (n,) of the kept steps
    states: Floats  # (n, 118) in the order of `raven_schema`
    # the true poses (n), world = the base frame that the robot assumes.
    world_from_tip: RigidTransform


def simulate(
    duration_s: float,
    seed: int,
    *,
    log_hz: float = 1000.0,
    arm: Arm = "left",
    cables: Cables | None = None,
    wrist_deg: tuple[float, float, float] = WRIST_DEG,
) -> SimulatedRun:
    """Switch the robot on, home it, and teleoperate it.

    Args:
        seed: of the motion and of this restart's errors of homing and registration.
        log_hz: states kept per second; the controller itself always runs at 1 kHz.
        cables: the mechanics; the default robot if absent.
        wrist_deg: largest roll, wrist and jaw-pair angle.
    """
    cables = cables or Cables()
    rng = np.random.default_rng(seed)
    desired = _plan(duration_s, rng, arm, wrist_deg)
    every = max(1, round(1000.0 / log_hz))
    logged = integrate(desired, _gravity(desired, arm, cables.payload_kg), cables, every)
    zero = np.array(cables.homing) + rng.normal(0.0, cables.restart_sd)
    encoder_offset = np.round(rng.uniform(-2e4, 2e4, raven.DRIVES))
    links = logged[:, 3]
    if cables.slip is not None:
        links = links + cables.slip.errors(links, every * k.STEP_S)
    q_true = raven.joints_from_drives(links + zero)
    sd_mm, sd_deg = cables.registration_sd
    world_from_base = RigidTransform.from_rotvec(
        np.deg2rad(cables.registration_rotvec_deg + rng.normal(0.0, sd_deg, 3)),
        cables.registration_mm + rng.normal(0.0, sd_mm, 3),
    )
    return SimulatedRun(
        times_s=np.arange(len(logged), dtype=np.float64) * (every * k.STEP_S),
        states=_messages(logged, encoder_offset, arm),
        world_from_tip=world_from_base @ raven.raven_chain(arm).pose(q_true),
    )


def _gravity(drives: Floats, arm: Arm, payload_kg: float) -> Floats:
    """Generalised gravity (steps, 7) at the desired pose: it differs little from the true one."""
    chain = raven.raven_chain(arm)
    centres = np.array(k.LINK_CENTRE_LEFT_MM if arm == "left" else k.LINK_CENTRE_RIGHT_MM)
    coarse = np.append(np.arange(0, len(drives), _GRAVITY_STEPS), len(drives) - 1)
    q = raven.joints_from_drives(drives[coarse])
    frames = chain.frames(q)
    torque = np.zeros((len(coarse), raven.DRIVES))
    masses = np.add(k.LINK_MASS_KG, (0.0, 0.0, payload_kg))
    for link, (mass, centre) in enumerate(zip(masses, centres, strict=True)):
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
        "tau": _eight(k.TORQUE_SIGN[arm] * k.GEARBOX * dac / k.COUNTS_PER_TORQUE),
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
