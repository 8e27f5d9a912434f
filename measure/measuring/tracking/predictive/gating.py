"""Gates: which detections agree with the prediction and with each other."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.geometry import squared_mahalanobis
from measure.measuring.tracking.predictive.motion_filter import propagated_covariance
from measure.measuring.tracking.predictive.search_windows import GatedObservations, PredictedBalls
from measure.model.observations import Reason

_ITERATIONS = 4


def gate_observations(
    seen: GatedObservations,
    rows: Ints,
    balls: PredictedBalls,
    covariance: Floats,
    time_s: float,
    variance: Floats,
    systematic_px: float,
    gate: float,
) -> tuple[list[Reason], tuple[Floats, Floats] | None]:
    """Gate detections, and estimate the change of the motion that the accepted ones ask for.

    Args:
        rows: (n,) the prediction that each of them belongs to.
        covariance: (12, 12) of pose and velocity at `time_s`.
        time_s: the instant that is predicted from.
        variance: (6,) of the acceleration.
        systematic_px: systematic error of a detection, added to its standard deviation.
        gate: greatest squared Mahalanobis distance, from a chi-square distribution of 2 degrees.

    Returns:
        Why each (n,) is suspended, or `Reason.NONE`; and the change of the velocity (6,) that the
        usable ones ask for with its covariance (6, 6), None if there are none.
    """
    off, noise = seen.pixels - balls.centers_px[rows], seen.noise + systematic_px**2 * np.eye(2)
    near = squared_mahalanobis(off, balls.covariances_px[rows] + noise) <= gate
    out = [Reason.COLOR if ok else Reason.JUMPED for ok in near.tolist()]
    usable = np.flatnonzero(near & seen.colored)
    if not len(usable):
        return out, None
    instant = float(np.mean(seen.times_s))
    slopes, lead_s = balls.jacobians[rows[usable]], seen.times_s[usable] - instant
    agreeing, change, known = agree_with_each_other(
        off[usable],
        np.concatenate([slopes, slopes * lead_s[:, None, None]], axis=2),
        noise[usable],
        propagated_covariance(covariance, instant - time_s, variance),
        gate,
    )
    for i, ok in zip(usable.tolist(), agreeing.tolist(), strict=True):
        out[i] = Reason.NONE if ok else Reason.INCONSISTENT
    return out, (change[6:], known[6:, 6:])


def agree_with_each_other(
    innovations: Floats, slopes: Floats, noise: Floats, prior: Floats, gate: float
) -> tuple[Bools, Floats, Floats]:
    """Whether one small change of the predicted pose and velocity explains innovations (n, 2).

    A robust linear update of the prediction (Tukey's weights). The residuals are compared with the
    detections' own noise, so a camera or ball that contradicts the majority fails the gate.

    Args:
        innovations: detected minus predicted centres, px.
        slopes: (n, 2, 12) of the centres by the pose's chart and the velocity.
        noise: (n, 2, 2) covariances of the detections.
        prior: (12, 12) covariance of the predicted pose and velocity at a common instant.
        gate: greatest squared Mahalanobis distance.

    Returns:
        Which are explained (n,), the change (12,), and its covariance (12, 12).
    """
    precision, information = np.linalg.inv(noise), np.linalg.inv(prior)
    distances, width = np.zeros(len(innovations)), 16.0 * gate
    for _ in range(_ITERATIONS):
        weights = np.maximum(1 - distances / (2.25 * width), 0.0) ** 2
        weighted = np.swapaxes(slopes, 1, 2) @ (precision * weights[:, None, None])
        covariance = np.linalg.inv(information + (weighted @ slopes).sum(axis=0))
        change = covariance @ np.einsum("nij,nj->i", weighted, innovations)
        left = innovations - slopes @ change
        distances = np.einsum("ni,nij,nj->n", left, precision, left)
        width = max(gate, width / 4)
    return distances <= gate, change, covariance
