"""Noise and drift of poses that should not scatter; smooth poses and velocities.

The Allan deviation (Allan 1966, Proc. IEEE 54; overlapping samples) says how far means of so many
seconds differ from the next such mean: it falls as averaging helps, and rises where poses drift.

Smooth are cubics through the poses around each, by least squares (Savitzky and Golay 1964, Anal.
Chem. 36), for times that need not be regular, in the chart of the pose. Averaging lessens noise
alone; what neighbours err by alike stays in a pose, and mostly cancels in its velocity. Where the
motion is no cubic over the window, the misfit is added as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints
from measure.limits import FEWEST, GAP_PERIODS, SIGNIFICANT_SIGMAS
from measure.metrology.poses import (
    PoseTable,
    SharedErrors,
    alike_part,
    independent_count,
    scatter_share,
    square_root,
    unexplained,
)

_FEWEST_SPECTRUM = 32  # Poses in a row that show a spectrum
_SEGMENT = 256  # Poses over which a spectrum is taken


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise and drift, positions in mm and rotations in deg, both 3-D."""

    about: str  # what poses are compared with
    poses: int
    seconds: float  # from the first pose to the last
    floor: Floats  # (2,) standard deviation from one pose to the next, without drift
    drift: Floats  # (6,) over these seconds: x, y, z in mm and about x, y, z in deg
    drift_sd: Floats  # (6,) its standard deviation
    averaging_s: Floats  # (k,) time over which poses are averaged
    allan: Floats  # (k, 2) Allan deviation of such means
    frequency_hz: Floats  # (m,); empty where too few poses follow each other
    density: Floats  # (m, 2) root of the spectral density, in mm and deg per root Hz

    @property
    def best(self) -> int:
        """The averaging time after which means of positions agree best."""
        return int(np.argmin(self.allan[:, 0]))

    @property
    def drifts(self) -> bool:
        """Whether a drift stands out of the noise: beyond three standard deviations."""
        return bool(np.any(np.abs(self.drift) > 3 * self.drift_sd))

    def rows(self) -> list[tuple[str, float, float]]:
        """In words, with the position in mm and the rotation in deg."""
        drift = np.linalg.norm(self.drift.reshape(2, 3), axis=1)
        sd = np.linalg.norm(self.drift_sd.reshape(2, 3), axis=1)
        clear = "" if self.drifts else ", within its uncertainty"
        return [
            ("from one pose to the next, SD", *_pair(self.floor)),
            (f"mean of {self.averaging_s[self.best]:.3g} s, SD", *_pair(self.allan[self.best])),
            (f"drift over {self.seconds:.3g} s{clear}", *_pair(drift)),
            ("the drift's SD", *_pair(sd)),
        ]


def noise_of(times_s: Floats, deviations: Floats, groups: Ints, about: str) -> Noise | None:
    """Noise of poses by their deviations (n, 6), in the `perturb` chart; None if they are too few.

    Each deviates from the mean of its stretch, by the groups (n,); a drift is common to all.
    `about` says from what, in words.
    """
    if len(times_s) < FEWEST:
        return None
    x = np.concatenate([deviations[:, :3], np.degrees(deviations[:, 3:])], axis=1)
    step = float(np.median(np.diff(times_s)))
    breaks = (np.diff(times_s) > GAP_PERIODS * step) | (np.diff(groups) != 0)
    runs = np.split(x, np.flatnonzero(breaks) + 1)
    lengths, allan = _allan(runs)
    if not len(lengths):
        return None
    slope, sd = _drift(times_s, x, groups)
    hz, density = _spectrum(max(runs, key=len), step)
    seconds = float(times_s[-1] - times_s[0])
    drift, averaging_s = (seconds * slope, seconds * sd), step * lengths.astype(float)
    return Noise(about, len(x), seconds, allan[0], *drift, averaging_s, allan, hz, density)


