"""What outlines say of the balls' radii, and what of it goes into the fit."""

from __future__ import annotations

import numpy as np
import pytest

from measure.measuring.body_size import OutlineGrowth, with_estimated_radii


def _shown(body, *growth_mm):
    """Growth that shrinks by half of what radii are enlarged: half is learnt as appearance."""
    common, own = 0.8 * 0.06**2, 0.2 * 0.06**2
    covariance = common + own * np.eye(len(growth_mm))

    def measure(tried):
        return OutlineGrowth(np.array(growth_mm) - (tried.radii - body.radii) / 2, covariance)

    return measure


def test_growth_of_one_ball_alone_goes_into_the_fit_and_its_size_stays(paper_body):
    found = with_estimated_radii(paper_body, _shown(paper_body, -0.02, -0.005, 0.04))
    assert not found.contradict
    moved = found.body.radii - paper_body.radii
    assert moved.mean() == pytest.approx(0, abs=1e-9)
    assert moved == pytest.approx([-0.0066, -0.0026, 0.0092], abs=2e-4), "a quarter: most is noise"


@pytest.mark.parametrize("growth", [(0.03, 0.03, 0.03), (0.012, 0.022, 0.03), (0, 0, 0)])
def test_growth_that_all_balls_share_or_noise_may_make_changes_no_radius(paper_body, growth):
    found = with_estimated_radii(paper_body, _shown(paper_body, *growth))
    assert np.array_equal(found.body.radii, paper_body.radii)


def test_balls_of_another_size_contradict_the_file(paper_body):
    found = with_estimated_radii(paper_body, _shown(paper_body, 0.15, 0.15, 0.15))
    assert found.contradict
    assert found.body.radii - paper_body.radii == pytest.approx([0.3] * 3, abs=0.06)
