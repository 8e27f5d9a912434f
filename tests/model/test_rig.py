from __future__ import annotations

import numpy as np

from measure.model import Rig
from tests.scenes import RAVEN, TARGET, ring


def test_projects_like_each_camera():
    cameras = ring()
    rig = Rig.of(list(cameras.values()))
    points = TARGET + RAVEN.centers[[0, 1, 2, 0]]
    pixels, by_world = rig.project(points)
    for i, camera in enumerate(cameras.values()):
        expected, expected_by_world, _, _ = camera.project_with_jacobians(points[i : i + 1])
        np.testing.assert_allclose(pixels[i], expected[0], atol=1e-9)
        np.testing.assert_allclose(by_world[i], expected_by_world[0], atol=1e-9)


def test_rays_go_back_through_the_point():
    rig = Rig.of(list(ring().values()))
    pixels, _ = rig.project(TARGET)
    np.testing.assert_allclose(rig.rays(pixels).distances(TARGET), 0, atol=1e-6)


def test_a_point_behind_a_camera_has_no_pixel():
    rig = Rig.of(list(ring().values()))
    behind_first = rig.centers[0] + (rig.centers[0] - TARGET)
    pixels, _ = rig.project(behind_first)
    assert np.all(np.isnan(pixels[0]))
    assert np.all(np.isfinite(pixels[2]))


def test_take_keeps_order():
    rig = Rig.of(list(ring().values()))
    assert rig.take([2, 0]).names == ("cam2", "cam0")
    np.testing.assert_array_equal(rig.take([2, 0]).centers, rig.centers[[2, 0]])
