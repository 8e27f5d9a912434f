"""Motors, cables and links of the simulated RAVEN-II at 1 kHz, compiled.

Constants have their source, or are marked as an assumption.

Seven drives: shoulder, elbow (rad), insertion (m), roll, wrist, jaw 1, jaw 2 (rad); SI units.

Sources:
  [S] the robot's public control software: gravity (grav_comp.cpp), amplifiers (defines.h),
      motor and gear data (motor.h).
  [L] a fit to a real 1 kHz log, DAC = a acc + b vel + c sign(vel): R^2 0.96, 0.97, 0.87.
  [B] measured on another cable-driven arm with this kind of tool (Hwang et al., RA-L 2020): play
      of half-width about 2, 6 and 10 degrees (roll, pitch, yaw) and gains of 0.66-0.75 of single
      wrist joints; a fit to that arm's recordings adds 0.17-0.25 of pitch per yaw and of yaw per
      pitch, roll neither coupled nor reduced, and zeros that differ from one recording to the next
      by about 0.15 deg (arm), 0.4 mm (insertion) and 1-1.5 deg (wrist), the cameras' part
      included: 0.7-0.8 mm at the tip.
  [A] assumption. Chosen so that the reported position errs by as much as the literature says
      (several millimetres, up to about 10), not fitted to any data set.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.errors import ConfigError
from measure_learning.robots import raven
from measure_learning.simulator.slip import Slip

STEP_S = 1e-3  # [S] controller period

# Motors, per drive. RE40 on the first three, RE30 on the tool's four.
TORQUE_PER_AMP = np.array([0.0603, 0.0603, 0.0603, 0.0538, 0.0538, 0.0538, 0.0538])  # [S] N m/A
COUNTS_PER_AMP = np.array([2730.0] * 3 + [5461.0] * 4)  # [S] values; which amplifier where: [A]
COUNTS_PER_TORQUE = COUNTS_PER_AMP / TORQUE_PER_AMP
GEARBOX = np.array([49 / 4] * 3 + [26 / 7] * 4)  # [S] `tau` is the torque behind the gearbox,
TORQUE_SIGN = {"left": -1.0, "right": 1.0}  # [S] and its sign depends on the arm (init.cpp)
MAX_COUNTS = np.array([5000.0, 5000.0, 4000.0, 3000.0, 3000.0, 3800.0, 3800.0])  # [S]
INERTIA = np.array([1.24, 0.88, 0.32, 0.2, 0.2, 0.2, 0.2])  # counts s^2/rad: [L]; tool: [A]
VISCOUS = np.array([5.5, 9.0, 10.5, 5.0, 5.0, 5.0, 5.0])  # counts s/rad: [L]; tool: [A]
COULOMB = np.array([176.0, 300.0, 257.0, 150.0, 150.0, 150.0, 150.0])  # counts: [L]; tool: [A]

# Gravity on the first three links. [S]
LINK_MASS_KG = (0.494, 0.750, 0.231)
LINK_CENTRE_LEFT_MM = ((6.5, 97.75, -137.71), (-2.0, -182.74, -230.53), (0.0, 0.0, 0.0))
LINK_CENTRE_RIGHT_MM = ((-6.5, -97.75, 137.71), (-2.0, -182.74, 230.53), (0.0, 0.0, 0.0))
GRAVITY_BASE = np.array([-9.8, 0.0, 0.0])  # m/s^2 in the arm's base frame

CONTROL_HZ = np.array([8.0, 8.0, 8.0, 12.0, 12.0, 12.0, 12.0])  # [A] closed-loop bandwidth
CONTROL_DAMPING = 0.9  # [A]
VELOCITY_FILTER_HZ = 20.0  # [A] low pass behind mvel and jvel

DEGREE = np.pi / 180.0


def _drives(*deg_mm: float) -> tuple[float, ...]:
    """Of seven drives, in rad and m, from deg and mm."""
    return tuple(1e-3 * x if i == 2 else DEGREE * x for i, x in enumerate(deg_mm))


@dataclass(frozen=True)
class Cables:
    """Cables, pulleys and links between the motors and the tip; all [A] unless marked.

    Attributes:
        stiffness: N m/rad (N/m) of each cable at small load.
        stiffening: how much stiffer at `load`, relative: cables stiffen with tension.
        load: N m (N) at which `stiffening` is reached.
        backlash: half-width, rad (m). Roll, wrist and jaws: [B].
        friction: Coulomb friction of links and pulleys behind the cable, N m (N).
        bristle: motion over which friction builds up (Dahl), rad (m).
        inertia: of the links, kg m^2 (kg).
        damping: ratio of the link on its cable.
        wrist: how far roll, pitch and yaw turn per turn of each at the motors. [B]
        homing: fixed error of each drive's zero, rad (m).
        restart_sd: SD of the zero's further error after each restart, rad (m).
        registration_mm: where the robot believes its base to be, minus where it is.
        registration_rotvec_deg: the same for its orientation.
        registration_sd: SDs per axis of both after each restart, mm and deg.
        wear: factor on slack and friction.
        payload_kg: what the tool carries, beside its own mass.
        slip: hysteresis, creep and drift beside these; None for none.
    """

    stiffness: tuple[float, ...] = (220.0, 160.0, 9000.0, 2.0, 1.5, 1.5, 1.5)
    stiffening: float = 0.6
    load: tuple[float, ...] = (3.0, 3.0, 10.0, 0.05, 0.05, 0.05, 0.05)
    backlash: tuple[float, ...] = _drives(0.05, 0.05, 0.1, 2.0, 6.0, 10.0, 10.0)
    friction: tuple[float, ...] = (0.9, 0.8, 4.0, 0.02, 0.02, 0.02, 0.02)
    bristle: tuple[float, ...] = (1e-3, 1e-3, 1e-4, 6e-3, 6e-3, 6e-3, 6e-3)
    inertia: tuple[float, ...] = (0.08, 0.06, 0.35, 1e-4, 6e-5, 6e-5, 6e-5)
    damping: float = 0.25
    wrist: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 0.75, 0.2), (0.0, 0.2, 0.7))
    homing: tuple[float, ...] = _drives(1.25, -1.5, 2.6, 3.0, -2.0, 0.0, 0.0)
    restart_sd: tuple[float, ...] = _drives(0.12, 0.12, 0.3, 1.2, 1.2, 1.2, 1.2)
    registration_mm: tuple[float, float, float] = (1.5, -1.0, 2.0)
    registration_rotvec_deg: tuple[float, float, float] = (0.3, -0.4, 0.2)
    registration_sd: tuple[float, float] = (0.3, 0.06)
    wear: float = 1.0
    payload_kg: float = 0.0
    slip: Slip | None = None

    def __post_init__(self) -> None:
        if not 0.1 <= self.wear <= 3.0:
            raise ConfigError(
                f"wear {self.wear:g}: expected a factor on slack and friction, 0.1 to 3"
            )

    def coupling(self) -> Floats:
        """(7, 7): how far each cable is pulled per unit of each drive's link (rad, m)."""
        turns = np.eye(4)
        turns[:3, :3] = self.wrist
        jaws = np.eye(4)  # to roll, wrist, yaw and half the opening from the drives
        jaws[2:, 2:] = [[0.5, -0.5], [0.5, 0.5]]
        out = raven.coupling()
        out[3:, 3:] = np.linalg.inv(np.linalg.solve(jaws, turns @ jaws))
        return out

    def packed(self) -> Floats:
        """(8, 7) for the integrator: k, stiffening, load, backlash, friction, bristle, I, c."""
        stiffness, inertia = np.array(self.stiffness) / self.wear, np.array(self.inertia)
        damping = 2.0 * self.damping * np.sqrt(stiffness * inertia)
        ones = np.ones(len(stiffness))
        rows = (
            stiffness,
            self.stiffening * ones,
            self.load,
            self.wear * np.array(self.backlash),
            self.wear * np.array(self.friction),
            self.bristle,
            inertia,
            damping,
        )
        return np.array([np.asarray(row, dtype=np.float64) for row in rows])


