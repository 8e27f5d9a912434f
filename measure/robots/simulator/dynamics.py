"""Motors, cables and links at 1 kHz, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.robots import raven
from measure.robots.simulator import constants as k
from measure.robots.simulator.constants import Cables

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
    omega = 2.0 * np.pi * k.CONTROL_HZ
    motor = np.array(
        [
            k.INERTIA,
            k.VISCOUS,
            k.COULOMB,
            k.INERTIA * omega**2,
            2.0 * k.CONTROL_DAMPING * omega * k.INERTIA,
            k.MAX_COUNTS,
            k.COUNTS_PER_TORQUE,
        ]
    )
    smoothing = 1.0 - np.exp(-2.0 * np.pi * k.VELOCITY_FILTER_HZ * k.STEP_S)
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
