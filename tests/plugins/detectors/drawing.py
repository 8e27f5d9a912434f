"""Pictures of balls whose outline is exact: a step of light blurred by a normal distribution."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from measure.geometry import tangent_cone
from measure.model import Expectation, Image

BGR = {"green": (40, 150, 50), "yellow": (20, 170, 210), "red": (40, 40, 200)}


def to_light(value):
    value = np.asarray(value, dtype=float) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def to_picture(light, noise=0.0, rng=None):
    bent = 1.055 * np.maximum(light, 1e-12) ** (1 / 2.4) - 0.055
    value = 255 * np.where(light <= 0.0031308, 12.92 * light, bent)
    if noise:
        value = value + noise * rng.standard_normal(value.shape)
    return np.clip(np.rint(value), 0, 255).astype(np.uint8)


def draw(camera, centers, radii, colors, background=(30, 30, 30), blur_px=0.8, dither=None):
    """Light (h, w, 3) of balls at `centers` (camera frame), the furthest first.

    Shading is constant over a ball, so the half level lies on the outline exactly.
    """
    width, height = camera.intrinsics.size_wh
    light = np.empty((height, width, 3))
    light[:] = to_light(background)
    for i in np.argsort([-np.linalg.norm(c) for c in centers]):
        cone = tangent_cone(centers[i], radii[i])
        middle = camera.intrinsics.project(cone.axis[None])[0]
        half = 1.3 * camera.intrinsics.focal_px * np.tan(cone.half_angle) + 10
        x0, y0 = np.maximum(np.floor(middle - half).astype(int), 0)
        x1, y1 = np.minimum(np.ceil(middle + half).astype(int) + 1, [width, height])
        v, u = np.mgrid[y0:y1, x0:x1]
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
        angle = cone.residuals(camera.intrinsics.unproject(pixels))
        # The local scale across the outline: px per rad along the gradient of the angle.
        step = 0.5
        slope = [
            cone.residuals(camera.intrinsics.unproject(pixels + step * d))
            - cone.residuals(camera.intrinsics.unproject(pixels - step * d))
            for d in np.eye(2)
        ]
        distance = angle / np.maximum(np.hypot(*slope) / (2 * step), 1e-9)
        cover = ndtr(-distance / blur_px).reshape(v.shape)[..., None]
        patch = light[y0:y1, x0:x1]
        light[y0:y1, x0:x1] = cover * to_light(colors[i]) + (1 - cover) * patch
    return light


def image_of(camera, pixels, time_s=0.0):
    return Image(camera.name, 0, time_s, lambda: pixels)


def expect(camera, name, center, radius, reach_px=6.0, shift=(0, 0, 0)):
    """What a prediction that is off by `shift` (mm, camera frame) says about a ball."""
    at = center + np.asarray(shift, dtype=float)
    size = camera.intrinsics.focal_px * np.tan(np.arcsin(radius / np.linalg.norm(at)))
    return Expectation(
        name,
        camera.intrinsics.project(at[None])[0],
        (0.9 * size, 1.1 * size),
        2 * size,
        reach_px,
        center_camera=at,
    )
