from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.sampling.prefetch import ask_for_outline, ask_for_row, ring_in_row
from measure_plugins._outline.sampling.rays import STEPS, cast_rays, frame_about, sample

WIDTH, HEIGHT, FOCAL = 320, 240, 700.0
LENS = np.array([FOCAL, 0.0, 160.0, FOCAL, 120.0, *np.zeros(8)])
HALF_ANGLE = 0.05


def _axis(u, v):
    ray = np.array([(u - 160.0) / FOCAL, (v - 120.0) / FOCAL, 1.0])
    return ray / np.linalg.norm(ray)


def _asked_for(u, v):
    """Pixels (h, w) in the ring about an outline."""
    out = np.zeros((HEIGHT, WIDTH), bool)
    for y in range(HEIGHT):
        for start, end in ring_in_row(u, v, FOCAL * np.tan(HALF_ANGLE), y, WIDTH):
            assert 0 <= start <= WIDTH
            assert 0 <= end <= WIDTH
            out[y, start:end] = True
    return out


@pytest.mark.parametrize("center", [(160.0, 120.0), (203.3, 91.8), (60.0, 180.0)])
def test_what_rays_read_is_asked_for_and_little_else(center):
    axis, black = _axis(*center), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rays, _ = cast_rays(frame_about(axis), HALF_ANGLE, 720, LENS)
    read = np.zeros((HEIGHT, WIDTH), bool)
    for step in STEPS:
        x, y = np.floor(rays.points + step * rays.normals).astype(int).T
        for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
            read[y + down, x + right] = True
    asked = _asked_for(*center)
    assert not np.any(read & ~asked)
    assert np.count_nonzero(asked) < 1.4 * np.count_nonzero(read)
    ask_for_outline(black, axis, HALF_ANGLE, LENS)
    light, _ = sample(black, np.ones(256), rays, STEPS, np.ones(len(STEPS), np.bool_), 0)
    assert light == pytest.approx(1.0)


@pytest.mark.parametrize("center", [(-500.0, 120.0), (2.0, 2.0), (319.0, 239.0), (400.0, 120.0)])
def test_outlines_beyond_the_picture_ask_for_nothing_outside_it(center):
    ask_for_outline(np.zeros((HEIGHT, WIDTH, 3), np.uint8), _axis(*center), HALF_ANGLE, LENS)
    asked = _asked_for(*center)
    assert np.any(asked) == (0 <= center[0] <= WIDTH)
    assert np.count_nonzero(asked) < 0.1 * asked.size


@pytest.mark.parametrize("y", [0, 9, 10, 400])
def test_rows_are_only_asked_for_where_there_are_any(y):
    rows = np.arange(1000, dtype=np.uint8).reshape(10, 100)
    before = rows.copy()
    ask_for_row(rows, y)
    assert np.array_equal(rows, before)