SUBSTEPS = 4
_N = raven.DRIVES


class _Mechanics(NamedTuple):
    """Constants of the drives."""

    # (7, drives) inertia, viscous and Coulomb friction, gains of position and velocity of the
    # controller, largest DAC counts, counts per torque.
    motor: Floats
    cables: Floats  # (8, drives) of `Cables.packed`
    coupling: Floats  # (drives, drives) from link positions to drive positions
    ratio: Floats  # (drives,) motor rad per drive rad or m


def integrate(desired: Floats, gravity: Floats, cables: Cables, log_every: int) -> Floats:
    """Follow desired drive positions.

    Args:
        desired: (steps, 7) drive positions at 1 kHz, rad and m.
        gravity: (steps, 7) generalised gravity, N m and N.
        log_every: keep every so many steps.

    Returns:
        (kept, 6, 7): motor angle (encoder), filtered motor velocity, DAC counts, link position,
        desired motor angle, desired drive position.
    """
    omega = 2.0 * np.pi * CONTROL_HZ
    motor = np.array(
        [
            INERTIA,
            VISCOUS,
            COULOMB,
            INERTIA * omega**2,
            2.0 * CONTROL_DAMPING * omega * INERTIA,
            MAX_COUNTS,
            COUNTS_PER_TORQUE,
        ]
    )
    smoothing = 1.0 - np.exp(-2.0 * np.pi * VELOCITY_FILTER_HZ * STEP_S)
    targets = raven.motors_from_drives(desired)
    result: Floats = _integrate(
        targets,
        desired,
        gravity,
        _Mechanics(motor, cables.packed(), cables.coupling(), raven.RATIO),
        log_every,
        smoothing,
    )
    return result


