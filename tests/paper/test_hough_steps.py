"""Each step of the figure on pictures made by hand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure_paper import _hough_steps as steps
from measure_paper._hough_steps import cut, regions


def disc(center, radius, inside=255, outside=0, size=(200, 200)):
    y, x = np.mgrid[: size[0], : size[1]]
    distance = np.hypot(x - center[0], y - center[1])
    return (outside + (inside - outside) * np.clip(radius - distance + 0.5, 0, 1)).astype(np.uint8)


def radii_of(edges, center):
    y, x = np.nonzero(edges)
    return np.hypot(x - center[0], y - center[1])


def test_edges_lie_on_the_border_of_a_disc():
    picture = cv2.merge([disc((100, 100), 60, 90, 20)] * 3)
    radii = radii_of(steps.gray_edges(picture, 1.5, 40), (100, 100))
    assert len(radii) > 300
    assert abs(radii.mean() - 60) < 0.6
    assert np.abs(radii - 60).max() < 2.5


def test_blur_removes_noise_edges():
    noise = np.random.default_rng(0).normal(60, 6, (200, 200, 3)).clip(0, 255).astype(np.uint8)
    sharp = np.count_nonzero(steps.gray_edges(noise, 0.5, 40))
    smooth = np.count_nonzero(steps.gray_edges(noise, 2.0, 40))
    assert sharp > 1000
    assert smooth < 0.02 * sharp


@pytest.mark.parametrize("sigma", [2.0, 6.0, 9.0])
def test_segments_are_enlarged_and_specks_vanish(sigma):
    channel = disc((100, 100), 60)
    channel[10, 10] = channel[180, 20] = 255
    segments = steps.enlarge(channel, sigma, 0.15)
    assert set(np.unique(segments)) == {0, 1}
    assert segments[10, 10] == segments[180, 20] == 0
    grown = np.sqrt(np.count_nonzero(segments) / np.pi) - 60
    # A straight border blurred by sigma reaches 15 % of its height 1.04 sigma outside.
    assert 0.8 * sigma < grown < 1.2 * sigma + 0.5


def test_product_keeps_the_border_and_drops_edges_outside_the_segments():
    picture = cv2.merge([disc((100, 100), 50, 90, 20)] * 3)
    cv2.rectangle(picture, (5, 5), (30, 195), (120, 120, 120), -1)
    edges = steps.gray_edges(picture, 1.5, 40)
    segments = steps.enlarge(disc((100, 100), 50), 5.0, 0.15)
    kept = steps.refine_border(edges, segments)
    assert np.count_nonzero(edges[:, :35]) > 200
    assert np.count_nonzero(kept[:, :35]) == 0
    assert np.count_nonzero(kept) > 250
    assert np.all(kept[kept > 0] == 255)


def test_hough_finds_circles_without_bias():
    """A single centre scatters by about a pixel even on perfect discs; the mean must not be off."""
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(40):
        x, y, radius = *rng.uniform(95, 105, 2), rng.uniform(50, 60)
        picture = cv2.merge([disc((x, y), radius, 90, 20)] * 3)
        edges = steps.gray_edges(picture, 1.5, 40)
        circles = steps.hough_circles(edges, 12, (45, 65), 120, 1.0, 100.0)
        assert circles.shape == (1, 3)
        errors.append(circles[0] - [x, y, radius])
    assert np.abs(np.mean(errors, axis=0)).max() < 0.6
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 1.3


def test_hough_of_nothing_is_an_empty_array():
    circles = steps.hough_circles(np.zeros((80, 80), np.uint8), 5, (10, 20), 10, 1.0, 100.0)
    assert circles.shape == (0, 3)


@pytest.mark.parametrize("percent", [0, 24, 26, 50, 100])
def test_color_share_counts_the_border(percent):
    """A ring of which exactly `percent` of the directions have the colour."""
    y, x = np.mgrid[:200, :200]
    angle = (np.arctan2(y - 100, x - 100) + np.pi / 200) % (2 * np.pi)
    channel = np.where(angle < 2 * np.pi * percent / 100, 255, 0).astype(np.uint8)
    share = steps.color_share(channel, np.array([100.0, 100.0, 60.0]), 100, (0.75, 0.9))
    assert share == pytest.approx(percent / 100, abs=0.011)


def test_color_share_ignores_the_middle_and_counts_outside_the_picture_as_wrong():
    hollow = disc((100, 100), 60) - disc((100, 100), 40)
    circle = np.array([100.0, 100.0, 60.0])
    assert steps.color_share(hollow, circle, 72, (0.75, 0.9)) == 1.0
    everywhere = np.full((200, 200), 255, np.uint8)
    half_out = np.array([0.0, 100.0, 60.0])
    assert steps.color_share(everywhere, half_out, 72, (0.75, 0.9)) == pytest.approx(0.5, abs=0.02)


def test_regions_hold_every_large_segment_and_no_speck():
    segments = np.zeros((400, 600), np.uint8)
    segments[50:120, 60:130] = segments[300:360, 500:560] = 1
    segments[200:206, 300:306] = 1
    found = regions(segments, smallest_px=40, margin_px=10)
    assert len(found) == 2
    covered = np.zeros_like(segments)
    for rows, columns in found:
        covered[rows, columns] += 1
    assert covered[50:120, 60:130].min() == covered[300:360, 500:560].min() == 1
    assert covered[200:206, 300:306].max() == 0


def test_overlapping_regions_become_one():
    segments = np.zeros((400, 600), np.uint8)
    segments[50:120, 60:130] = segments[125:200, 135:220] = segments[40:220, 240:300] = 1
    found = regions(segments, smallest_px=40, margin_px=20)
    assert len(found) == 1
    rows, columns = found[0]
    assert (rows.start, columns.start) <= (40 - 20, 60 - 20)
    assert rows.stop >= 220
    assert columns.stop >= 300


def test_cut_stops_at_the_border():
    picture = np.arange(100 * 80 * 3, dtype=np.uint32).reshape(100, 80, 3).astype(np.uint8)
    window = cut(picture, np.array([-10.0, 40.2]), np.array([20.0, 500.0]))
    assert window.origin == (0, 40)
    assert np.array_equal(window.image.bgr, picture[40:, :21])
    assert cut(picture, np.array([90.0, 0.0]), np.array([120.0, 20.0])) is None
