"""Two identical bodies in the pictures: nobody can tell which is meant, and that is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.api import load_profile, measure_session
from measure.host import Registry
from measure.session import open_session
from measure.simulation import Still, scene_catalogue, write_session
from measure.simulation.degraded import with_second_body
from measure.simulation.shading import Material
from measure.simulation.shapes import Capsule


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


@pytest.mark.slow
def test_a_second_body_beside_one_that_is_mostly_hidden_is_flagged(tmp_path):
    """Of the first, one ball is behind posts for all cameras; the second is in full view."""
    scene = scene_catalogue()["still"]
    middle = scene.trajectory.at(np.array([0.0]))[0]
    red = middle.apply(scene.body.balls[scene.body.index("red")].center_mm)
    posts = []
    for camera in scene.cameras:
        foot = red + 0.16 * (camera.center - red)
        up = np.array([0.0, 0.0, 34.0])
        posts.append(Capsule(foot - up, foot + up, 19.0, Material((0.02,) * 3)))
    beside = middle.perturb([40.0, 115.0, 20.0, 0.2, 0.1, 0.4])
    hidden = replace(scene, trajectory=Still(middle), attached=(), fixed=tuple(posts))
    write_session(with_second_body(hidden, Still(beside)), np.arange(2) / 30, tmp_path)
    with open_session(tmp_path) as session:
        pipeline = measure_session(session, load_profile("precise"), Registry.discover())
        measured = [measurement for _, measurement in pipeline]
    for one in measured:
        if one.pose is not None:
            assert any("second body" in flag for flag in one.pose.flags)
        else:
            assert "two bodies" in one.reason
    off = [m.pose.world_from_body.difference(beside) for m in measured if m.pose is not None]
    assert any(np.linalg.norm(delta[:3]) < 1 for delta in off)  # it is the second that is found
