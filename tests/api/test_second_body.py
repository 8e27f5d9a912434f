"""Two identical bodies in the pictures: nobody can tell which is meant, so none is measured."""

from __future__ import annotations

import numpy as np
import pytest

from measure.api import load_profile, measure_session
from measure.host import Registry
from measure.session import open_session
from measure.simulation import Still, scene_catalogue, write_session
from measure.simulation.degraded import with_second_body


@pytest.mark.slow
def test_a_second_body_in_view_is_refused_in_every_frame_not_guessed(tmp_path):
    scene = scene_catalogue()["still"]
    beside = scene.trajectory.at(np.array([0.0]))[0].perturb([-90.0, 70.0, -60.0, 0.2, 0.1, 0.4])
    write_session(with_second_body(scene, Still(beside)), np.arange(3) / 30, tmp_path)
    with open_session(tmp_path) as session:
        pipeline = measure_session(session, load_profile("precise"), Registry.discover())
        measured = [measurement for _, measurement in pipeline]
    assert len(measured) == 3
    assert all(one.pose is None for one in measured)
    assert all(one.reason.startswith("two bodies fit") for one in measured)
