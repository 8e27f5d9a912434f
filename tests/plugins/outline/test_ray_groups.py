"""Rays taken together in pairs: what they show on average, whichever of them has a clear way."""

from __future__ import annotations

import numpy as np

from measure_plugins._outline.sampling.rays import (
    CLEAR,
    OCCLUDED,
    OUT_OF_IMAGE,
    angles_around,
    middle_angles,
    together,
)


def test_middle_angles_lie_halfway_between_the_rays_of_a_pair() -> None:
    middle = middle_angles(angles_around(72))

    angles = np.degrees(np.arctan2(middle[:, 1], middle[:, 0])) % 360
    np.testing.assert_allclose(angles, 2.5 + 10 * np.arange(36), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 1, atol=1e-12)


def test_a_pair_shows_the_mean_of_its_clear_rays() -> None:
    light = np.random.default_rng(1).uniform(size=(3, 5, 8))
    status = np.array(
        [CLEAR, CLEAR, CLEAR, OCCLUDED, OUT_OF_IMAGE, CLEAR, OCCLUDED, OUT_OF_IMAGE], np.int8
    )

    shown, grouped = together(light, status)

    np.testing.assert_allclose(shown[:, :, 0], light[:, :, :2].mean(axis=2))
    np.testing.assert_allclose(shown[:, :, 1], light[:, :, 2])
    np.testing.assert_allclose(shown[:, :, 2], light[:, :, 5])
    np.testing.assert_array_equal(shown[:, :, 3], 0)
    np.testing.assert_array_equal(grouped, [CLEAR, CLEAR, CLEAR, OCCLUDED])
