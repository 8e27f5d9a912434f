"""Continuous-time trajectories: the exact pose at any time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats
from measure.geometry import RigidTransform

_TERMS = 4  # sines in a random motion


class ContinuousTrajectory(Protocol):
    """A pose as a function of time."""

    def at(self, times_s: ArrayLike) -> RigidTransform:
        """world_from_body at times (...), a batch of the same shape."""
        ...


@dataclass(frozen=True, eq=False)
class Still:
    """A body that does not move."""

    world_from_body: RigidTransform

    def at(self, times_s: ArrayLike) -> RigidTransform:
        """world_from_body at times (...), a batch of the same shape."""
        shape = np.shape(times_s)
        return RigidTransform(
            np.broadcast_to(self.world_from_body.rotation, (*shape, 3, 3)),
            np.broadcast_to(self.world_from_body.translation, (*shape, 3)),
        )


@dataclass(frozen=True, eq=False)
class Sines:
    """A smooth trajectory: every coordinate is a sum of sines."""

    middle: RigidTransform  # pose about which the body moves
    amplitudes: Floats  # (k, 6) mm and rad, of x y z and the rotation vector
    frequencies_hz: Floats  # (k, 6)
    phases: Floats  # (k, 6) in rad

    def at(self, times_s: ArrayLike) -> RigidTransform:
        """world_from_body at times (...), a batch of the same shape."""
        times = np.asarray(times_s, dtype=np.float64)[..., None, None]
        turn = 2 * np.pi * self.frequencies_hz * times + self.phases
        delta = np.sum(self.amplitudes * np.sin(turn), axis=-2)
        # SciPy composes a single rotation by other code than a batch. Always a batch, so that the
        # pose at a time does not depend on the other times of the call.
        poses = self.middle.perturb(np.atleast_2d(delta))
        return poses if delta.ndim > 1 else poses[0]


@dataclass(frozen=True)
class MotionLimits:
    """Bounds of `random_motion`."""

    # largest distance from the middle along x, y and z.
    reach_mm: tuple[float, float, float] = (50.0, 50.0, 30.0)
    angle_rad: float = field(default=np.deg2rad(60.0))  # largest rotation from the middle
    speed_mm_s: float = 60.0  # largest speed of the body's origin
    turn_rad_s: float = 1.0  # largest angular speed
    slowest_hz: float = 0.05  # lowest frequency of the sines
    fastest_hz: float = 0.5  # highest frequency of the sines


def random_motion(seed: int, middle: RigidTransform, limits: MotionLimits | None = None) -> Sines:
    """A smooth random motion about `middle` that never exceeds `limits`.

    The bounds are those of the sums of amplitudes, so they hold at all times.
    """
    limits = limits or MotionLimits()
    rng = np.random.default_rng(seed)
    frequencies = rng.uniform(limits.slowest_hz, limits.fastest_hz, (_TERMS, 6))
    amplitudes = rng.uniform(0.3, 1.0, frequencies.shape) / frequencies
    amplitudes /= amplitudes.sum(axis=0)
    amplitudes[:, :3] *= limits.reach_mm
    amplitudes[:, 3:] *= limits.angle_rad / np.sqrt(3)
    peaks = np.sum(2 * np.pi * frequencies * amplitudes, axis=0)
    # Lower frequencies lower the speed and keep the reach.
    slower = max(
        float(np.linalg.norm(peaks[:3])) / limits.speed_mm_s,
        float(np.linalg.norm(peaks[3:])) / limits.turn_rad_s,
        1.0,
    )
    phases = rng.uniform(0, 2 * np.pi, frequencies.shape)
    return Sines(middle, amplitudes, frequencies / slower, phases)
