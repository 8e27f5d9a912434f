"""Light along rays: interpolated, or that of the nearest pixel."""

from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.sampling.rays import (
    CLEAR,
    OCCLUDED,
    OUT_OF_IMAGE,
    RaySet,
    frame_about,
    sample,
    sample_nearest,
)

HEIGHT, WIDTH = 30, 40
TABLE = np.linspace(0.0, 1.0, 256)
STEPS = np.arange(-2.0, 3.0)
ACROSS = np.array([[1.0, 0.0]])


@pytest.fixture(scope="module")
def picture():
    return np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def _all(steps):
    return np.ones(len(steps), np.bool_)


def rays_at(points, normals, status=None, color_shifts=None):
    points = np.asarray(points, dtype=np.float64)
    normals = np.ascontiguousarray(np.broadcast_to(normals, points.shape), dtype=np.float64)
    known = np.full(len(points), CLEAR, np.int8) if status is None else np.array(status, np.int8)
    shifts = np.empty((0, len(points), 2)) if color_shifts is None else color_shifts
    return RaySet(points, normals, normals, known, shifts)


def test_rays_that_leave_the_picture_are_marked_and_hidden_ones_left_alone(picture):
    points = [(20.0, 15.0), (1.0, 15.0), (20.0, 15.0), (WIDTH - 2.5, 15.0)]
    known = [CLEAR, CLEAR, OCCLUDED, CLEAR]
    rays = rays_at(points, ACROSS, known)
    light, _ = sample(picture, TABLE, rays, STEPS, _all(STEPS), len(STEPS))
    assert rays.status.tolist() == [CLEAR, OUT_OF_IMAGE, OCCLUDED, OUT_OF_IMAGE]
    np.testing.assert_allclose(light[:, :, 0], TABLE[picture[15, 18:23].T], atol=1e-6)
    assert not np.any(light[:, :, 1:])


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.4, 0.0), (-0.4, 0.3), (0.49, -0.49)])
def test_between_pixels_the_nearest_counts(picture, off):
    points = np.array([(12.0, 9.0), (30.0, 21.0)])
    light, _ = sample(picture, TABLE, rays_at(points, ACROSS), STEPS, _all(STEPS), len(STEPS))
    nearest = sample_nearest(picture, TABLE, rays_at(points + off, ACROSS), STEPS)
    np.testing.assert_allclose(nearest, light, atol=1e-6)


def test_values_are_interpolated_between_pixels() -> None:
    """On a picture that rises evenly, a value is what its place says."""
    v, u = np.mgrid[0:40, 0:60]
    picture = np.stack([2 * u + 3 * v, 4 * u, 5 * v], axis=-1).astype(np.uint8)
    points, normals = np.array([[20.3, 18.6], [30.0, 10.25]]), np.array([[0.6, 0.8], [1.0, 0.0]])
    steps, table = np.array([-2.0, 0.0, 1.5]), np.arange(256) / 255.0
    light, values = sample(picture, table, rays_at(points, normals), steps, _all(steps), 0)
    x = points[:, 0] + steps[:, None] * normals[:, 0]
    y = points[:, 1] + steps[:, None] * normals[:, 1]
    assert np.allclose(255 * values, np.stack([2 * x + 3 * y, 4 * x, 5 * y]), atol=1e-9)
    assert np.allclose(light, values, atol=1e-12)


def test_light_is_read_where_it_is_wanted_and_nowhere_else(picture) -> None:
    points, normals = np.array([[20.3, 18.6], [30.0, 10.25]]), np.array([[0.6, 0.8], [1.0, 0.0]])
    steps, lit = np.array([-2.0, 0.0, 1.5]), np.array([True, False, True])
    light, values = sample(picture, TABLE, rays_at(points, normals), steps, lit, 1)
    full, _ = sample(picture, TABLE, rays_at(points, normals), steps, _all(steps), 1)
    np.testing.assert_array_equal(light[:, lit], full[:, lit])
    assert np.all(light[:, ~lit] == 0)
    assert np.any(full[:, ~lit] != 0)
    assert np.all(values[:, 0] > 0)


@pytest.mark.parametrize("x", [0, WIDTH - 2])
@pytest.mark.parametrize("y", [0, HEIGHT - 2])
def test_values_are_read_up_to_the_last_pixel(picture, x, y) -> None:
    """Pixels are read four bytes at once; the picture's last one has but three."""
    points, one = np.array([[x + 0.25, y + 0.75]]), np.zeros(1)
    light, values = sample(picture, TABLE, rays_at(points, ACROSS), one, _all(one), 0)
    upper = 0.75 * picture[y, x] + 0.25 * picture[y, x + 1]
    lower = 0.75 * picture[y + 1, x] + 0.25 * picture[y + 1, x + 1]
    assert values[:, 0, 0] == pytest.approx((0.25 * upper + 0.75 * lower) / 255, abs=1e-6)
    assert light == pytest.approx(values, abs=1e-6)


def test_frames_turn_with_their_axes_wherever_a_camera_looks():
    """Also across the picture's diagonals, where the coordinate nearest to zero is another one."""
    step = 1e-3
    for x in np.linspace(-1.5, 1.5, 61):
        for y in {*np.linspace(-1.5, 1.5, 61), x - step / 2, -x - step / 2}:
            here, beside = (_frame(u, v) for u, v in ((x, y), (x, y + step)))
            np.testing.assert_allclose(here @ here.T, np.eye(3), atol=1e-12)
            np.testing.assert_allclose(np.linalg.det(here), 1.0)
            assert np.max(np.abs(beside - here)) < 2 * step, (x, y)


def _frame(x, y):
    axis = np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])
    frame = frame_about(axis)
    np.testing.assert_array_equal(frame[2], axis)
    return frame


def test_every_colour_is_sampled_where_the_lens_puts_it(picture):
    points, shifts = np.array([(12.2, 9.4), (30.7, 21.1)]), np.zeros((3, 2, 2))
    shifts[0], shifts[2] = (-0.7, -0.4), (0.6, 1.3)
    light, values = sample(
        picture, TABLE, rays_at(points, ACROSS, None, shifts), STEPS, _all(STEPS), 0
    )
    for color, shift in enumerate(shifts):
        there = sample(picture, TABLE, rays_at(points + shift, ACROSS), STEPS, _all(STEPS), 0)
        np.testing.assert_allclose(light[color], there[0][color], atol=1e-6)
        np.testing.assert_allclose(values[color], there[1][color], atol=1e-6)
    unshifted, _ = sample(picture, TABLE, rays_at(points, ACROSS), STEPS, _all(STEPS), 0)
    assert not np.allclose(light[0], unshifted[0])
    edge = rays_at([(WIDTH - 4.0, 15.0)], ACROSS, None, np.full((3, 1, 2), 1.4))
    sample(picture, TABLE, edge, STEPS, _all(STEPS), 0)
    assert edge.status.tolist() == [OUT_OF_IMAGE], "no colour is read beyond the border"
