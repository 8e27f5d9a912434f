"""What single pictures of balls show of the camera that took them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.measuring.woven_images import WovenImages, woven_cameras
from measure.model import Detection, FrameSet, Image

BALL = Detection("red", "cam0", 0.0, np.array([80.0, 60.0]), 30.0, 0.01 * np.eye(2))


def picture(shift_px: float) -> np.ndarray:
    pixels = np.full((120, 160, 3), 20, np.uint8)
    cv2.circle(pixels, (round(16 * (80 + shift_px)), 60 * 16), 30 * 16, (30, 30, 180), -1, 16, 4)
    return pixels


def woven() -> np.ndarray:
    pixels = picture(-1.5)
    pixels[1::2] = picture(1.5)[1::2]
    return pixels


def noisy() -> np.ndarray:
    """As a cheap camera's in the dark, coarsely compressed and developed anew."""
    noise = np.random.default_rng(0).normal(0, 18, (120, 160, 3))
    return np.clip(picture(0.0) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("pixels", "told"), [(picture(0.0), 0), (woven(), 1), (noisy(), 0)])
def test_pictures_woven_of_two_instants_are_told_from_noise(pixels: np.ndarray, told: int) -> None:
    images = WovenImages()
    for index in range(4):
        image = Image("cam0", index, index / 30, lambda: pixels)
        images.add(FrameSet(index, index / 30, {"cam0": image}), [BALL])
    assert images.cameras == woven_cameras(["", images.flag]) == ["cam0"] * told
