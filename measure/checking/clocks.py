"""Clock offsets and rolling-shutter times of cameras, from a motion that all of them saw.

An image with a wrong stamp shows the moving body displaced along each ball's path, in proportion to
its speed. All clocks and readout times are fitted together with the poses, as any other cause is
(`explaining`). Only differences between clocks are observable: their median is set to 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats
from measure.checking.causes import Word
from measure.checking.evidence import CLOCK, ROLL, TRACKED_PX, Evidence
from measure.checking.explaining import fitted
from measure.checking.hypotheses import Hypothesis
from measure.checking.sightings import followed_evidence
from measure.limits import SIGNIFICANT_SIGMAS
from measure.measuring.measurement import Measurement
from measure.model import Body, Camera

_MIN_INSTANTS = 5
_FARTHEST_S = 30.0  # A clock beyond has diverged
_MAX_READOUT_SD_S = 0.008
"""A less certain readout time cannot be separated from the offset and is not estimated."""


@dataclass(frozen=True)
class CameraClock:
    """One camera's clock."""

    camera: str
    offset_s: float  # add this to the camera's time stamps to bring them in line with the others
    offset_sd_s: float  # its standard deviation; infinite if the motion does not determine it
    # time from the first row's exposure to the last row's; negative if from the bottom up; NaN if
    # not estimated.
    readout_s: float
    readout_sd_s: float  # its standard deviation; infinite if the motion does not determine it

    @property
    def offset_visible(self) -> bool:
        """Whether the offset is significant."""
        return abs(self.offset_s) > SIGNIFICANT_SIGMAS * self.offset_sd_s

    @property
    def rolling(self) -> bool:
        """Whether the readout time is significant."""
        return abs(self.readout_s) > SIGNIFICANT_SIGMAS * self.readout_sd_s


def estimate_clocks(
    measurements: Iterable[Measurement],
    body: Body,
    cameras: Sequence[Camera],
    extra_px: float = TRACKED_PX,
) -> tuple[CameraClock, ...]:
    """Estimate the clock offset and readout time of every camera, in order, while a body moves.

    A camera that saw too little, or a body that stood still, gives infinite standard deviations.
    `extra_px` is the systematic error of a detection, in its weight and in the uncertainty.
    """
    evidence = followed_evidence(measurements, body, cameras, extra_px)
    if evidence is None or len(evidence.times_s) < _MIN_INSTANTS:
        return tuple(CameraClock(c.name, 0.0, np.inf, np.nan, np.inf) for c in cameras)
    moving = evidence.flow() > 0
    clocks, sd = _estimate(evidence, moving, moving)
    if np.any(uncertain := moving & (sd[:, 1] > _MAX_READOUT_SD_S)):
        clocks, sd = _estimate(evidence, moving, moving & ~uncertain)
    return tuple(
        CameraClock(
            camera.name,
            float(clocks[i, 0]),
            float(sd[i, 0]),
            float(clocks[i, 1]) if np.isfinite(sd[i, 1]) else float("nan"),
            float(sd[i, 1]),
        )
        for i, camera in enumerate(cameras)
    )


def _estimate(evidence: Evidence, moving: Bools, rolls: Bools) -> tuple[Floats, Floats]:
    """Offsets and readout times (c, 2) of c cameras, and their standard deviations (c, 2)."""
    values, deviations = np.zeros((len(moving), 2)), np.full((len(moving), 2), np.inf)
    known, rolling = np.flatnonzero(moving), np.flatnonzero(rolls)
    if len(known) < 2:
        return values, deviations
    eye = np.eye(evidence.size)
    # The clocks of the others against the first one's.
    columns = [evidence.of_camera(k, CLOCK) for k in known[1:].tolist()]
    columns += [evidence.of_camera(k, ROLL) for k in rolling.tolist()]
    found = fitted(evidence, [Hypothesis(Word.CLOCK, "", eye[:, np.concatenate(columns)])])
    estimate, covariance = found.last()
    gauge = np.zeros((len(known) + len(rolling), len(estimate)))
    gauge[1:] = np.eye(len(estimate))
    gauge[: len(known)] = _from_median(gauge[: len(known)] @ estimate) @ gauge[: len(known)]
    estimate, variance = gauge @ estimate, np.diag(gauge @ covariance @ gauge.T)
    if not np.all(np.abs(estimate) <= _FARTHEST_S) or not np.all(variance >= 0):
        return values, deviations
    values[known, 0], values[rolling, 1] = np.split(estimate, [len(known)])
    sd = np.where(variance > 0, np.sqrt(variance), np.inf)  # 0: not determined
    deviations[known, 0], deviations[rolling, 1] = np.split(sd, [len(known)])
    return values, deviations


def _from_median(offsets_s: Floats) -> Floats:
    """The matrix (c, c) that gives offsets (c,) relative to their median.

    Usually one clock is wrong: relative to the median it has the whole offset, the others none.
    """
    order = np.argsort(offsets_s)
    matrix = np.eye(len(offsets_s))
    for one in order[[(len(order) - 1) // 2, len(order) // 2]]:
        matrix[:, one] -= 0.5
    return matrix
