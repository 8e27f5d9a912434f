"""The offset between two computers' clocks, found from the motion both of them recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.errors import EstimatorError

_GRID_HZ = 100.0
_SPAN_S = 0.1  # velocities are differences over twice this
_LEAST_CORRELATION = 0.8
_SPARSE_S = 0.4  # poses farther apart miss most of a hand's motion


@dataclass(frozen=True)
class ClockOffset:
    """`robot time = camera time + offset_s`.

    Attributes:
        offset_s: the offset.
        sd_s: its standard deviation, from how sharply the velocities fit.
        correlation: of the two speeds at that offset; one if they agree perfectly.
    """

    offset_s: float
    sd_s: float
    correlation: float


def estimate_offset(
    camera_times_s: Floats,
    measured_mm: Floats,
    robot_times_s: Floats,
    reported_mm: Floats,
    *,
    largest_s: float = 5.0,
) -> ClockOffset:
    """Align measured and reported velocities.

    Speeds find the offset roughly (they need no common frame); velocities refine it. Velocities,
    not positions: hysteresis shifts positions along the motion as a delay would, but hardly
    changes how fast the tip moves.

    Args:
        camera_times_s: (n,) and
        measured_mm: (n, 3) positions on the cameras' clock.
        robot_times_s: (m,) and
        reported_mm: (m, 3) positions on the robot's clock.
        largest_s: search within plus and minus this around equal clocks.

    Raises:
        EstimatorError: too little motion in common, or no offset makes the speeds agree.
    """
    grid = _common_times(camera_times_s, robot_times_s, largest_s)
    measured = _velocity(camera_times_s, measured_mm, grid)
    lags, scores = _scores(measured, grid, robot_times_s, reported_mm, largest_s)
    best = int(np.nanargmax(scores)) if np.isfinite(scores).any() else 0
    if not scores[best] >= _LEAST_CORRELATION:
        step = float(np.median(np.diff(camera_times_s)))
        hint = f" Poses every {step:.2g} s hardly show speeds: give the clock offset."
        raise EstimatorError(
            f"no clock offset within {largest_s:g} s makes the measured and the reported speed "
            f"agree (best correlation {scores[best]:.2f}): is this the log of this recording?"
            + (hint if step > _SPARSE_S else "")
        )
    return _refine(
        measured, robot_times_s, reported_mm, grid, lags[best] / _GRID_HZ, float(scores[best])
    )


def _common_times(camera_s: Floats, robot_s: Floats, largest_s: float) -> Floats:
    start = max(camera_s[0], robot_s[0] - largest_s) + _SPAN_S
    stop = min(camera_s[-1], robot_s[-1] + largest_s) - _SPAN_S
    if stop - start < 2.0:
        raise EstimatorError(
            f"cameras ({camera_s[0]:.1f} to {camera_s[-1]:.1f} s) and robot "
            f"({robot_s[0]:.1f} to {robot_s[-1]:.1f} s) share less than 2 s of motion: "
            "give the clock offset, or the log of this recording"
        )
    return np.arange(start, stop, 1.0 / _GRID_HZ)


def _scores(
    measured: Floats, grid: Floats, times: Floats, positions: Floats, largest_s: float
) -> tuple[Ints, Floats]:
    """How well the speeds match at every lag (in grid steps) within the search range."""
    reach, count = round(largest_s * _GRID_HZ), len(grid)
    lags = np.arange(-reach, reach + 1)
    wide = np.arange(count + 2 * reach) / _GRID_HZ + (grid[0] - reach / _GRID_HZ)
    inside = (wide > times[0] + _SPAN_S) & (wide < times[-1] - _SPAN_S)
    speed = np.linalg.norm(measured, axis=1)
    other = np.linalg.norm(_velocity(times, positions, wide), axis=1)
    scores = [_match(speed, other[i : i + count], inside[i : i + count]) for i in lags + reach]
    return lags, np.array(scores)


def _velocity(times: Floats, positions: Floats, at: Floats) -> Floats:
    ahead, behind = (
        np.stack([np.interp(at + side * _SPAN_S, times, positions[:, i]) for i in range(3)], axis=1)
        for side in (1.0, -1.0)
    )
    return (ahead - behind) / (2.0 * _SPAN_S)


def _match(speed: Floats, other: Floats, inside: Bools) -> float:
    """Correlation of two speeds where both are known; NaN where too little is, or nothing moves."""
    a, b = speed[inside], other[inside]
    if len(a) < _GRID_HZ or a.std() < 1e-6 or b.std() < 1e-6:
        return float("nan")
    return float(np.mean((a - a.mean()) * (b - b.mean())) / (a.std() * b.std()))


def _refine(
    measured: Floats, times: Floats, positions: Floats, grid: Floats, lag: float, score: float
) -> ClockOffset:
    """Gauss-Newton on the offset and the 3x3 map from reported to measured velocities."""
    variance, curvature = 1.0, 1.0
    for _ in range(10):
        at = grid + lag
        inside = (at > times[0] + 2 * _SPAN_S) & (at < times[-1] - 2 * _SPAN_S)
        wanted = measured[inside]
        velocity = _velocity(times, positions, at[inside])
        slope = (
            _velocity(times, positions, at[inside] + 0.01)
            - _velocity(times, positions, at[inside] - 0.01)
        ) / 0.02
        turn = np.linalg.lstsq(velocity, wanted, rcond=None)[0]
        residual, change = wanted - velocity @ turn, slope @ turn
        curvature = float((change**2).sum())
        step = float((residual * change).sum()) / curvature
        lag += float(np.clip(step, -0.02, 0.02))
        variance = float((residual**2).mean())
        if abs(step) < 1e-6:
            break
    # Samples closer than the velocity span are not independent.
    return ClockOffset(lag, float(np.sqrt(variance * 2 * _SPAN_S * _GRID_HZ / curvature)), score)
