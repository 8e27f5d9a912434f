"""Gates: which detections agree with the prediction and with each other; compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.compiling import compiled, inlined
from measure.geometry.linear_kernels import (
    cholesky,
    inverse,
    inverse_2x2,
    invert_factored,
    solve_factored,
    squared_distance,
)
from measure.measuring.tracking.predictive.motion_filter import propagated_covariance
from measure.measuring.tracking.predictive.search_windows import GatedObservations, PredictedBalls

_ITERATIONS = 4
AGREES, JUMPED, MISCOLORED, CONTRADICTS = 0, 1, 2, 3
"""Results of the gates for a detection: accepted; too far from the prediction; of the wrong colour;
not explained by the change of the prediction that explains the majority."""


@compiled
def gate_observations(
    seen: GatedObservations,
    rows: Ints,
    balls: PredictedBalls,
    covariance: Floats,
    time_s: float,
    variance: Floats,
    systematic_px: float,
    gate: float,
) -> tuple[Ints, Floats, Floats]:
    """Gate detections, and estimate the change of the motion that the accepted ones ask for.

    Args:
        rows: (n,) the prediction that each of them belongs to.
        covariance: (12, 12) of pose and velocity at `time_s`.
        time_s: the instant that is predicted from.
        variance: (6,) of the acceleration.
        systematic_px: systematic error of a detection, added to its standard deviation.
        gate: greatest squared Mahalanobis distance, from a chi-square distribution of 2 degrees.

    Returns:
        The result for each (n,), as above; the change of pose and velocity (12,) that the usable
        ones ask for and its covariance (12, 12), NaN if there are none.
    """
    off, noise = seen.pixels - balls.centers_px[rows], seen.noise + systematic_px**2 * np.eye(2)
    out = np.full(len(rows), JUMPED)
    out[agree_with_prediction(off, balls.covariances_px[rows], noise, gate)] = MISCOLORED
    usable = np.flatnonzero((out == MISCOLORED) & seen.colored)
    if len(usable) == 0:
        return out, np.full(12, np.nan), np.full((12, 12), np.nan)
    instant = float(np.mean(seen.times_s))
    agreeing, change, known = agree_with_each_other(
        off[usable],
        balls.jacobians[rows[usable]],
        noise[usable],
        propagated_covariance(covariance, instant - time_s, variance),
        gate,
        seen.times_s[usable] - instant,
    )
    out[usable] = np.where(agreeing, AGREES, CONTRADICTS)
    return out, change, known


@compiled
def agree_with_prediction(
    innovations: Floats, predicted: Floats, noise: Floats, gate: float
) -> Bools:
    """Whether innovations (n, 2) pass the gate.

    Args:
        innovations: detected minus predicted centres, px.
        predicted: (n, 2, 2) covariances of the predicted centres.
        noise: (n, 2, 2) covariances of the detected ones.
        gate: greatest squared Mahalanobis distance, from a chi-square distribution of 2 degrees.
    """
    out = np.zeros(len(innovations), np.bool_)
    for i in range(len(innovations)):
        inverse = inverse_2x2(predicted[i] + noise[i])
        out[i] = squared_distance(innovations[i], inverse) <= gate
    return out


@compiled
def agree_with_each_other(
    innovations: Floats,
    jacobians: Floats,
    noise: Floats,
    prior: Floats,
    gate: float,
    lead_s: Floats,
) -> tuple[Bools, Floats, Floats]:
    """Whether one small change of the predicted pose and velocity explains innovations (n, 2).

    A robust linear update of the prediction (Tukey's weights). The residuals are compared with the
    detections' own noise, so a camera or ball that contradicts the majority fails the gate.

    Args:
        innovations: detected minus predicted centres, px.
        jacobians: (n, 2, 6) of the centres by the pose's chart.
        noise: (n, 2, 2) covariances of the detections.
        prior: (12, 12) covariance of the predicted pose and velocity at a common instant.
        gate: greatest squared Mahalanobis distance.
        lead_s: (n,) times of the pictures after that instant.

    Returns:
        Which are explained (n,), the change of pose and velocity (12,), and its covariance
        (12, 12).
    """
    n = len(innovations)
    precision, left, distances = np.empty((n, 2, 2)), np.empty(2), np.zeros(n)
    for i in range(n):
        precision[i] = inverse_2x2(noise[i])
    information, normal, factor = inverse(prior), np.empty((12, 12)), np.empty((12, 12))
    right, step, covariance = np.empty(12), np.empty(12), np.full((12, 12), np.nan)
    width = 16.0 * gate
    for _ in range(_ITERATIONS):
        normal[:], right[:] = information, 0.0
        for i in range(n):
            weight = max(1 - distances[i] / (2.25 * width), 0.0) ** 2
            _add(jacobians[i], lead_s[i], precision[i], weight, innovations[i], normal, right)
        if not cholesky(normal, factor):
            return np.zeros(n, np.bool_), np.full(12, np.nan), covariance
        solve_factored(factor, right, step)
        for i in range(n):
            for u in range(2):
                left[u] = innovations[i, u]
                for a in range(6):
                    left[u] -= jacobians[i, u, a] * (step[a] + lead_s[i] * step[6 + a])
            distances[i] = squared_distance(left, precision[i])
        width = max(gate, width / 4)
    invert_factored(factor, covariance)
    return distances <= gate, step, covariance


@inlined
def _add(
    slopes: Floats,
    lead: float,
    precision: Floats,
    weight: float,
    seen: Floats,
    normal: Floats,
    right: Floats,
) -> None:
    """Add a detection (2,) with Jacobian (2, 6) by the pose to the normal equations' lower half.

    The Jacobian by the velocity is `lead` times that.
    """
    p, q = precision[0, 0] * weight, precision[0, 1] * weight
    r, s = precision[1, 0] * weight, precision[1, 1] * weight
    for a in range(6):
        u = slopes[0, a] * p + slopes[1, a] * r
        v = slopes[0, a] * q + slopes[1, a] * s
        pull = u * seen[0] + v * seen[1]
        right[a] += pull
        right[6 + a] += lead * pull
        for b in range(6):
            share = u * slopes[0, b] + v * slopes[1, b]
            normal[a, b] += share
            normal[6 + a, b] += lead * share
            normal[6 + a, 6 + b] += lead * lead * share
