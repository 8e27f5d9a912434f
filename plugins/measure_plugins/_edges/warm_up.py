"""A drawn picture to compile the hot loops with, before the first real one arrives."""

from __future__ import annotations

import cv2
import numpy as np

from measure.model import Body, Camera, Expectation, Image

_RADIUS_PX = 40.0
_SHARE = 0.3
"""Of a small picture's shorter side: the rays must find the disc's surroundings in it."""


def drawn_disc(body: Body, camera: Camera) -> tuple[Image, list[Expectation]]:
    """A picture with one white disc in its middle, and the expectation of the first ball there."""
    width, height = camera.intrinsics.size_wh
    radius = min(_RADIUS_PX, _SHARE * min(width, height))
    pixels = np.zeros((height, width, 3), np.uint8)
    center = np.array([width / 2, height / 2])
    cv2.circle(pixels, (width // 2, height // 2), int(radius), (255, 255, 255), -1)
    image = Image(camera.name, 0, 0.0, lambda: pixels)
    half_angle = radius / camera.intrinsics.focal_px
    distance = body.balls[0].radius_mm / np.sin(half_angle)
    expected = Expectation(
        body.names[0],
        center,
        (radius - 5, radius + 5),
        0.0,
        reach_px=6.0,
        center_camera=distance * camera.intrinsics.unproject(center[None])[0],
    )
    return image, [expected]
