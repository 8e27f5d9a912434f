"""The cube of tags that the balls are compared with."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.tags import FAMILIES, cube, fitted, measured
from measure.simulation.catalogue import webcam_scene


def test_the_pose_of_a_cube_follows_from_exact_corners():
    scene = webcam_scene()
    pose = scene.trajectory.at(0.3)
    faces = cube("ArUco 5x5")
    seen = [
        (camera, face.corners(), camera.project(pose.apply(face.corners())))
        for camera in scene.cameras
        for face in faces[:3]
    ]
    found = fitted(seen)
    assert found is not None
    np.testing.assert_allclose(found.difference(pose), 0, atol=1e-5)
    assert fitted([]) is None


@pytest.mark.parametrize("family", FAMILIES)
def test_tags_are_found_where_they_are_drawn(family):
    """One picture a camera: half a pixel of a wrong convention would be .15 mm."""
    found = measured(webcam_scene(), family, np.array([0.1]), 0.0, 0.0)
    assert found.missing == 0
    assert found.position_mm < 0.05
    assert found.rotation_deg < 0.15
