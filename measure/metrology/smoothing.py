"""Smooth poses and velocities: a cubic through the poses around each, by least squares.

Savitzky and Golay (1964, Anal. Chem. 36) for times that need not be regular, in the chart of the
pose. Averaging lessens noise alone; what neighbours err by alike stays in a pose, and mostly
cancels in its velocity. Where the motion is no cubic over the window, the misfit is added as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.metrology.poses import (
    PoseTable,
    SharedErrors,
    alike_part,
    scatter_share,
    square_root,
    unexplained,
)

_DEGREE = 3
_FEWEST = 2 * _DEGREE + 1  # Poses in a window: fewer show no misfit
_MISFIT_SIGMAS = 4.0
"""Standard deviations by which residuals exceed noise, from which a cubic is not the motion."""
_NOISE_WINDOWS = 100
"""The shortest there are, evenly spread: they show the noise, whatever the motion."""


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """Smoothed poses with their velocities; NaN where poses around are too few."""

    poses: PoseTable
    velocities: Floats  # (n, 6) mm/s and rad/s, along the world's axes
    covariances: Floats  # (n, 6, 6) of the velocities


@dataclass(frozen=True, eq=False)
class _Window:
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
    factors = shared.factors(poses)
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


def _window(poses: PoseTable, k: int, seconds: float) -> _Window | None:
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
    return _Window(rows, weights, weights @ path, (finer - weights) @ path, about, share)


def _own_errors(poses: PoseTable, window: _Window, scatter: float) -> tuple[Floats, Floats]:
    """Covariances (2, 6, 6) of pose and velocity by noise, and where the motion is no cubic."""
    stated = poses.covariances[window.rows]
    noise = scatter * np.einsum("wn,nij->wij", window.weights**2, stated)
    misfit = np.einsum("wi,wj->wij", window.finer, window.finer)
    degrees = 6 * (len(stated) - _DEGREE - 1)
    if window.residual_share > (1 + _MISFIT_SIGMAS * np.sqrt(2 / degrees)) * scatter:
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
