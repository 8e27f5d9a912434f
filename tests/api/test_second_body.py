"""Two identical bodies in the pictures: nobody can tell which is meant, and that is said."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from measure.api import load_profile, measure_session
from measure.host import Registry
from measure.measuring import Status
from measure.session import open_session
from measure.simulation import Still
from measure.simulation.scene import Capsule, Material
from tests.simulated.catalogue import scene_catalogue
from tests.simulated.degraded import with_second_body
from tests.simulated.sessions import rendered


@pytest.mark.slow
def test_a_second_body_in_view_gives_no_pose():
    scene = scene_catalogue()["still"]
    beside = scene.trajectory.at(np.array([0.0]))[0].perturb([-90.0, 70.0, -60.0, 0.2, 0.1, 0.4])
    found = measured(rendered(with_second_body(scene, Still(beside)), np.arange(3) / 30))
    assert len(found) == 3
    assert all(one.pose is None for one in found)
    assert all(one.reason.startswith("two bodies fit") for one in found)


def posts_before(scene, pose, shown=(), toward=0.3, radius_mm=16.0):
    """Posts between every camera and every ball of a body at `pose`, but those of `shown`."""
    up = np.array([0.0, 0.0, 34.0])
    out = []
    for ball in scene.body.balls:
        place = pose.apply(ball.center_mm)
        for camera in scene.cameras:
            if (ball.name, camera.name) not in shown:
                foot = place + toward * (camera.center - place)
                out.append(Capsule(foot - up, foot + up, radius_mm, Material((0.02,) * 3)))
    return tuple(out)


def measured(folder):
    with open_session(folder) as session:
        pipeline = measure_session(session, load_profile("precise"), Registry.discover())
        return [measurement for _, measurement in pipeline]


@pytest.mark.slow
def test_two_balls_of_a_hidden_body_suffice_for_a_flag():
    """The second stands 70 mm beside the first, in full view; the first is hidden but for these."""
    scene = scene_catalogue()["still"]
    middle = scene.trajectory.at(np.array([0.0]))[0]
    beside = middle.perturb([-20.0, 62.0, 26.0, 0.3, -0.2, 0.5])
    posts = posts_before(scene, middle, {("yellow", "cam2"), ("red", "cam2")})
    hidden = replace(scene, trajectory=Still(middle), attached=(), fixed=posts)
    found = measured(rendered(with_second_body(hidden, Still(beside)), np.arange(2) / 30))
    assert all(one.pose is not None for one in found)
    for one in found:
        off = one.pose.world_from_body.difference(beside)
        assert np.linalg.norm(off[:3]) < 1  # the wrong one: nothing else can be located
        assert any("second body" in flag for flag in one.pose.flags)


@pytest.mark.slow
def test_single_balls_in_a_scene_are_no_second_body(renders):
    folder = renders / "clutter"
    with open_session(folder) as session:
        pipeline = measure_session(session, load_profile("precise"), Registry.discover())
        found = [measurement for _, measurement in islice(pipeline, 3)]
    assert [one.status for one in found] == [Status.OK] * 3
