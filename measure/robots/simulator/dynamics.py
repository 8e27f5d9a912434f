"""Motors, cables and links at 1 kHz, compiled."""

from __future__ import annotations

import numba
import numpy as np

from measure.arrays import Floats
from measure.robots import raven
from measure.robots.simulator import constants as k
from measure.robots.simulator.constants import Cables

SUBSTEPS = 4
_N = raven.DRIVES


def integrate(desired: Floats, gravity: Floats, cables: Cables, log_every: int) -> Floats:
    """Follow desired drive positions.

    Args:
        desired: (steps, 7) drive positions at 1 kHz, rad and m.
        gravity: (steps, 7) generalised gravity, N m and N.
        cables: the mechanics.
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
        motor,
        cables.packed(),
        raven.coupling(),
        raven.RATIO,
        log_every,
        smoothing,
    )
    return result


@numba.njit(cache=True, fastmath=False)  # type: ignore[untyped-decorator]
def _integrate(
    targets: Floats,
    desired: Floats,
    gravity: Floats,
    motor: Floats,
    cables: Floats,
    coupling: Floats,
    ratio: Floats,
    log_every: int,
    smoothing: float,
) -> Floats:
    steps = len(targets)
    dt = 1e-3 / SUBSTEPS
    kept = (steps + log_every - 1) // log_every
    out = np.empty((kept, 6, _N))
    angle, speed = targets[0].copy(), np.zeros(_N)
    link, link_speed = desired[0].copy(), np.zeros(_N)
    bristle, filtered, dac = np.zeros(_N), np.zeros(_N), np.zeros(_N)
    tension, torque, pulled = np.zeros(_N), np.zeros(_N), np.zeros(_N)
    previous = np.zeros(_N)
    quantum = 2.0 * np.pi / 4000.0
    for step in range(steps):
        for i in range(_N):  # encoder, velocity estimate, PD controller
            seen = np.floor(angle[i] / quantum) * quantum
            if step == 0:
                previous[i] = seen
            filtered[i] += smoothing * ((seen - previous[i]) / 1e-3 - filtered[i])
            previous[i] = seen
            ahead = targets[min(step + 1, steps - 1), i]
            goal_speed = (ahead - targets[step, i]) / 1e-3
            wish = motor[3, i] * (targets[step, i] - seen) + motor[4, i] * (
                goal_speed - filtered[i]
            )
            dac[i] = min(max(wish, -motor[5, i]), motor[5, i])
        if step % log_every == 0:
            row = step // log_every
            for i in range(_N):
                out[row, 0, i], out[row, 1, i], out[row, 2, i] = previous[i], filtered[i], dac[i]
                out[row, 3, i], out[row, 4, i] = link[i], targets[step, i]
                out[row, 5, i] = desired[step, i]
        for _ in range(SUBSTEPS):
            for i in range(_N):  # cable tension from stretch beyond the slack
                pulled[i] = 0.0
                for j in range(i + 1):
                    pulled[i] += coupling[i, j] * link[j]
                stretch = angle[i] / ratio[i] - pulled[i]
                if stretch > cables[3, i]:
                    stretch -= cables[3, i]
                elif stretch < -cables[3, i]:
                    stretch += cables[3, i]
                else:
                    stretch = 0.0
                linear = cables[0, i] * stretch
                tension[i] = linear * (1.0 + cables[1, i] * min(abs(linear) / cables[2, i], 3.0))
            for i in range(_N):
                torque[i] = gravity[step, i]
                for j in range(i, _N):
                    torque[i] += coupling[j, i] * tension[j]
            for i in range(_N):  # links with Dahl friction
                rate = link_speed[i] / cables[5, i]
                bristle[i] += dt * (rate - abs(rate) * bristle[i])
                bristle[i] = min(max(bristle[i], -1.0), 1.0)
                push = torque[i] - cables[4, i] * bristle[i] - cables[7, i] * link_speed[i]
                link_speed[i] += dt * push / cables[6, i]
                link[i] += dt * link_speed[i]
            for i in range(_N):  # motors with Coulomb friction that can hold them still
                load = tension[i] / ratio[i] * motor[6, i]
                drive = dac[i] - load - motor[1, i] * speed[i]
                change = dt * drive / motor[0, i]
                grip = dt * motor[2, i] / motor[0, i]
                free = speed[i] + change
                if free > grip:
                    speed[i] = free - grip
                elif free < -grip:
                    speed[i] = free + grip
                else:
                    speed[i] = 0.0
                angle[i] += dt * speed[i]
    return out
