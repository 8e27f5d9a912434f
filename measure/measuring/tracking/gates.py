"""Which detections agree with the prediction, and with each other."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Floats
from measure.geometry import squared_mahalanobis

_ROUNDS = 4


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
    return np.asarray(squared_mahalanobis(innovations, predicted + noise) <= gate)


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
    jacobians = np.concatenate([jacobians, jacobians * lead_s[:, None, None]], axis=2)
    inverse = np.linalg.inv(noise)
    information = np.linalg.inv(prior)
    distances = np.zeros(len(innovations))
    width = 16.0 * gate
    for _ in range(_ROUNDS):
        weight = np.maximum(1 - distances / (2.25 * width), 0.0) ** 2
        gain = np.swapaxes(jacobians, 1, 2) @ (inverse * weight[:, None, None])
        normal = (gain @ jacobians).sum(axis=0) + information
        step = np.linalg.solve(normal, np.einsum("nij,nj->i", gain, innovations))
        residuals = innovations - jacobians @ step
        distances = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
        width = max(gate, width / 4)
    return np.asarray(distances <= gate), np.asarray(step), np.linalg.inv(normal)
