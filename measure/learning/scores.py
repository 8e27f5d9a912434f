"""Accuracy of corrections: RMS, SD, reduction; per axis, by trajectory, by speed."""

from __future__ import annotations

import itertools
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.host import Dataset, Estimates, OnnxModel

SPEED_EDGES_MM_S = (0.0, 5.0, 15.0, 30.0, 60.0, np.inf)


@dataclass(frozen=True)
class Score:
    """Residuals of some rows, in mm."""

    rows: int
    rms_mm: float  # root mean square of the 3-D residual
    sd_mm: float  # root of the trace of the residuals' covariance
    p95_mm: float  # 95th percentile of its norm
    axis_rms_mm: tuple[float, float, float]  # per axis
    axis_sd_mm: tuple[float, float, float]  # per axis

    @classmethod
    def of(cls, residuals_mm: Floats) -> Score:
        """Of (n, 3) residuals."""
        if not len(residuals_mm):
            nan = float("nan")
            return cls(0, nan, nan, nan, (nan, nan, nan), (nan, nan, nan))
        axis_rms = np.sqrt((residuals_mm**2).mean(axis=0))
        axis_sd = residuals_mm.std(axis=0)
        norms = np.linalg.norm(residuals_mm, axis=1)
        rx, ry, rz = axis_rms.tolist()
        sx, sy, sz = axis_sd.tolist()
        return cls(
            len(residuals_mm),
            float(np.linalg.norm(axis_rms)),
            float(np.linalg.norm(axis_sd)),
            float(np.quantile(norms, 0.95)),
            (rx, ry, rz),
            (sx, sy, sz),
        )


@dataclass(frozen=True)
class EstimatorEvaluation:
    """An estimator on a data set, before and after the correction."""

    before: Score  # of the reported position
    after: Score  # of the corrected position
    rms_change: float  # after / before - 1; negative is better
    sd_change: float  # the same for the SD
    # mean squared Mahalanobis length of residuals per axis; 1 if the covariance fits.
    consistency: float
    unfamiliar: float  # share of rows flagged as unlike training
    by_trajectory: dict[str, tuple[Score, Score]]  # name -> (before, after)
    # (slowest mm/s, fastest mm/s, before, after).
    by_speed: tuple[tuple[float, float, Score, Score], ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a card or JSON."""
        return asdict(self)


def evaluate(data: Dataset, estimates: Estimates) -> EstimatorEvaluation:
    """Score corrections, one for every row, on the usable rows of a data set."""
    keep = data.usable
    residuals = data.errors_mm - estimates.errors_mm
    before, after = Score.of(data.errors_mm[keep]), Score.of(residuals[keep])
    covariance = (estimates.covariances + data.covariances)[keep]
    squared = np.einsum("ni,nij,nj->n", residuals[keep], np.linalg.inv(covariance), residuals[keep])
    speed = speeds_mm_s(data)
    return EstimatorEvaluation(
        before=before,
        after=after,
        rms_change=after.rms_mm / before.rms_mm - 1.0,
        sd_change=after.sd_mm / before.sd_mm - 1.0 if before.sd_mm else float("nan"),
        consistency=float(squared.mean() / 3.0),
        unfamiliar=float((~(estimates.strangeness[keep] <= 1.0)).mean()),
        by_trajectory={
            name: (
                Score.of(data.errors_mm[rows][keep[rows]]),
                Score.of(residuals[rows][keep[rows]]),
            )
            for name, rows in data.runs()
        },
        by_speed=tuple(
            (low, high, Score.of(data.errors_mm[part]), Score.of(residuals[part]))
            for low, high in itertools.pairwise(SPEED_EDGES_MM_S)
            for part in [keep & (speed >= low) & (speed < high)]
        ),
    )


def corrected_rms_mm(model: OnnxModel, data: Dataset) -> float:
    """RMS in mm of the usable rows' errors after a model's corrections."""
    residuals = data.errors_mm - model.predict(data).errors_mm
    return Score.of(residuals[data.usable]).rms_mm


def speed_range(low: float, high: float) -> str:
    """A range of speeds in words."""
    return f"{low:g} to {high:g}" if np.isfinite(high) else f"over {low:g}"


def speeds_mm_s(data: Dataset) -> Floats:
    """Speed of the reported position (n,); NaN where times are unknown."""
    out = np.full(len(data), np.nan)
    for _, rows in data.runs():
        times = data.times_s[rows]
        if len(times) > 2 and np.all(np.diff(times) > 0):
            slope = np.gradient(data.reported_mm[rows], times, axis=0)
            out[rows] = np.linalg.norm(slope, axis=1)
    return out
