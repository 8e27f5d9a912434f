"""Which detections agree with the prediction, and with each other; compiled."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Floats
from measure.compiling import compiled
from measure.geometry.covariance_kernels import inverse_2x2, squared_distance

_ROUNDS = 4


@compiled
def agree_with_prediction(
    innovations: Floats, predicted: Floats, noise: Floats, gate: float
) -> Bools:
    """Whether innovations (n, 2) are likely.

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

    A robust linear update of the prediction (Tukey's weights); what is left over is compared with
    the detections' own noise, so a camera or ball that contradicts the majority stands out.

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
    inverse, slopes, distances = np.empty((n, 2, 2)), np.empty((n, 2, 12)), np.zeros(n)
    for i in range(n):
        inverse[i] = inverse_2x2(noise[i])
        slopes[i, :, :6] = jacobians[i]
        slopes[i, :, 6:] = jacobians[i] * lead_s[i]
    information = np.linalg.inv(prior)
    normal, covariance = np.empty((12, 12)), np.empty((12, 12))
    right, step = np.empty(12), np.empty(12)
    width = 16.0 * gate
    for _ in range(_ROUNDS):
        normal[:], right[:] = information, 0.0
        for i in range(n):
            weight = max(1 - distances[i] / (2.25 * width), 0.0) ** 2
            _add(slopes[i], inverse[i] * weight, innovations[i], normal, right)
        step[:] = np.linalg.solve(normal, right)
        for i in range(n):
            left = innovations[i] - slopes[i] @ step
            distances[i] = squared_distance(left, inverse[i])
        width = max(gate, width / 4)
    covariance[:] = np.linalg.inv(normal)
    return distances <= gate, step, covariance


@compiled
def _add(slopes: Floats, weight: Floats, seen: Floats, normal: Floats, right: Floats) -> None:
    """Add a detection (2,) with its slopes (2, 12) and weight (2, 2) to the normal equations."""
    for a in range(12):
        u = slopes[0, a] * weight[0, 0] + slopes[1, a] * weight[1, 0]
        v = slopes[0, a] * weight[0, 1] + slopes[1, a] * weight[1, 1]
        right[a] += u * seen[0] + v * seen[1]
        for b in range(12):
            normal[a, b] += u * slopes[0, b] + v * slopes[1, b]
