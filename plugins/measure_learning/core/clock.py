"""The offset between two computers' clocks, found from the motion both of them recorded."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import correlate

from measure.arrays import Bools, Floats, Ints
from measure.errors import EstimatorError
from measure.limits import CLEAR_RATIO

_GRID_HZ = 100.0
_HALF_SPAN_S = 0.1  # velocities are differences of positions over twice this time
_MIN_MOTION_S = 8.0  # shorter motions of one operator resemble each other
_MIN_COMMON_SHARE = 0.5  # of the shorter recording that must overlap the other
_MAX_COMPARED_S = 1e5  # longest stretch of motion that is compared
MAX_SEARCHED_S = 2e4  # range of offsets: arrays of two million, nine at a time
_GAP_S, _GAP_STEPS = 0.3, 3.0  # a step longer than both (s, median steps) is a gap
SLOPE_S = 0.01
_MIN_CORRELATION = 0.9
_MIN_RIVAL_DISTANCE_S = 0.5  # offsets nearer to the best one are not its rivals
_MAX_CORRELATION_S = 2.0  # residuals closer in time than this may be correlated
_MEDIAN_SAMPLES = 5  # window of the median filter that finds outliers
MIN_KEPT_SHARE = 0.7  # of the positions; more outliers than the rest mean another cause
# of what the fit leaves, as a delay, that a robot's cables made of it: RMS, `benchmarks.clock`.
_DELAY_SHARE = 0.5
_ROUGH_HZ = 10.0  # of a search that only has to find the place
_PIECE = 1 << 16  # instants compared at a time
SPARSE_S = 0.4  # poses farther apart in time miss most of the motion


@dataclass(frozen=True)
class ClockOffset:
    """`robot time = camera time + offset_s`."""

    offset_s: float
    # its standard deviation: chance, from the curvature of the fit and the autocorrelation of its
    # residuals, and the robot's own delay, which looks like an offset, from the residuals' size.
    sd_s: float
    correlation: float  # of the two velocities at that offset, rotated into one frame; at most 1


def estimate_offset(
    camera_times_s: Floats,
    measured_mm: Floats,
    robot_times_s: Floats,
    reported_mm: Floats,
    *,
    largest_s: float = 5.0,
) -> ClockOffset:
    """Align measured (n, 3) and reported (m, 3) velocities, by positions in mm on either clock.

    At every offset the reported velocities are rotated onto the measured ones (least squares); the
    offset of the largest correlation is refined. Velocities are compared because hysteresis shifts
    positions along the motion as a delay does, but hardly changes velocities. Clocks of different
    origin (seconds since 1970, seconds since the robot was switched on) share no time within
    `largest_s`: then every offset is searched at which the recordings overlap. EstimatorError: too
    little motion in common, no offset within `largest_s` makes the velocities agree, or several do
    (motion that repeats itself).
    """
    apart_s = robot_times_s[0] - camera_times_s[0]
    length_s = max(np.ptp(robot_times_s), np.ptp(camera_times_s))
    if not abs(apart_s) < length_s + largest_s:
        found = estimate_offset(
            camera_times_s - camera_times_s[0],
            measured_mm,
            robot_times_s - robot_times_s[0],
            reported_mm,
            largest_s=min(float(length_s), MAX_SEARCHED_S / 2),
        )
        return replace(found, offset_s=found.offset_s + apart_s)
    robot = _PositionTrack(robot_times_s, reported_mm)
    cameras = _without_outliers(_PositionTrack(camera_times_s, measured_mm), robot)
    grid = _common_times(cameras.times_s, robot.times_s, largest_s)
    lags, scores = _agreements(cameras, robot, grid, largest_s)
    best = int(np.argmax(scores))
    if not scores[best] >= _MIN_CORRELATION:
        hint = _sparse_hint(camera_times_s, robot_times_s)
        raise EstimatorError(
            f"no clock offset within {largest_s:g} s makes the measured and the reported velocity "
            f"agree (best correlation {scores[best]:.2f}): is this the log of this recording, "
            f"no axis reversed, and the tip the body's origin (else `measure register`)?{hint}"
        )
    rival = int(np.argmax(np.where(np.abs(lags - lags[best]) > _MIN_RIVAL_DISTANCE_S, scores, 0.0)))
    if 1 - scores[rival] ** 2 < CLEAR_RATIO * (1 - scores[best] ** 2):
        raise EstimatorError(
            f"the motion fits clock offsets of {lags[best]:.2f} s and {lags[rival]:.2f} s alike "
            f"(correlations {scores[best]:.2f} and {scores[rival]:.2f}), as it repeats itself or "
            "is too short: give the clock offset"
        )
    return _refine(cameras, robot, grid, float(lags[best]), float(scores[best]))


def _sparse_hint(camera_times_s: Floats, robot_times_s: Floats) -> str:
    """Says of times that lie too far apart that these may be why no speeds agree."""
    step, own = (float(np.median(np.diff(t))) for t in (camera_times_s, robot_times_s))
    what, longest = max(("Poses", step), ("States", own), key=lambda pair: pair[1])
    if longest <= SPARSE_S:
        return ""
    return f" {what} every {longest:.3g} s hardly show speeds: if that is in s, give the offset."


def _common_times(camera_s: Floats, robot_s: Floats, largest_s: float) -> Floats:
    start = max(camera_s[0], robot_s[0] - largest_s)
    stop = min(camera_s[-1], robot_s[-1] + largest_s, start + _MAX_COMPARED_S)
    if min(stop - start, robot_s[-1] - robot_s[0]) < _MIN_MOTION_S:
        raise _too_little(camera_s, robot_s)
    return np.arange(start, stop, 1.0 / _GRID_HZ)


def _too_little(camera_s: Floats, robot_s: Floats) -> EstimatorError:
    return EstimatorError(
        f"cameras ({camera_s[0]:.1f} to {camera_s[-1]:.1f} s) and robot ({robot_s[0]:.1f} to "
        f"{robot_s[-1]:.1f} s) share less than {_MIN_MOTION_S:g} s of motion: give the clock "
        "offset, or the log of this recording"
    )


@dataclass(frozen=True, eq=False)
class _PositionTrack:
    """Positions (n, 3) in mm at times (n,) in s, and velocities between them."""

    times_s: Floats
    positions_mm: Floats

    def velocity(self, at_s: Floats) -> Floats:
        """Velocities (m, 3) in mm/s at instants (m,); 0 where a gap or an end is near."""
        ahead, behind = (
            np.stack([np.interp(at, self.times_s, axis) for axis in self.positions_mm.T], axis=1)
            for at in (at_s + _HALF_SPAN_S, at_s - _HALF_SPAN_S)
        )
        return (ahead - behind) / (2.0 * _HALF_SPAN_S) * self.known(at_s)[:, None]

    def known(self, at_s: Floats) -> Bools:
        """Whether velocities at instants (m,) bridge no gap and pass no end."""
        before = self._gaps_before
        first = np.searchsorted(self.times_s, at_s - _HALF_SPAN_S, side="right") - 1
        last = np.searchsorted(self.times_s, at_s + _HALF_SPAN_S, side="left")
        inside = (first >= 0) & (last < len(self.times_s))
        bridged = before[np.minimum(last, len(before) - 1)] - before[np.maximum(first, 0)]
        return np.asarray(inside & (bridged == 0))

    @cached_property
    def _gaps_before(self) -> Ints:
        """Number of gaps before every sample (n,)."""
        steps = np.diff(self.times_s)
        gaps = steps > max(_GAP_S, _GAP_STEPS * float(np.median(steps)))
        return np.concatenate([[0], np.cumsum(gaps)])

    def fastest(self) -> float:
        """Largest speed at its own instants, mm/s."""
        pieces = (
            self.times_s[start : start + _PIECE] for start in range(0, len(self.times_s), _PIECE)
        )
        return max(float(np.linalg.norm(self.velocity(at), axis=1).max()) for at in pieces)


def _without_outliers(cameras: _PositionTrack, robot: _PositionTrack) -> _PositionTrack:
    """The measured track without single positions that the robot cannot have reached.

    They are farther from the median of five neighbours than the robot's largest speed allows. One
    false detection would outweigh all other velocities.
    """
    fastest = robot.fastest()
    middle = median_filter(cameras.positions_mm, size=(_MEDIAN_SAMPLES, 1), mode="mirror")
    off = np.linalg.norm(cameras.positions_mm - middle, axis=1)
    side, last = _MEDIAN_SAMPLES // 2, len(off) - 1
    at = np.arange(len(off))
    first, stop = np.maximum(at - side, 0), np.minimum(at + side, last)
    kept = off <= fastest * (cameras.times_s[stop] - cameras.times_s[first])
    if kept.mean() < MIN_KEPT_SHARE:  # another unit, or the log of another robot
        return cameras
    return _PositionTrack(cameras.times_s[kept], cameras.positions_mm[kept])


def _agreements(
    cameras: _PositionTrack, robot: _PositionTrack, grid: Floats, largest_s: float
) -> tuple[Floats, Floats]:
    """Correlation of the velocities at every offset of the search range, after a rotation.

    Offsets (n,) in s and correlations (n,), 0 where too little motion is in common: the sum of the
    singular values of the velocities' cross products, the last one with the sign of a rotation,
    over the root of both sums of squares (Kabsch 1976).
    """
    lags = _offsets(cameras.times_s, robot.times_s, largest_s)
    wide = np.arange(len(grid) + len(lags) - 1) / _GRID_HZ + (grid[0] + lags[0])
    measured, reported = cameras.velocity(grid), robot.velocity(wide)
    measured_known = cameras.known(grid).astype(np.float64)
    reported_known = robot.known(wide).astype(np.float64)
    common_s = _sliding(reported_known, measured_known) / _GRID_HZ
    shorter_s = min(measured_known.sum(), reported_known.sum()) / _GRID_HZ
    if not common_s.max() > _MIN_MOTION_S:
        raise _too_little(cameras.times_s, robot.times_s)
    cross = [[_sliding(theirs, ours) for theirs in reported.T] for ours in measured.T]
    products = np.moveaxis(np.array(cross), 2, 0)
    values = np.linalg.svd(products, compute_uv=False)
    values[:, 2] *= np.sign(np.linalg.det(products))
    squares = _sliding(reported_known, (measured**2).sum(axis=1)) * _sliding(
        (reported**2).sum(axis=1), measured_known
    )
    enough = (common_s > max(_MIN_MOTION_S, _MIN_COMMON_SHARE * shorter_s)) & (squares > 1e-6)
    return lags, np.where(enough, values.sum(axis=1) / np.sqrt(np.where(enough, squares, 1)), 0.0)


def _offsets(camera_s: Floats, robot_s: Floats, largest_s: float) -> Floats:
    """The offsets (n,) in s within +- `largest_s` at which the recordings overlap at all."""
    first = max(-largest_s, robot_s[0] - camera_s[-1])
    last = min(largest_s, robot_s[-1] - camera_s[0])
    if last - first > MAX_SEARCHED_S:
        raise EstimatorError(
            f"clock offsets from {first:.6g} to {last:.6g} s are too many to search: give the "
            f"offset, or one to search within ({MAX_SEARCHED_S:g} s in all)"
        )
    if not last > first:
        raise _too_little(camera_s, robot_s)
    return np.arange(round(first * _GRID_HZ), round(last * _GRID_HZ) + 1) / _GRID_HZ


def _sliding(long: Floats, short: Floats) -> Floats:
    """Sums of products of `short` with every stretch of `long`."""
    return np.asarray(correlate(long, short, mode="valid", method="fft"))


def _stretches(long: Floats, length: int) -> Floats:
    """Sums of every stretch of so many of `long`."""
    sums = np.cumsum(np.pad(long, (1, 0)))
    return np.asarray(sums[length:] - sums[:-length])


def _refine(
    cameras: _PositionTrack, robot: _PositionTrack, grid: Floats, lag: float, score: float
) -> ClockOffset:
    """Gauss-Newton on the offset and the 3x3 map from reported to measured velocities."""
    pull, curvature = np.zeros(1), 1.0
    for _ in range(10):
        inside = cameras.known(grid)
        for side in (-SLOPE_S, 0.0, SLOPE_S):
            inside &= robot.known(grid + lag + side)
        at = grid[inside] + lag
        wanted, velocity = cameras.velocity(grid[inside]), robot.velocity(at)
        slope = (robot.velocity(at + SLOPE_S) - robot.velocity(at - SLOPE_S)) / (2 * SLOPE_S)
        turn = np.linalg.lstsq(velocity, wanted, rcond=None)[0]
        residual, change = wanted - velocity @ turn, slope @ turn
        pull, curvature = (residual * change).sum(axis=1), float((change**2).sum())
        step = float(pull.sum()) / curvature
        lag += float(np.clip(step, -0.02, 0.02))
        if abs(step) < 1e-6:
            break
    variance = _variance_of_sum(pull) / curvature**2 + _own_delay_s(residual, curvature) ** 2
    return ClockOffset(lag, float(np.sqrt(variance)), score)


def rough_offset(
    camera_times_s: Floats, twists: Floats, robot_times_s: Floats, rates: Floats
) -> tuple[float, float]:
    """The offset at which two motions depend on each other most, whatever the dependence is.

    A body's velocities and turns, as it sees them, are nearly linear in the joints' rates: in any
    order, sign and unit of the joints, and in any axes of the cameras, mirrored or inverted ones
    too. So this finds the clock of a recording whose joints or poses are wrong.

    Args:
        camera_times_s: (n,) increasing.
        twists: (n, k) of the body.
        robot_times_s: (m,) increasing.
        rates: (m, joints).

    Returns:
        The offset, robot minus camera time, to a tenth of a second, and the share of the twists'
        variance that the rates explain there; (nan, 0) for too little time in common, or too much.
    """
    start_s, robot_start_s = camera_times_s[0], robot_times_s[0]
    if max(np.ptp(camera_times_s), np.ptp(robot_times_s)) > _MAX_COMPARED_S:
        return float("nan"), 0.0
    ours = _on_grid(camera_times_s - start_s, twists)
    theirs = _on_grid(robot_times_s - robot_start_s, rates[:, rates.std(axis=0) > 0])
    least = round(max(_MIN_MOTION_S, 0.5 * min(len(ours), len(theirs)) / _ROUGH_HZ) * _ROUGH_HZ)
    moves = theirs.size and ours.std(axis=0).any()
    if not least < min(len(ours), len(theirs), MAX_SEARCHED_S * _ROUGH_HZ) or not moves:
        return float("nan"), 0.0
    ours, theirs = (x - x.mean(axis=0) for x in (ours[:, ours.std(axis=0) > 0], theirs))
    edge = len(ours) - least
    wide = np.pad(theirs, ((edge, edge), (0, 0)))
    within = np.pad(np.ones(len(theirs)), edge)
    count = _stretches(within, len(ours))
    S = np.empty((len(count), wide.shape[1], wide.shape[1]))
    X = np.empty((len(count), wide.shape[1], ours.shape[1]))
    for a, theirs_a in enumerate(wide.T):
        for b in range(a + 1):
            S[:, a, b] = S[:, b, a] = _stretches(theirs_a * wide[:, b], len(ours)) / count
        for b, ours_b in enumerate((ours / ours.std(axis=0)).T):
            X[:, a, b] = _sliding(theirs_a, ours_b) / count
    floor = 1e-6 * np.trace(S, axis1=1, axis2=2).max() * np.eye(len(S[0]))
    explained = np.einsum("lab,lab->l", X, np.linalg.solve(S + floor, X)) / ours.shape[1]
    best = int(np.argmax(explained))
    return (best - edge) / _ROUGH_HZ + robot_start_s - start_s, float(explained[best])


def _on_grid(times_s: Floats, values: Floats) -> Floats:
    """Values (n, k) on the grid of the rough search, from 0 on."""
    grid = np.arange(0.0, times_s[-1], 1 / _ROUGH_HZ)
    return np.stack([np.interp(grid, times_s, column) for column in values.T], axis=1)


def _own_delay_s(residual: Floats, curvature: float) -> float:
    """SD of the delay of slack or soft cables: motion that no map explains (n, 3) shows how much.

    Residuals half a span apart share no noise of the positions, but what the robot does.
    """
    apart = round(_HALF_SPAN_S * _GRID_HZ)
    common = float((residual[apart:] * residual[:-apart]).sum())
    return _DELAY_SHARE * float(np.sqrt(max(common, 0.0) / curvature))


def _variance_of_sum(pull: Floats) -> float:
    """Variance of the sum of a stationary series (n,) (Newey and West 1987)."""
    reach = min(round(_MAX_CORRELATION_S * _GRID_HZ), len(pull) - 1)
    products = correlate(pull, pull, mode="full", method="fft")[len(pull) - 1 :][: reach + 1]
    weights = 1 - np.arange(reach + 1) / (reach + 1)
    return float(2 * weights @ products - products[0])
