"""Noise and drift of poses that should not scatter: about a truth, or about the mean of each rest.

The Allan deviation (Allan 1966, Proc. IEEE 54; overlapping samples) says how far means of so many
seconds differ from the next such mean: it falls as averaging helps, and rises where poses drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints
from measure.metrology.poses import independent_count

_FEWEST = 10  # Poses that show noise at all
_FEWEST_SPECTRUM = 32  # Poses in a row that show a spectrum
_SEGMENT = 256  # Poses over which a spectrum is taken
_GAP_STEPS = 1.5  # Poses further apart than so many usual steps do not follow each other


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
    if len(times_s) < _FEWEST:
        return None
    x = np.concatenate([deviations[:, :3], np.degrees(deviations[:, 3:])], axis=1)
    step = float(np.median(np.diff(times_s)))
    breaks = (np.diff(times_s) > _GAP_STEPS * step) | (np.diff(groups) != 0)
    runs = np.split(x, np.flatnonzero(breaks) + 1)
    lengths, allan = _allan(runs)
    if not len(lengths):
        return None
    slope, sd = _drift(times_s, x, groups)
    hz, density = _spectrum(max(runs, key=len), step)
    seconds = float(times_s[-1] - times_s[0])
    drift = seconds * slope, seconds * sd
    return Noise(
        about, len(x), seconds, allan[0], *drift, step * lengths.astype(float), allan, hz, density
    )


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
