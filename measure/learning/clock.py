"""The offset between two computers' clocks, found from the motion both of them recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import correlate

from measure.arrays import Bools, Floats
from measure.errors import EstimatorError

_GRID_HZ = 100.0
_SPAN_S = 0.1  # velocities are differences over twice this
_LEAST_MOTION_S = 8.0  # shorter motions of one hand resemble each other
_LEAST_SHARE = 0.5  # of the shorter recording must lie in the other
_ENOUGH_S = 1e5  # of motion; what is beyond is not compared
_GAP_S, _GAP_STEPS = 0.3, 3.0  # steps longer than both, the latter in usual steps, are gaps
_SLOPE_S = 0.01
_LEAST_CORRELATION = 0.9
_APART_S = 0.5  # offsets farther apart are different answers
_LEAST_ADVANTAGE = 3.0  # what is left of the motion at any other offset, over what is left at best
_ALIKE_S = 2.0  # residuals closer than this may belong together
_AROUND = 5  # positions whose median one is compared with
_LEAST_KEPT = 0.8  # of the positions; false detections are fewer than the rest
_SPARSE_S = 0.4  # poses farther apart miss most of a hand's motion


@dataclass(frozen=True)
class ClockOffset:
    """`robot time = camera time + offset_s`.

    Attributes:
        offset_s: the offset.
        sd_s: its standard deviation, from how sharply the velocities fit and how long what is
            left of them keeps its sign.
        correlation: of the two velocities at that offset, one turned into the other's frame; one
            if they agree perfectly.
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

    At every offset the reported velocities are turned into the measured ones as well as a rotation
    can; the offset at which they agree best is refined. Velocities, not positions: hysteresis
    shifts positions along the motion as a delay would, but hardly changes how fast the tip moves.

    Args:
        camera_times_s: (n,) and
        measured_mm: (n, 3) positions on the cameras' clock.
        robot_times_s: (m,) and
        reported_mm: (m, 3) positions on the robot's clock.
        largest_s: search within plus and minus this around equal clocks.

    Raises:
        EstimatorError: too little motion in common, no offset makes the velocities agree, or
            several do (motion that repeats itself).
    """
    robot = _Motion(robot_times_s, reported_mm)
    cameras = _without_slips(_Motion(camera_times_s, measured_mm), robot)
    grid = _common_times(cameras.times_s, robot.times_s, largest_s)
    lags, scores = _agreements(cameras, robot, grid, largest_s)
    best = int(np.argmax(scores))
    if not scores[best] >= _LEAST_CORRELATION:
        step = float(np.median(np.diff(camera_times_s)))
        hint = f" Poses every {step:.2g} s hardly show speeds: give the clock offset."
        raise EstimatorError(
            f"no clock offset within {largest_s:g} s makes the measured and the reported velocity "
            f"agree (best correlation {scores[best]:.2f}): is this the log of this recording, "
            "and no axis reversed?" + (hint if step > _SPARSE_S else "")
        )
    rival = int(np.argmax(np.where(np.abs(lags - lags[best]) > _APART_S, scores, 0.0)))
    if 1 - scores[rival] ** 2 < _LEAST_ADVANTAGE * (1 - scores[best] ** 2):
        raise EstimatorError(
            f"the motion fits clock offsets of {lags[best]:.2f} s and {lags[rival]:.2f} s alike "
            f"(correlations {scores[best]:.2f} and {scores[rival]:.2f}), as it repeats itself or "
            "is too short: give the clock offset"
        )
    return _refine(cameras, robot, grid, float(lags[best]), float(scores[best]))


def _common_times(camera_s: Floats, robot_s: Floats, largest_s: float) -> Floats:
    start = max(camera_s[0], robot_s[0] - largest_s)
    stop = min(camera_s[-1], robot_s[-1] + largest_s, start + _ENOUGH_S)
    if min(stop - start, robot_s[-1] - robot_s[0]) < _LEAST_MOTION_S:
        raise _too_little(camera_s, robot_s)
    return np.arange(start, stop, 1.0 / _GRID_HZ)


def _too_little(camera_s: Floats, robot_s: Floats) -> EstimatorError:
    return EstimatorError(
        f"cameras ({camera_s[0]:.1f} to {camera_s[-1]:.1f} s) and robot ({robot_s[0]:.1f} to "
        f"{robot_s[-1]:.1f} s) share less than {_LEAST_MOTION_S:g} s of motion: give the clock "
        "offset, or the log of this recording"
    )


@dataclass(frozen=True, eq=False)
class _Motion:
    """Positions (n, 3) in mm over times (n,) in s, and what lies between them."""

    times_s: Floats
    positions_mm: Floats

    def velocity(self, at_s: Floats) -> Floats:
        """Velocities (m, 3) in mm/s at instants (m,); 0 where a gap or an end is near."""
        ahead, behind = (
            np.stack([np.interp(at, self.times_s, axis) for axis in self.positions_mm.T], axis=1)
            for at in (at_s + _SPAN_S, at_s - _SPAN_S)
        )
        return (ahead - behind) / (2.0 * _SPAN_S) * self.known(at_s)[:, None]

    def known(self, at_s: Floats) -> Bools:
        """Whether velocities at instants (m,) bridge no gap and pass no end."""
        steps = np.diff(self.times_s)
        gaps = steps > max(_GAP_S, _GAP_STEPS * float(np.median(steps)))
        before = np.concatenate([[0], np.cumsum(gaps)])  # gaps before every sample
        first = np.searchsorted(self.times_s, at_s - _SPAN_S, side="right") - 1
        last = np.searchsorted(self.times_s, at_s + _SPAN_S, side="left")
        inside = (first >= 0) & (last < len(self.times_s))
        bridged = before[np.minimum(last, len(gaps))] - before[np.maximum(first, 0)]
        return np.asarray(inside & (bridged == 0))


def _without_slips(cameras: _Motion, robot: _Motion) -> _Motion:
    """What was measured, but for single positions that the robot cannot have got to and back from.

    These are further from the median of the five around them than it ever goes in their time: one
    false detection is a velocity that outweighs all others.
    """
    moving = robot.velocity(robot.times_s)
    fastest = float(np.linalg.norm(moving, axis=1).max())
    middle = median_filter(cameras.positions_mm, size=(_AROUND, 1), mode="mirror")
    off = np.linalg.norm(cameras.positions_mm - middle, axis=1)
    side, last = _AROUND // 2, len(off) - 1
    at = np.arange(len(off))
    first, stop = np.maximum(at - side, 0), np.minimum(at + side, last)
    kept = off <= fastest * (cameras.times_s[stop] - cameras.times_s[first])
    if kept.mean() < _LEAST_KEPT:  # another unit, or another robot's log: not for here to say
        return cameras
    return _Motion(cameras.times_s[kept], cameras.positions_mm[kept])


def _agreements(
    cameras: _Motion, robot: _Motion, grid: Floats, largest_s: float
) -> tuple[Floats, Floats]:
    """How well the velocities agree at every offset of the search range, after a rotation.

    Returns:
        Offsets (n,) in s and correlations (n,), 0 where too little motion is in common: the sum of
        the singular values of the velocities' cross products, the last one with the sign of a
        rotation, over the root of both sums of squares (Kabsch 1976).

    Raises:
        EstimatorError: too little is in common at any offset.
    """
    reach = round(largest_s * _GRID_HZ)
    lags = np.arange(-reach, reach + 1) / _GRID_HZ
    wide = np.arange(len(grid) + 2 * reach) / _GRID_HZ + (grid[0] - largest_s)
    measured, reported = cameras.velocity(grid), robot.velocity(wide)
    seen, told = cameras.known(grid).astype(np.float64), robot.known(wide).astype(np.float64)
    common_s = _sliding(told, seen) / _GRID_HZ
    shorter_s = min(seen.sum(), told.sum()) / _GRID_HZ
    if not common_s.max() > _LEAST_MOTION_S:
        raise _too_little(cameras.times_s, robot.times_s)
    cross = [[_sliding(theirs, ours) for theirs in reported.T] for ours in measured.T]
    u, values, v = np.linalg.svd(np.moveaxis(np.array(cross), 2, 0))
    values[:, 2] *= np.sign(np.linalg.det(u @ v))
    squares = _sliding(told, (measured**2).sum(axis=1)) * _sliding((reported**2).sum(axis=1), seen)
    enough = (common_s > max(_LEAST_MOTION_S, _LEAST_SHARE * shorter_s)) & (squares > 1e-6)
    return lags, np.where(enough, values.sum(axis=1) / np.sqrt(np.where(enough, squares, 1)), 0.0)


def _sliding(long: Floats, short: Floats) -> Floats:
    """Sums of products of `short` with every stretch of `long`."""
    return np.asarray(correlate(long, short, mode="valid", method="fft"))


def _refine(
    cameras: _Motion, robot: _Motion, grid: Floats, lag: float, score: float
) -> ClockOffset:
    """Gauss-Newton on the offset and the 3x3 map from reported to measured velocities."""
    pull, curvature = np.zeros(1), 1.0
    for _ in range(10):
        inside = cameras.known(grid)
        for side in (-_SLOPE_S, 0.0, _SLOPE_S):
            inside &= robot.known(grid + lag + side)
        at = grid[inside] + lag
        wanted, velocity = cameras.velocity(grid[inside]), robot.velocity(at)
        slope = (robot.velocity(at + _SLOPE_S) - robot.velocity(at - _SLOPE_S)) / (2 * _SLOPE_S)
        turn = np.linalg.lstsq(velocity, wanted, rcond=None)[0]
        residual, change = wanted - velocity @ turn, slope @ turn
        pull, curvature = (residual * change).sum(axis=1), float((change**2).sum())
        step = float(pull.sum()) / curvature
        lag += float(np.clip(step, -0.02, 0.02))
        if abs(step) < 1e-6:
            break
    return ClockOffset(lag, float(np.sqrt(_variance_of_sum(pull)) / curvature), score)


def _variance_of_sum(pull: Floats) -> float:
    """Of the sum of a stationary series (n,), with lags up to `_ALIKE_S` (Newey and West 1987)."""
    reach = min(round(_ALIKE_S * _GRID_HZ), len(pull) - 1)
    products = correlate(pull, pull, mode="full", method="fft")[len(pull) - 1 :][: reach + 1]
    weights = 1 - np.arange(reach + 1) / (reach + 1)
    return float(2 * weights @ products - products[0])
