"""Detected balls drawn into a copy of their picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2

from measure.arrays import Bytes
from measure.errors import ConfigError
from measure.model import Detection

_SHIFT = 4
"""Bits of a pixel's fraction in OpenCV's drawing."""
_BRIGHT, _DARK = (255, 255, 255), (0, 0, 0)


def write_outlines(pixels: Bytes, detections: Sequence[Detection], path: Path) -> None:
    """Write a picture with the circle, centre, name and score of every detection.

    Args:
        pixels: BGR (h, w, 3).
        detections: of that picture.
        path: a file that cv2 can write; PNG keeps the pixels as they are.

    Raises:
        ConfigError: it cannot be written.
    """
    picture = pixels.copy()
    for detection in reversed(detections):  # the best on top
        _draw(picture, detection)
    done, encoded = cv2.imencode(path.suffix, picture)
    if not done:
        raise ConfigError(f"{path}: cannot be written as a picture")
    path.write_bytes(encoded.tobytes())


def _draw(picture: Bytes, detection: Detection) -> None:
    u, v = detection.center_px.tolist()
    at = round(u * 2**_SHIFT), round(v * 2**_SHIFT)
    radius = round(detection.radius_px * 2**_SHIFT)
    size = max(picture.shape[0] / 720, 0.4)
    for color, width in ((_DARK, 3), (_BRIGHT, 1)):
        cv2.circle(picture, at, radius, color, width, cv2.LINE_AA, _SHIFT)
        cv2.drawMarker(
            picture, (round(u), round(v)), color, cv2.MARKER_CROSS, round(8 * size), width
        )
        text = f"{detection.ball} {detection.score:.2f}"
        corner = round(u + 0.75 * detection.radius_px), round(v - 0.75 * detection.radius_px)
        cv2.putText(
            picture, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.6 * size, color, width, cv2.LINE_AA
        )
