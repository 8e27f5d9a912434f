"""The colours of balls as a picture shows them, written into a new body file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from measure.api.detecting import SeenPicture, numbers_of
from measure.api.outputs import check_writable
from measure.arrays import Bytes
from measure.errors import ConfigError
from measure.model import BallColor, Body
from measure.session import read_picture, write_body

_PATCH_PX, _INSIDE = 3, 0.8
"""Half side of the patch about a click; share of an outline's radius inside which is sampled."""
_SIMILAR_HUE, _SIMILAR_LEVEL = 8, 50
"""By how much pixels of a ball may exceed the range of the patch, see `BallColor.from_samples`."""
_FEWEST, _MOST = 30, 24
"""Fewest pixels of a ball that are sampled, and how many samples are written."""


def parse_click(text: str) -> tuple[str, tuple[float, float]]:
    """Read BALL=U,V: a ball's name and a pixel on it; ConfigError for anything else."""
    ball, (u, v) = numbers_of(text, "--sample", "BALL=U,V, such as red=640,360 (in px)", 2)
    return ball, (u, v)


def check_new_body(to: Path) -> None:
    """Refuse (ConfigError) a body file that is there already, or that cannot be written."""
    check_writable(to)
    if to.exists():
        raise ConfigError(f"{to}: is there already, and is not written over: give a new file")


def write_sampled_body(
    to: Path,
    body: Body,
    seen: SeenPicture,
    clicks: Mapping[str, tuple[float, float]],
    outlined: Iterable[str],
) -> None:
    """Write a body with the colours that balls have in a picture, as `samples_bgr`.

    Args:
        seen: what was seen in the picture.
        clicks: pixels on balls: what is connected to them and of their colour is sampled.
        outlined: other balls that are sampled inside their outlines.

    Raises:
        ConfigError: a ball that the body has not, or that is not seen; a file that is there.
    """
    check_new_body(to)
    if unknown := [ball for ball in clicks if ball not in body.names]:
        names = ", ".join(body.names)
        raise ConfigError(f"--sample {unknown[0]}: the body has no such ball, but {names}")
    pixels, best = read_picture(seen.picture), {d.ball: d for d in reversed(seen.detections)}
    found = {ball: _about(pixels, ball, at) for ball, at in clicks.items()}
    for ball in outlined:
        if ball not in best:
            raise ConfigError(f"{seen.picture}: {ball} is not seen: give --sample {ball}=U,V")
        inside, (u, v) = np.zeros(pixels.shape[:2], np.uint8), np.rint(best[ball].center_px)
        cv2.circle(inside, (int(u), int(v)), int(_INSIDE * best[ball].radius_px), 255, -1)
        found[ball] = pixels[inside > 0]
    write_body(to, body, {ball: _representative(some) for ball, some in found.items()})


def _about(pixels: Bytes, ball: str, at: tuple[float, float]) -> Bytes:
    """The pixels (n, 3) of a click's colour that are connected to it."""
    u, v = round(at[0]), round(at[1])
    height, width = pixels.shape[:2]
    if not (0 <= u < width and 0 <= v < height):
        raise ConfigError(f"--sample {ball}={u},{v}: lies outside the picture of {width}x{height}")
    rows = slice(max(v - _PATCH_PX, 0), v + _PATCH_PX + 1)
    patch = pixels[rows, max(u - _PATCH_PX, 0) : u + _PATCH_PX + 1].reshape(-1, 3)
    mask = BallColor.from_samples(patch, _SIMILAR_HUE, _SIMILAR_LEVEL).mask(pixels)
    _, labels = cv2.connectedComponents(mask)
    found = pixels[(labels == labels[v, u]) & (mask > 0)]
    if len(found) < _FEWEST:
        raise ConfigError(f"--sample {ball}={u},{v}: shows no ball of one colour: click elsewhere")
    return np.asarray(found)


def _representative(some: Bytes) -> Bytes:
    """Samples from the darkest to the brightest, evenly; highlights and holes are at the ends."""
    order = np.argsort(some.sum(axis=1), kind="stable")
    return some[order[np.rint(np.linspace(0.05, 0.95, _MOST) * (len(some) - 1)).astype(int)]]
