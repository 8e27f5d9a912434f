"""Rays that meet saturated pixels, and estimates in spite of them."""

from __future__ import annotations

import numpy as np
import pytest

from measure.geometry import tangent_cone
from measure_plugins._outline.appearance.model import GLOSSY
from measure_plugins._outline.sampling.edge_crossing import HIGHLIGHT_PX, clipped, in_highlights
from measure_plugins._outline.sampling.rays import CLEAR, OCCLUDED
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import draw, expect, image_of, to_picture
from tests.plugins.outline.estimates import estimates
from tests.plugins.rendering import scenes
from tests.scenes import RAVEN, ring

STEPS = np.arange(-7.0, 4.5, 0.5)


def rays(count=12, radius=30.0, center=50.0):
    """Points (n, 2) of an outline, and its normals."""
    angle = 2 * np.pi * np.arange(count) / count
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return center + radius * normals, normals


@pytest.mark.parametrize(("level", "found"), [(255, True), (250, True), (249, False)])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_one_full_channel_of_one_pixel_will_do(level, found, channel):
    points, normals = rays()
    pixels = np.full((100, 100, 3), 120, np.uint8)
    pixels[50, 75, channel] = level  # five inside the outline's rightmost point
    assert clipped(pixels, points, normals, STEPS).tolist() == [found, *[False] * 11]


def test_what_is_further_in_or_out_does_not_matter():
    points, normals = rays()
    pixels = np.full((100, 100, 3), 255, np.uint8)
    v, u = np.mgrid[:100, :100]
    off = np.hypot(u - 50, v - 50)
    pixels[(off > 21.5) & (off < 35.5)] = 120
    assert not clipped(pixels, points, normals, STEPS).any()


def test_rays_may_leave_the_picture():
    points, normals = rays(radius=60.0)
    assert not clipped(np.zeros((100, 100, 3), np.uint8), points, normals, STEPS).any()


def overexposed_limb(share):
    """Pictures of which a share of every outline, going round, is drowned in light."""

    def changed(_, pixels, balls):
        pixels = pixels.copy()
        camera = scenes()["still"].camera("cam1")
        v, u = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
        for axis, half_angle, _ in balls:
            center = camera.intrinsics.project(axis[None])[0]
            radius = np.tan(half_angle) * camera.intrinsics.focal_px
            off = np.hypot(u - center[0], v - center[1]) / radius
            turn = np.arctan2(v - center[1], u - center[0]) % (2 * np.pi)
            glare = (np.abs(off - 1) < 0.15) & (turn < 2 * np.pi * share)
            pixels[glare] = np.minimum(3.0 * pixels[glare].astype(float) + 90, 255)
        return pixels, balls

    return changed


def test_saturated_pixels_do_not_bias_estimates():
    still = scenes()["still"]
    clear, glare = (estimates(still, "cam1", overexposed_limb(share))[1] for share in (0.0, 0.2))
    assert glare.index == clear.index == GLOSSY
    assert np.abs(glare.bends).max() < 1e-6
    assert glare.blur_px == pytest.approx(clear.blur_px, rel=0.15)


def test_pictures_saturated_all_round_still_give_an_estimate():
    drowned = estimates(scenes()["still"], "cam1", overexposed_limb(1.0))[1]
    assert np.isfinite(drowned.bends).all()
    assert 0.5 <= drowned.blur_px <= 2.0


def edges_px(exposure):
    """How far outside the true outline the edges of a pale ball are found, on average."""
    camera, center = ring()["cam0"], np.array([10.0, 8.0, 420.0])
    light = draw(camera, [center], [20.0], [(230, 230, 230)], background=(20, 20, 20))
    expected = [expect(camera, "red", center, 20.0)]
    expected += [
        expect(camera, ball, np.array([90.0, 8, 420]), 20.0) for ball in ("green", "yellow")
    ]
    config = OutlineConfig(self_calibrate=False, min_color_match=0.0)
    detector = OutlineDetector(config, RAVEN, camera)
    (found,) = detector.detect(image_of(camera, to_picture(exposure * light)), expected)
    away = tangent_cone(center, 20.0).residuals(camera.intrinsics.unproject(found.outline_px))
    return camera.intrinsics.focal_px * np.mean(away)


def test_an_overexposed_ball_shows_half_a_pixel_larger():
    """As `measure check` says; this one is twice as bright as a picture can be."""
    well = edges_px(1.0)
    assert edges_px(1.2) - well == pytest.approx(0.0, abs=0.05)
    assert edges_px(2.5) - well == pytest.approx(0.5, abs=0.1)


def insides(ball, n=12):
    """Picture values (3, n) inside an outline, white on the first three rays."""
    values = np.repeat(np.array([ball], np.float32).T / 255, n, axis=1)
    values[:, :3] = 0.97
    return values, np.full(n, CLEAR, np.int8)


def test_rays_that_begin_in_a_white_highlight_are_found():
    values, status = insides((40, 40, 200))
    assert in_highlights(values, status).tolist() == [True] * 3 + [False] * 9
    values[0, :3] = 0.9  # bright, and of some colour
    assert not in_highlights(values, status).any()


def test_what_is_white_on_a_white_ball_is_its_own_light():
    values, status = insides((190, 200, 205))
    assert not in_highlights(values, status).any()
    assert not in_highlights(values, np.full(12, OCCLUDED, np.int8)).any()


def test_occluded_rays_do_not_count_for_a_balls_whiteness():
    values, status = insides((40, 40, 200))
    values[:, 5:], status[5:] = 0.8, OCCLUDED  # a white ball in front
    status[:2] = OCCLUDED
    assert in_highlights(values, status).tolist() == [True] * 3 + [False] * 9


def test_edges_at_a_highlight_have_a_larger_sd():
    camera, center = ring()["cam0"], np.array([10.0, 8.0, 420.0])
    light = draw(camera, [center], [20.0], [(30, 30, 130)], background=(110, 110, 110))
    middle = camera.intrinsics.project(center[None])[0]
    v, u = np.mgrid[: light.shape[0], : light.shape[1]] - middle[::-1, None, None]
    radius = camera.intrinsics.focal_px * 20 / np.sqrt(center @ center - 400)
    rim = (np.hypot(u, v) < radius - 2) & (np.hypot(u, v) > radius - 8) & (np.abs(v) < -u)
    light[rim] = 1.0
    expected = [expect(camera, "red", center, 20.0)]
    expected += [
        expect(camera, ball, np.array([90.0, 8, 420]), 20.0) for ball in ("green", "yellow")
    ]
    detector = OutlineDetector(OutlineConfig(self_calibrate=False), RAVEN, camera)
    found = {d.ball: d for d in detector.detect(image_of(camera, to_picture(light)), expected)}
    x, y = (found["red"].outline_px - middle).T
    beside, opposite = np.abs(y) < -0.7 * x, np.abs(y) < 0.7 * x
    assert beside.any()
    assert found["red"].outline_sd_px[beside].min() >= HIGHLIGHT_PX
    assert np.median(found["red"].outline_sd_px[opposite]) < HIGHLIGHT_PX
