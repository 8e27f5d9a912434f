"""What the scatter of an outline's edges says about its centre, against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest

from measure.arrays import Floats
from measure_plugins._outline.fitting.covariance import center_covariance
from measure_plugins._outline.sampling.rays import angles_around

RAYS = 72
AROUND = angles_around(RAYS)
COLUMNS = np.column_stack([AROUND, np.ones(RAYS)])
GROWTH_SD_PX = 0.3


def weights_of(hidden: float) -> Floats:
    """Equal weights; a part of the outline, from the first ray on, is hidden."""
    return np.where(np.arange(RAYS) < hidden * RAYS, 0.0, 16.0)


def fitted(errors: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """By how much `errors` (n,) move a fitted centre (2,), and the covariance that they claim."""
    normal = COLUMNS.T @ (weights[:, None] * COLUMNS)
    normal[2, 2] += 1 / GROWTH_SD_PX**2
    solution = np.linalg.solve(normal, COLUMNS.T @ (weights * errors))
    off = np.where(weights > 0, errors - COLUMNS @ solution, 0.0)
    return solution[:2], center_covariance(AROUND, weights, off, normal)


def smooth_errors(rng: np.random.Generator, size_px: float) -> Floats:
    """Errors of random waves, as shading makes them: the longer the wave, the larger."""
    turns = 2 * np.pi * np.arange(RAYS) / RAYS
    out = 0.2 * size_px * rng.normal(size=RAYS)
    for wave in range(1, 9):
        a, b = size_px * wave**-0.75 * rng.normal(size=2)
        out += a * np.cos(wave * turns) + b * np.sin(wave * turns)
    return out


def squared_errors(errors: list[Floats], hidden: float) -> Floats:
    """Normalised squared errors of the centre, two degrees of freedom each."""
    found = [fitted(some, weights_of(hidden)) for some in errors]
    return np.array([off @ np.linalg.solve(claimed, off) for off, claimed in found])


@pytest.mark.parametrize("hidden", [0.0, 0.4, 0.7])
@pytest.mark.parametrize("size_px", [0.1, 0.4])
def test_smooth_errors_are_held_though_they_leave_little_residual(hidden, size_px):
    rng = np.random.default_rng(1)
    squares = squared_errors([smooth_errors(rng, size_px) for _ in range(400)], hidden)
    # The scale is inferred from a few waves: some of the 95 % are lost.
    assert 0.85 < np.mean(squares < 5.991) < 0.995


def test_what_is_hidden_widens_the_claim_across_the_gap():
    rng = np.random.default_rng(2)
    # Rays 0 to 43 are hidden: what is left is centred on ray 58.
    middle = AROUND[58]
    along, across = [], []
    for _ in range(100):
        _, claimed = fitted(smooth_errors(rng, 0.2), weights_of(0.6))
        along.append(middle @ claimed @ middle)
        turned = np.array([-middle[1], middle[0]])
        across.append(turned @ claimed @ turned)
    assert np.mean(along) > 1.5 * np.mean(across)


def test_independent_errors_are_never_claimed_smaller_than_they_are():
    """Nor much larger: errors that go together cannot be told from them for sure."""
    rng = np.random.default_rng(3)
    found = [fitted(0.2 * rng.normal(size=RAYS), weights_of(0.0)) for _ in range(300)]
    scatter = np.sqrt(np.mean([off @ off for off, _ in found]))
    claimed = np.sqrt(np.mean([np.trace(claim) for _, claim in found]))
    assert 1.0 < claimed / scatter < 4.0


def test_a_fixed_share_of_the_noise_would_not_hold_smooth_errors():
    """Negative control: what independent edges leave open is far too little."""
    rng = np.random.default_rng(1)
    weights = weights_of(0.0)
    normal = COLUMNS.T @ (weights[:, None] * COLUMNS)
    inverse = np.linalg.inv(normal)[:2, :2]
    squares = []
    for _ in range(200):
        errors = smooth_errors(rng, 0.4)
        off, _ = fitted(errors, weights)
        left = errors - COLUMNS @ np.linalg.solve(normal, COLUMNS.T @ (weights * errors))
        squares.append(off @ np.linalg.solve(inverse * np.mean(weights * left**2), off))
    assert np.mean(np.array(squares) < 5.991) < 0.5
