"""Free motion as a human operator makes it: reaches, pauses, wrist turns, a trace of tremor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from measure.arrays import Floats
from measure.robots.raven import DRIVES, Arm, raven_chain

PLAN_HZ = 50.0
_CENTRE = np.array([np.deg2rad(40.0), np.deg2rad(90.0), 350.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Teleoperation:
    """How the operator moves; assumptions, of the size of a surgical training task.

    Attributes:
        half_box_mm: half the sides of the workspace box, in the arm's base frame.
        reach_mm: SD of one reach, per axis.
        reach_s: shortest and longest duration of a reach.
        pause: chance of a pause after a reach.
        pause_s: longest pause.
        wrist_deg: largest roll, wrist and jaw-pair angle.
        tremor_mm: SD of the 9 Hz tremor, per axis.
    """

    half_box_mm: tuple[float, float, float] = (35.0, 35.0, 30.0)
    reach_mm: float = 22.0
    reach_s: tuple[float, float] = (0.7, 2.5)
    pause: float = 0.25
    pause_s: float = 1.5
    wrist_deg: tuple[float, float, float] = (60.0, 45.0, 40.0)
    tremor_mm: float = 0.03


def plan(
    duration_s: float,
    rng: np.random.Generator,
    arm: Arm = "left",
    style: Teleoperation | None = None,
) -> Floats:
    """Desired drive positions (steps, 7) at 1 kHz, in rad and m."""
    style = style or Teleoperation()
    times = np.arange(0.0, duration_s + 2.0 / PLAN_HZ, 1.0 / PLAN_HZ)
    offset = _reaches(times, np.array(style.half_box_mm), style.reach_mm, rng, style)
    offset += _tremor(times, style.tremor_mm, rng)
    limits = np.deg2rad(style.wrist_deg)
    wrist = np.concatenate(
        [_reaches(times, limits[i : i + 1], 0.4 * limits[i], rng, style) for i in range(3)], axis=1
    )
    opening = np.deg2rad(20.0) + _reaches(times, np.deg2rad([20.0]), np.deg2rad(15.0), rng, style)
    chain = raven_chain(arm)
    start = np.tile(_centre(arm), (len(times), 1))
    start[:, 3:] = wrist
    home = chain.tip_mm(_centre(arm))
    q = chain.solve_tip(home + offset, start, (0, 1, 2), tolerance_mm=1e-4)
    drives = np.empty((len(times), DRIVES))
    drives[:, :2], drives[:, 2], drives[:, 3:5] = q[:, :2], 1e-3 * q[:, 2], q[:, 3:5]
    drives[:, 5] = q[:, 5] + 0.5 * opening[:, 0]
    drives[:, 6] = -q[:, 5] + 0.5 * opening[:, 0]
    fine = np.arange(round(duration_s * 1000)) * 1e-3
    return np.ascontiguousarray(CubicSpline(times, drives)(fine))


def _centre(arm: Arm) -> Floats:
    return _CENTRE if arm == "left" else _CENTRE * np.array([1, 1, 1, -1, 1, 1])


def _reaches(
    times: Floats,
    half: Floats,
    size: Floats | float,
    rng: np.random.Generator,
    style: Teleoperation,
) -> Floats:
    """Minimum-jerk reaches between random points of a box, with pauses: (times, axes)."""
    count = int(times[-1] / style.reach_s[0]) + 4
    moves = rng.uniform(*style.reach_s, count)
    rests = np.where(rng.random(count) < style.pause, rng.uniform(0.1, style.pause_s, count), 0.0)
    starts = np.concatenate([[0.0], np.cumsum(moves + rests)[:-1]])
    points = np.zeros((count + 1, len(half)))
    for index in range(count):
        step = points[index] + rng.normal(0.0, size, len(half))
        points[index + 1] = half - np.abs((step + half) % (4.0 * half) - 2.0 * half)
    which = np.clip(np.searchsorted(starts, times, "right") - 1, 0, count - 1)
    s = np.clip((times - starts[which]) / moves[which], 0.0, 1.0)
    blend = (s**3 * (10.0 - 15.0 * s + 6.0 * s**2))[:, None]
    return points[which] + blend * (points[which + 1] - points[which])


def _tremor(times: Floats, size_mm: float, rng: np.random.Generator) -> Floats:
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    swell = 1.0 + 0.5 * np.sin(2.0 * np.pi * 0.3 * times)[:, None]
    return np.sqrt(2.0) * size_mm * swell * np.sin(2.0 * np.pi * 9.0 * times[:, None] + phase)