def _allan(runs: list[Floats]) -> tuple[Ints, Floats]:
    """Lengths (k,) of means and their Allan deviations (k, 2), over runs (n, 6) without a gap."""
    longest = max(len(run) for run in runs)
    lengths, out = [], []
    for m in 2 ** np.arange(int(np.log2(max(longest // 3, 1))) + 1):
        sums = [np.cumsum(np.vstack([np.zeros((1, 6)), run]), axis=0) for run in runs]
        steps = [s[2 * m :] - 2 * s[m:-m] + s[: -2 * m] for s in sums if len(s) > 2 * m]
        if steps:
            mean = np.mean(np.concatenate(steps) ** 2, axis=0) / (2 * m**2)
            lengths.append(m)
            out.append(np.sqrt(mean.reshape(2, 3).sum(axis=1)))
    return np.array(lengths, dtype=np.int64), np.array(out)


def _drift(times_s: Floats, x: Floats, groups: Ints) -> tuple[Floats, Floats]:
    """Slope (6,) common to all groups, and its standard deviation by what is left."""
    _, at = np.unique(groups, return_inverse=True)
    count = np.bincount(at)[:, None]
    together = np.column_stack([times_s, x])
    means = np.stack([np.bincount(at, column) for column in together.T], axis=1) / count
    centred = together - means[at]
    t, y = centred[:, 0], centred[:, 1:]
    square = float(t @ t)
    slope = t @ y / square
    left = y - np.outer(t, slope)
    variance = np.mean(left**2, axis=0)
    independent = independent_count(left / np.sqrt(np.maximum(variance, 1e-18)))
    degrees = max(independent - len(count) - 1, 1.0)
    return slope, np.sqrt(variance * len(x) / (degrees * square))


def _spectrum(run: Floats, step: float) -> tuple[Floats, Floats]:
    from scipy.signal import welch  # takes long to load, and every command imports this file

    if len(run) < _FEWEST_SPECTRUM:
        return np.zeros(0), np.zeros((0, 2))
    hz, power = welch(run, 1 / step, nperseg=min(len(run), _SEGMENT), axis=0)
    return hz[1:], np.sqrt(power[1:].reshape(-1, 2, 3).sum(axis=2))


def _pair(values: Floats) -> tuple[float, float]:
    return float(values[0]), float(values[1])


_DEGREE = 3
_FEWEST = 2 * _DEGREE + 1  # Poses in a window: fewer show no misfit
_NOISE_WINDOWS = 100
"""The shortest there are, evenly spread: they show the noise, whatever the motion."""


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """Smoothed poses with their velocities; NaN where poses around are too few."""

    poses: PoseTable
    velocities: Floats  # (n, 6) mm/s and rad/s, along the world's axes
    covariances: Floats  # (n, 6, 6) of the velocities


@dataclass(frozen=True, eq=False)
class _NoiseWindow:
    rows: slice
    weights: Floats  # (2, m) of its poses in the pose and in the velocity
    move: Floats  # (2, 6) of the pose in its chart, and velocity
    finer: Floats  # (2, 6) the same by a curve of two degrees more, less these
    residual: Floats  # (6, 6) covariance of its poses about the curve
    residual_share: float  # its variance over the stated one


def smooth_motion(poses: PoseTable, shared: SharedErrors, seconds: float) -> SmoothMotion:
    """Poses and velocities by cubics over `seconds` on either side.

    A window reaches over no pause longer than `seconds`; with too few poses a pose stays as it is.
    """
    n = len(poses)
    windows = [_window(poses, k, seconds) for k in range(n)]
    scatter = _noise_share(poses, seconds)
    factors = shared.factors(poses)[:, :, :-1]
    known = factors @ np.swapaxes(factors, 1, 2)
    light = alike_part(scatter, poses.covariances, known)
    roots = square_root(light)
    moves, covariances = np.zeros((n, 6)), poses.covariances.copy()
    velocities, spread = np.full((n, 6), np.nan), np.full((n, 6, 6), np.nan)
    for k, window in enumerate(windows):
        if window is None:
            continue
        moves[k], velocities[k] = window.move
        noise, misfit = _own_errors(poses, window, scatter)
        covariances[k] = known[k] + light[k] + noise[0] + misfit[0]
        w = window.weights[1]
        by_light = roots[window.rows] * w[:, None, None]
        alike = shared.alike(poses.world_from_body[window.rows])
        together = np.einsum("n,nak->ak", w, factors[window.rows])
        spread[k] = together @ together.T + noise[1] + misfit[1]
        spread[k] += np.einsum("nm,nab,mcb->ac", alike, by_light, by_light, optimize=True)
    smooth = PoseTable(poses.times_s, poses.world_from_body.perturb(moves), covariances)
    return SmoothMotion(smooth, velocities, spread)


def _window(poses: PoseTable, k: int, seconds: float) -> _NoiseWindow | None:
    t = poses.times_s
    first, last = np.searchsorted(t, [t[k] - seconds * (1 + 1e-9), t[k] + seconds * (1 + 1e-9)])
    pauses = np.flatnonzero(np.diff(t[first:last]) > seconds) + first
    first = max([first, *(pauses[pauses < k] + 1)])
    last = min([last, *(pauses[pauses >= k] + 1)])
    if last - first < _FEWEST or not first < k < last - 1:
        return None
    rows = slice(int(first), int(last))
    lead = (t[rows] - t[k]) / seconds
    powers = np.vander(lead, _DEGREE + 1, increasing=True)
    inverse = np.linalg.pinv(powers)
    path = poses.world_from_body[rows].difference(poses.world_from_body[k])
    residuals = path - powers @ (inverse @ path)
    share = float(scatter_share(residuals, poses.covariances[rows].mean(axis=0), _DEGREE + 1))
    about = residuals.T @ residuals / (len(lead) - _DEGREE - 1)
    weights = inverse[:2] / [[1.0], [seconds]]
    finer = np.linalg.pinv(np.vander(lead, _DEGREE + 3, increasing=True))[:2] / [[1.0], [seconds]]
    return _NoiseWindow(rows, weights, weights @ path, (finer - weights) @ path, about, share)


def _own_errors(poses: PoseTable, window: _NoiseWindow, scatter: float) -> tuple[Floats, Floats]:
    """Covariances (2, 6, 6) of pose and velocity by noise, and where the motion is no cubic."""
    stated = poses.covariances[window.rows]
    noise = scatter * np.einsum("wn,nij->wij", window.weights**2, stated)
    misfit = np.einsum("wi,wj->wij", window.finer, window.finer)
    degrees = 6 * (len(stated) - _DEGREE - 1)
    if window.residual_share > (1 + SIGNIFICANT_SIGMAS * np.sqrt(2 / degrees)) * scatter:
        most = np.abs(window.weights).sum(axis=1) ** 2
        left = unexplained(window.residual, scatter * stated.mean(axis=0))
        misfit = misfit + most[:, None, None] * left
    return noise, misfit


def _noise_share(poses: PoseTable, seconds: float) -> float:
    """Variance by which neighbouring poses scatter, over the stated one."""
    shares = []
    starts = np.linspace(0, len(poses) - _FEWEST, _NOISE_WINDOWS)
    for start in np.unique(starts.astype(int)) if len(poses) >= _FEWEST else ():
        t = poses.times_s[start : start + _FEWEST]
        if np.max(np.diff(t)) <= seconds:
            few = poses.take(slice(start, start + _FEWEST))
            window = _window(few, _DEGREE, t[-1] - t[0])
            shares += [] if window is None else [window.residual_share]
    return float(np.median(shares)) if shares else 1.0
