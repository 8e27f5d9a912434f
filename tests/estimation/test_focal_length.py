"""The focal length by outlines of balls: exact ones, arcs, and what is no ball."""

from __future__ import annotations

import numpy as np
import pytest

from measure.estimation.focal_length import focal_by_outlines, zoomed
from measure.geometry import tangent_cone
from measure.model import Intrinsics

EXPECTED = Intrinsics((1280, 960), np.array([[920.0, 0, 639.5], [0, 920.0, 479.5], [0, 0, 1]]))
LOG_SD = 0.8


def outlines(focal_px, noise_px=0.2, arc=1.0):
    lens, rng = zoomed(EXPECTED, focal_px / EXPECTED.focal_px), np.random.default_rng(0)
    out = []
    for u, v, radius in ((160, 150, 110), (1090, 200, 90), (1000, 800, 130)):
        axis = lens.unproject(np.array([[u, v]]))[0]
        points = lens.outline(tangent_cone(axis * focal_px / radius * 20, 20.0))
        points = points[: round(arc * len(points))]
        out.append(points + rng.normal(scale=noise_px, size=points.shape))
    return out


@pytest.mark.parametrize("focal_px", [480.0, 700.0, 1500.0, 2600.0])
@pytest.mark.parametrize("arc", [1.0, 0.6])
def test_it_is_found(focal_px, arc):
    found = focal_by_outlines(outlines(focal_px, arc=arc), EXPECTED, LOG_SD)
    assert found.contradicts
    assert found.px == pytest.approx(focal_px, rel=0.08)


def test_what_was_expected_is_not_contradicted():
    assert not focal_by_outlines(outlines(920.0), EXPECTED, LOG_SD).contradicts
    middle = [outlines(3000.0)[0] - (160, 150) + (639.5, 479.5)]  # on the axis: nothing to tell
    assert not focal_by_outlines(middle, EXPECTED, LOG_SD).contradicts


def test_one_thing_that_is_no_ball_does_not_decide():
    poster = np.array([[200.0 + 300 * np.cos(a), 700 + 80 * np.sin(a)] for a in np.linspace(0, 6)])
    found = focal_by_outlines([*outlines(1500.0), poster], EXPECTED, LOG_SD)
    assert found.px == pytest.approx(1500, rel=0.08)


def test_nothing_seen_tells_nothing():
    assert focal_by_outlines([], EXPECTED, LOG_SD) is None
    assert focal_by_outlines([np.full((9, 2), 5.0)], EXPECTED, LOG_SD) is None
