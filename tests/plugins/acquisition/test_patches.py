"""Speckle and borders, against OpenCV's median filter and contours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure_plugins._acquisition.patches import borders, framed, majority

SHAPES = [(1, 9), (9, 1), (40, 57), (90, 161)]


def pictures(shape, seed):
    """Speckle, thin and thick; and patches with holes and with patches in the holes."""
    rng = np.random.default_rng(seed)
    for share in (0.0, 0.05, 0.4, 0.7, 1.0):
        yield (rng.random(shape) < share).astype(np.uint8)
    blurred = cv2.GaussianBlur(rng.random(shape), (0, 0), 2.0)
    yield (blurred > np.median(blurred)).astype(np.uint8)
    rings = np.zeros(shape, np.uint8)
    for radius in (40, 30, 20, 10):
        cv2.circle(rings, (shape[1] // 2, shape[0] // 2), radius, (radius // 10) % 2, -1)
    yield rings


@pytest.mark.parametrize("shape", SHAPES)
def test_majority_is_the_median_of_every_colour(shape):
    for one, other in zip(pictures(shape, 0), pictures(shape, 1), strict=True):
        both = majority(one | (other << 7))
        assert np.array_equal(both & 1, cv2.medianBlur(one, 3))
        assert np.array_equal(both >> 7, cv2.medianBlur(other, 3))


@pytest.mark.parametrize("shape", SHAPES)
def test_borders_are_the_outer_contours(shape):
    for mask in pictures(shape, 2):
        ours = [part.tolist() for part in borders(framed(mask << 3, 8), 1)]
        theirs = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        assert sorted(map(sorted, ours)) == sorted(sorted(c[:, 0].tolist()) for c in theirs)
        for border in ours:  # in order: from each pixel to a neighbour
            steps = np.abs(np.subtract(border, np.roll(border, 1, axis=0)))
            assert len(border) == 1 or np.all(steps.max(axis=1) == 1)


def test_short_borders_are_left_out():
    mask = np.zeros((20, 30), np.uint8)
    mask[3, 3] = 1
    mask[10:14, 10:14] = 1
    (only,) = borders(framed(mask, 1), 10)
    assert len(only) == 12
    assert not borders(framed(mask, 1), 13)
