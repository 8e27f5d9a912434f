"""The arm of the benchmark of robots that are not RAVEN."""

from __future__ import annotations

import numpy as np

from benchmarks import any_robot
from measure_learning.robots import find_schema


def test_the_arm_of_the_benchmark_is_a_ur5e_that_errs() -> None:
    """The truth differs from the published arm by about what links and gears were drawn with."""
    arm, published = any_robot.make_arm(), find_schema("ur5e").chain
    assert published is not None
    q = np.deg2rad(any_robot.HOME_DEG)[None]
    off = np.linalg.norm(arm.pose(q).translation - published.tip_mm(q))
    assert 0.3 < off < 10
