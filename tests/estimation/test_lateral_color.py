"""Red and blue pictures that are larger or smaller than the green one."""

from __future__ import annotations

import cv2
import numpy as np

from measure.estimation.lateral_color import lateral_color, with_lateral_color
from measure.model import FrameSet, Image

SIZE = (1280, 720)
CORNER_PX = float(np.hypot(*SIZE)) / 2


def scene(rng, colored=False):
    """A picture of grey, or coloured, rectangles at all angles, blurred as by a lens."""
    picture = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
    for _ in range(160):
        box = (rng.uniform((0, 0), SIZE), rng.uniform(40, 160, 2), rng.uniform(0, 180))
        level = rng.integers(20, 235, 3) if colored else np.full(3, rng.integers(20, 235))
        cv2.fillPoly(picture, [cv2.boxPoints(box).astype(np.int32)], level.tolist())
    return cv2.GaussianBlur(picture, (0, 0), 0.8)


def magnified(picture, center, red_px, blue_px):
    """Red and blue larger about `center`, by so much at the picture's corner."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    out = picture.copy()
    for channel, corner_px in ((2, red_px), (0, blue_px)):
        shrink = 1 / (1 + corner_px / CORNER_PX)
        at = [
            (c + (a - c) * shrink).astype(np.float32) for a, c in zip((x, y), center, strict=True)
        ]
        out[:, :, channel] = cv2.remap(picture[:, :, channel], *at, cv2.INTER_CUBIC)
    return cv2.imdecode(cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, 90])[1], 1)


def test_the_magnification_of_red_and_blue_is_found(rng):
    center = np.array([650.0, 340.0])
    pictures = [magnified(scene(rng), center, 0.5, -0.7) for _ in range(3)]
    found = lateral_color((picture, center) for picture in pictures)
    np.testing.assert_allclose(found.red_blue * CORNER_PX, (0.5, -0.7), atol=0.09)
    assert np.all(found.sd * CORNER_PX < 0.03)


def test_colours_of_the_scene_are_not_taken_for_the_lens(rng):
    center = np.array(SIZE) / 2
    found = lateral_color((scene(rng, colored=True), center) for _ in range(3))
    assert found is None or np.all(
        np.abs(found.red_blue) < 4 * np.hypot(found.sd, 0.04 / CORNER_PX)
    )


def test_cameras_of_one_make_count_together_and_known_ones_stay(rig, rng):
    shown = {
        camera.name: magnified(scene(rng), camera.intrinsics.matrix[:2, 2], 0.5, -0.5)
        for camera in rig
    }
    images = {n: Image(n, 0, 0.0, lambda p=p: p) for n, p in shown.items()}
    sets = [FrameSet(i, i / 30, images) for i in range(9)]
    found = with_lateral_color(rig, sets)
    first = found[0].intrinsics.lateral_color
    np.testing.assert_allclose(np.multiply(first, CORNER_PX), (0.5, -0.5), atol=0.1)
    assert all(camera.intrinsics.lateral_color == first for camera in found)
    assert with_lateral_color(found, []) == found
    assert with_lateral_color(rig, []) == tuple(rig), "no pictures show nothing"
