"""Standard deviations of all errors, estimated from the recording and shrunken to usual values.

Restricted maximum likelihood by MacKay's (1992, "Bayesian Interpolation", section 4.4) fixed point:
the squares of the estimated random effects over how many of them the data determine. The usual
value counts as a few observations more.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.refining.recording import Track

_MAX_LAG_FRAMES = 30
_MIN_CORRELATION = 0.05
_MEDIAN_OF_RAYLEIGH = 1.1774
_USUAL_COUNTS = 4.0  # How many observations a usual variance is worth


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviations of the errors, and the correlation of neighbouring frame sets."""

    view_px: float = 0.1  # of a ball's centre in one picture, beyond what the detector states
    constant_px: float = 0.1  # of what stays of that all through a recording, by ball and camera
    correlation: float = 1.0  # number of neighbouring frame sets that are worth one independent one
    image_px: float = 1.0  # by how much the first calibration misses in the workspace
    position_mm: float = 1.0  # by how much its cameras stand elsewhere, by axis

    def differs(self, other: NoiseModel) -> bool:
        """Whether anything differs by more than five per cent."""
        return bool(np.any(np.abs(self._values() / other._values() - 1) > 0.05))

    def towards(self, other: NoiseModel) -> NoiseModel:
        """The geometric mean with another one: damps oscillation between two."""
        return NoiseModel(*np.sqrt(self._values() * other._values()).tolist())

    def _values(self) -> Floats:
        return np.array(astuple(self))


def shrunken_variance(squares: float, determined: float, usual: float) -> float:
    """A variance from the squares of random effects and how many the data determined."""
    return (squares + _USUAL_COUNTS * usual) / (max(determined, 0.0) + _USUAL_COUNTS)


def with_view_noise(
    noise: NoiseModel,
    residuals: dict[str, Floats],
    tracks: dict[str, Track],
    freedom: float,
    least_px: float,
    variance_factor: float,
) -> NoiseModel:
    """The scatter of single views, and its correlation in time, from residuals.

    Args:
        residuals: by camera (n, 2) px.
        freedom: share of the residuals that is not taken up by unknowns.
        least_px: lower bound of a view's standard deviation.
        variance_factor: multiplies the correlation (see `compare_halves`).
    """
    names = list(residuals)
    left = np.concatenate([residuals[name] for name in names])
    stated = np.concatenate([tracks[name].covariance for name in names])
    extra = _extra_px(left, stated, freedom)
    total = {name: tracks[name].covariance + extra**2 * np.eye(2) for name in names}
    return replace(
        noise,
        view_px=max(extra, least_px),
        correlation=variance_factor * _correlation(residuals, total, tracks),
    )


def _extra_px(residuals: Floats, stated: Floats, freedom: float) -> float:
    """What must be added to stated covariances so that the median residual fits."""
    from scipy.optimize import brentq

    variances, axes = np.linalg.eigh(stated)
    squares = np.einsum("nij,ni->nj", axes, residuals) ** 2 / freedom

    def excess(extra: float) -> float:
        lengths = np.sqrt(np.sum(squares / (variances + extra**2), axis=1))
        return float(np.median(lengths)) - _MEDIAN_OF_RAYLEIGH

    return float(brentq(excess, 0.0, 2 * np.sqrt(np.max(squares)))) if excess(0.0) > 0 else 0.0


def _correlation(
    residuals: dict[str, Floats], total: dict[str, Floats], tracks: dict[str, Track]
) -> float:
    """Integrated correlation time in frame sets: 1 + 2 (rho_1 + rho_2 + ...), at least 1."""
    products, counts = np.zeros(_MAX_LAG_FRAMES + 1), np.zeros(_MAX_LAG_FRAMES + 1)
    for name, left in residuals.items():
        track = tracks[name]
        size = np.sqrt(np.einsum("nii->n", total[name]))
        # Clipped, so that one wrong detection does not pass for correlation, or hide it.
        standard = np.clip(left / size[:, None], -2.5, 2.5)
        for ball in np.unique(track.ball):
            mine = track.ball == ball
            line = np.full((int(track.frame[mine].max()) + 1, 2), np.nan)
            line[track.frame[mine]] = standard[mine]
            for lag in range(min(_MAX_LAG_FRAMES + 1, len(line))):
                both = (line[lag:] * line[: len(line) - lag]).reshape(-1)
                products[lag] += np.nansum(both)
                counts[lag] += np.count_nonzero(np.isfinite(both))
    rho = products / np.maximum(counts, 1)
    rho = rho[1:] / max(rho[0], 1e-12)
    faded = np.flatnonzero(rho < _MIN_CORRELATION)
    return float(1 + 2 * np.sum(rho[: faded[0]] if len(faded) else rho))
