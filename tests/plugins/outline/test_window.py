"""Where the colour inside an outline is taken, and small outlines that need it near the edge."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from measure.api import build_pipeline, load_profile
from measure.host import Registry
from measure.session import open_session, read_trajectory
from measure.simulation import write_session
from measure_plugins._outline.fitting.edges import INSIDE_PX, inside_window
from tests.simulated.unusual import unusual_scenes


def outline(radius):
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    return 100 + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("radius", [49.0, 70.0, 150.0])
def test_large_outlines_are_looked_into_as_deep_as_ever(radius):
    assert inside_window(outline(radius + 0.1)) == INSIDE_PX


def test_small_ones_less_deep_but_clear_of_the_blur():
    deep = [inside_window(outline(radius)) for radius in (48.0, 40.0, 30.0, 20.0, 12.0)]
    assert all(a[0] <= b[0] and a[1] <= b[1] for a, b in pairwise(deep))
    assert deep[0][0] == pytest.approx(INSIDE_PX[0], rel=0.03)
    assert deep[-1][1] <= -1.79
    assert all(far < near - 2.0 for far, near in deep)  # some samples to take the median of


def test_small_far_balls_are_measured_and_known_no_better_than_they_are(tmp_path):
    """Outlines of 12 px: looked into as deep as large ones, they were off by four sigma."""
    write_session(unusual_scenes()["far"], np.arange(2) / 30, tmp_path)
    truth = read_trajectory(tmp_path / "truth.csv")
    with open_session(tmp_path) as session:
        profile = load_profile("precise")
        pipeline = build_pipeline(profile, Registry.discover(), session.body, session.cameras)
        for one in pipeline.measure(session.frame_sets()):
            assert one.pose is not None
            delta = one.pose.world_from_body.difference(truth.at([one.pose.time_s])[0])[:3]
            assert np.linalg.norm(delta) < 0.5
            assert delta @ np.linalg.solve(one.pose.covariance[:3, :3], delta) < 11.3  # 99 %
