"""Candidates for every ball in one picture: circles of its colour, the best first."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bytes, Floats
from measure.host import Settings, setting
from measure.model import BallColor, Body, Camera, Detection, Image
from measure_plugins._acquisition.circles import find_circles
from measure_plugins._acquisition.color_table import classify, color_table
from measure_plugins._acquisition.patches import majority

_REDUCED_WIDTH = 320
_ONE = np.eye(2)
_SD_REDUCED_PX = 0.8
_FULL_ARC = 0.7


class AcquisitionSettings(Settings):
    """How the whole frame is searched for balls."""

    min_radius_px: float = setting(10.0, "Smallest outline radius searched for.", unit="px", gt=2)
    max_radius_share: float = setting(
        0.35, "Largest outline radius, as a share of the image's height.", gt=0, le=1
    )
    min_seen: float = setting(0.16, "Least share of a ball's outline in sight.", gt=0, le=1)
    min_filled: float = setting(
        0.3, "Least share of a circle's inside that has the ball's colour.", ge=0, le=1
    )
    max_candidates: int = setting(10, "Most candidates per ball and picture.", ge=1)


def find_candidates(
    image: Image, body: Body, camera: Camera, config: AcquisitionSettings
) -> list[Detection]:
    """Search one whole picture for every ball of the body.

    Balls of one colour get the same candidates; which is which is for geometry to say, and so is
    what is a ball at all.

    Args:
        image: the picture.
        body: whose balls to look for.
        camera: whose picture it is.
        config: settings.

    Returns:
        Up to `max_candidates` detections per ball, best first: rough (a pixel or two), with their
        covariance. `score` grows with the share of the outline seen.
    """
    colors = tuple(dict.fromkeys(ball.color for ball in body.balls))
    pixels = np.ascontiguousarray(image.pixels)
    step = max(1, round(pixels.shape[1] / _REDUCED_WIDTH))
    bits = majority(classify(pixels, color_table(colors), step))
    circles = {
        color: _circles(bits, 1 << i, step, pixels.shape[0], config)
        for i, color in enumerate(colors)
    }
    return [
        _detection(ball.name, camera.name, image.time_s, circle, step)
        for ball in body.balls
        for circle in circles[ball.color]
    ]


def warm_up() -> None:
    """Compile the loops, or load them from the cache, before the first picture arrives."""
    bits = classify(np.zeros((64, 64, 3), np.uint8), color_table((BallColor.named("red"),)), 4)
    bits[5:12, 5:12] = 1
    _circles(majority(bits), 1, 4, 64, AcquisitionSettings(max_radius_share=1.0))


def _circles(bits: Bytes, bit: int, step: int, height: int, config: AcquisitionSettings) -> Floats:
    """Circles (k, 5) of one colour, best first: centre x, y, radius in px, share seen, filled."""
    radii = (config.min_radius_px / step, config.max_radius_share * height / step)
    circles = find_circles(
        bits, bit, radii, config.min_seen, config.min_filled, config.max_candidates
    )
    scale = np.array([step, step, step, 1.0, 1.0])
    shift = np.array([(step - 1) / 2, (step - 1) / 2, 0, 0, 0])
    return circles * scale + shift


def _detection(ball: str, camera: str, time_s: float, circle: Floats, step: int) -> Detection:
    x, y, radius, seen, filled = circle
    # Shading, not noise, decides where the colour ends; less arc in sight is less certain.
    sd = _SD_REDUCED_PX * step * max(1.0, _FULL_ARC / seen)
    return Detection(
        ball=ball,
        camera=camera,
        time_s=time_s,
        center_px=np.array([x, y]),
        radius_px=float(radius),
        covariance_px=sd**2 * _ONE,
        score=float(min(1.0, seen / 0.9) * np.sqrt(filled)),
        color_match=float(filled),
    )
