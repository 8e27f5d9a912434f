"""Small records: what they compute of themselves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.model import Detection, Image, Motion


def test_a_pixel_array_is_decoded_once():
    calls = []

    def decode():
        calls.append(1)
        return np.zeros((2, 3, 3), np.uint8)

    image = Image("cam0", 0, 0.0, decode)
    assert not calls
    assert image.pixels is image.pixels
    assert calls == [1]


def test_constant_velocity_moves_and_turns_in_the_world():
    start = RigidTransform.from_rotvec([0.2, 0, 0], [10, 20, 30])
    motion = Motion(start, 2.0, np.array([1, 2, 3, 0, 0, 0.5]))
    later = motion.at(4.0)
    np.testing.assert_allclose(later.translation, [12, 24, 36])
    turn = RigidTransform.from_rotvec([0, 0, 1.0])
    np.testing.assert_allclose(later.rotation, turn.rotation @ start.rotation, atol=1e-12)
    np.testing.assert_allclose(motion.at(2.0).matrix, start.matrix)
    np.testing.assert_allclose(Motion.at_rest(start, 0.0).at(9.0).matrix, start.matrix)


def test_what_was_seen_cannot_be_changed():
    seen = Detection("green", "cam0", 0.0, np.zeros(2), 60.0, np.eye(2))
    with pytest.raises(dataclasses.FrozenInstanceError):
        seen.radius_px = 1.0  # type: ignore[misc]