@compiled
def _control(
    target: Floats,
    ahead: Floats,
    angle: Floats,
    motor: Floats,
    smoothing: float,
    previous: Floats,
    filtered: Floats,
    dac: Floats,
) -> None:
    """Encoder, velocity estimate and PD controller of one step."""
    for i in range(_N):
        seen = _encoder(angle[i])
        filtered[i] += smoothing * ((seen - previous[i]) / 1e-3 - filtered[i])
        previous[i] = seen
        goal_speed = (ahead[i] - target[i]) / 1e-3
        wish = motor[3, i] * (target[i] - seen) + motor[4, i] * (goal_speed - filtered[i])
        dac[i] = min(max(wish, -motor[5, i]), motor[5, i])


@compiled
def _encoder(angle: float) -> float:
    quantum = 2.0 * np.pi / 4000.0
    return np.floor(angle / quantum) * quantum


@compiled
def _pull(angle: Floats, link: Floats, mechanics: _Mechanics, tension: Floats) -> None:
    """Cable tension from stretch beyond the slack."""
    _, cables, coupling, ratio = mechanics
    for i in range(_N):
        pulled = 0.0
        for j in range(_N):
            pulled += coupling[i, j] * link[j]
        stretch = angle[i] / ratio[i] - pulled
        if stretch > cables[3, i]:
            stretch -= cables[3, i]
        elif stretch < -cables[3, i]:
            stretch += cables[3, i]
        else:
            stretch = 0.0
        linear = cables[0, i] * stretch
        tension[i] = linear * (1.0 + cables[1, i] * min(abs(linear) / cables[2, i], 3.0))


@compiled
def _move_links(
    gravity: Floats,
    tension: Floats,
    mechanics: _Mechanics,
    bristle: Floats,
    speed: Floats,
    link: Floats,
    dt: float,
) -> None:
    """Links with Dahl friction, pulled by their cables and by gravity."""
    _, cables, coupling, _ = mechanics
    for i in range(_N):
        torque = gravity[i]
        for j in range(_N):
            torque += coupling[j, i] * tension[j]
        rate = speed[i] / cables[5, i]
        bristle[i] += dt * (rate - abs(rate) * bristle[i])
        bristle[i] = min(max(bristle[i], -1.0), 1.0)
        push = torque - cables[4, i] * bristle[i] - cables[7, i] * speed[i]
        speed[i] += dt * push / cables[6, i]
        link[i] += dt * speed[i]


@compiled
def _move_motors(
    dac: Floats, tension: Floats, mechanics: _Mechanics, speed: Floats, angle: Floats, dt: float
) -> None:
    """Motors with Coulomb friction that can hold them still."""
    motor, _, _, ratio = mechanics
    for i in range(_N):
        load = tension[i] / ratio[i] * motor[6, i]
        drive = dac[i] - load - motor[1, i] * speed[i]
        free = speed[i] + dt * drive / motor[0, i]
        grip = dt * motor[2, i] / motor[0, i]
        if free > grip:
            speed[i] = free - grip
        elif free < -grip:
            speed[i] = free + grip
        else:
            speed[i] = 0.0
        angle[i] += dt * speed[i]


@compiled
def _integrate(
    targets: Floats,
    desired: Floats,
    gravity: Floats,
    mechanics: _Mechanics,
    log_every: int,
    smoothing: float,
) -> Floats:
    steps = len(targets)
    dt = 1e-3 / SUBSTEPS
    out = np.empty(((steps + log_every - 1) // log_every, 6, _N))
    angle, speed = targets[0].copy(), np.zeros(_N)
    link = np.linalg.solve(mechanics.coupling, targets[0] / mechanics.ratio)
    link_speed = np.zeros(_N)
    bristle, filtered, dac, tension = np.zeros((4, _N))
    previous = np.array([_encoder(a) for a in angle])
    for step in range(steps):
        ahead = targets[min(step + 1, steps - 1)]
        _control(targets[step], ahead, angle, mechanics.motor, smoothing, previous, filtered, dac)
        if step % log_every == 0:
            row = out[step // log_every]
            row[0], row[1], row[2] = previous, filtered, dac
            row[3], row[4], row[5] = link, targets[step], desired[step]
        for _ in range(SUBSTEPS):
            _pull(angle, link, mechanics, tension)
            _move_links(gravity[step], tension, mechanics, bristle, link_speed, link, dt)
            _move_motors(dac, tension, mechanics, speed, angle, dt)
    return out
