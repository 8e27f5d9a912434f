"""The two halves of a recording, each refined by itself and tried on the other.

Errors that drift slowly with the body's pose (light, occlusion) are neither white noise nor a
constant shift, so residuals do not show them. They make the two refinements differ by more than
their covariances: the variance of every view is widened by the ratio.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.calibration.refining.recording import MIN_FRAMES, Recording
from measure.calibration.refining.refine import Refinement, RefineSettings, misfits_px, refine_rig
from measure.errors import CalibrationError
from measure.model import Body, Camera

_UNTRIED_VARIANCE_FACTOR = 4.0
"""Variance factor without halves to compare: they often differ by two standard deviations."""
_MIN_EIGENVALUE_RATIO = 1e-3


@dataclass(frozen=True)
class Halves:
    """Result of the comparison.

    Attributes:
        variance_factor: variance of the views' errors over that estimated from
            residuals.
        held_out_px: median residual of each half's views, with the first cameras and with
            those refined on the other half; NaN if they could not be compared.
    """

    variance_factor: float = _UNTRIED_VARIANCE_FACTOR
    held_out_px: tuple[float, float] = (float("nan"), float("nan"))


def compare_halves(
    first: tuple[Camera, ...],
    body: Body,
    recording: Recording,
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
) -> Halves:
    """Refine each half by itself; the arguments are those of `refine_rig`."""
    count = len(recording.times_s)
    if count // 2 < MIN_FRAMES:
        return Halves()
    parts = (recording.part(0, count // 2), recording.part(count // 2, count))
    try:
        one, other = (refine_rig(first, body, p, settings, joint_covariance) for p in parts)
    except CalibrationError:
        return Halves()
    before = np.concatenate([misfits_px(first, body, part) for part in parts])
    after = np.concatenate(
        [misfits_px(r.cameras, body, p) for r, p in zip((other, one), parts, strict=True)]
    )
    held_out = (float(np.median(before)), float(np.median(after)))
    return Halves(max(1.0, _disagreement((one, other))), held_out)


def _disagreement(both: tuple[Refinement, Refinement]) -> float:
    """Mean squared difference of two refinements over its predicted variance.

    Both share the first calibration's error, so only what the recordings add counts: a refinement
    with the covariance P from a prior L^-1 has the variance P (P^-1 - L) P = P - P L P from its own
    recording.
    """
    owned = [r.covariance - r.covariance @ np.linalg.solve(r.prior, r.covariance) for r in both]
    spread: Floats = owned[0] + owned[1]
    scale = 1 / np.sqrt(np.diag(spread))
    shares, axes = np.linalg.eigh((spread + spread.T) / 2 * scale[:, None] * scale)
    apart = axes.T @ ((both[0].change - both[1].change) * scale)
    determined = shares > _MIN_EIGENVALUE_RATIO * shares[-1]
    return float(np.mean(apart[determined] ** 2 / shares[determined]))
