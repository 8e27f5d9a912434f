"""What is claimed of outlines whose edges are off piece by piece, against how they scatter."""

from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.fitting.covariance import piecewise_covariance
from measure_plugins._outline.fitting.robust_cone import refine

RAYS, PIECES, TRIALS = 72, 12, 400
PHI = 2 * np.pi * np.arange(RAYS) / RAYS
AROUND = np.stack([np.cos(PHI), np.sin(PHI)], axis=1)
SD = np.full(RAYS, 0.05)
NOTHING_KNOWN = (0.0, 1e3)


def fits(in_sight, piece_px, seed=0):
    """Axes fitted to outlines at the same place; what is claimed of each; and by the rays alone."""
    rng = np.random.default_rng(seed)
    use = (np.arange(RAYS) < in_sight * RAYS).astype(float)
    found, claimed, by_rays = [], [], []
    for _ in range(TRIALS):
        shifts = np.repeat(rng.normal(scale=piece_px, size=PIECES), RAYS // PIECES)
        shifts += rng.normal(scale=SD)
        solution, normal, weights, scale = refine(
            shifts, AROUND, SD, use, np.zeros(3), 3.0, NOTHING_KNOWN
        )
        off = shifts - AROUND @ solution[:2] - solution[2]
        spread = piecewise_covariance(AROUND, weights / (SD * scale) ** 2, off, normal)
        found.append(solution[:2])
        claimed.append(np.trace(spread))
        by_rays.append(np.trace(np.linalg.inv(normal)[:2, :2]))
    scatter = np.sqrt(np.mean(np.sum(np.square(found), axis=1)))
    return scatter, np.sqrt(np.mean(claimed)), np.sqrt(np.mean(by_rays))


@pytest.mark.parametrize("piece_px", [0.1, 0.3])
@pytest.mark.parametrize("in_sight", [1.0, 0.75, 0.5])
def test_pieces_that_are_off_as_a_whole_are_allowed_for(in_sight, piece_px):
    scatter, claimed, _ = fits(in_sight, piece_px)
    assert 0.75 < claimed / scatter < 1.3


def test_rays_taken_one_by_one_claim_far_too_much():
    """The control: what the fit's own normal matrix says."""
    scatter, _, by_rays = fits(0.5, 0.15)
    assert by_rays < 0.55 * scatter


def test_half_an_outline_tells_much_less_than_a_whole_one():
    """A shift and growth look alike there: more than twice as few edges would make it."""
    assert fits(0.5, 0.15)[1] > 2 * fits(1.0, 0.15)[1]
