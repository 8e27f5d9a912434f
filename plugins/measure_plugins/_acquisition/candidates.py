"""Candidates for the balls in one picture: circles of their colours, the best first."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from measure.arrays import Bytes, Floats
from measure.host import Settings, setting
from measure.model import BallColor
from measure_plugins._acquisition.circles import circles_of, distinct
from measure_plugins._acquisition.color_table import MAX_COLORS, classify, color_table
from measure_plugins._acquisition.pale import brighter_than_the_rest, is_pale
from measure_plugins._acquisition.patches import majority
from measure_plugins._acquisition.shade import much_in_shade, with_shade

_REDUCED_WIDTH = 320


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


def find_circles(
    pixels: Bytes, colors: Sequence[BallColor], config: AcquisitionSettings
) -> list[Floats]:
    """Search one whole picture for balls of some colours.

    What is a ball at all, and which one, is for geometry to say.

    Args:
        pixels: BGR (h, w, 3), contiguous.
        colors: to look for.
        config: settings.

    Returns:
        For each colour up to `max_candidates` circles (k, 5), best first, to a pixel or two: centre
        x, y and radius in px, share of the circle seen, share of its inside that has the colour.
    """
    step = max(1, round(pixels.shape[1] / _REDUCED_WIDTH))
    table, with_dark, pale = _tables(tuple(colors))
    for more, i in enumerate(pale, len(colors)):
        table = table | brighter_than_the_rest(colors[i], 1 << more, pixels)
    bits, shaded = map(majority, classify(pixels, table, with_dark, step))
    lit, count = np.ascontiguousarray(bits[::2, ::2]), len(colors) + len(pale)
    found = [_circles(bits, 1 << i, step, pixels.shape[0], config) for i in range(count)]
    for i, others in zip(pale, found[len(colors) :], strict=True):
        found[i] = distinct(np.concatenate([found[i], others]))[: config.max_candidates]
    dark = [i for i in range(len(colors)) if much_in_shade(lit, shaded, 1 << i)]
    if dark:
        bits = majority(classify(pixels, with_dark, with_dark, step)[0])
    for i in dark:
        others = _circles(bits, 1 << i, step, pixels.shape[0], config)
        found[i] = distinct(np.concatenate([found[i], others]))[: config.max_candidates]
    return found[: len(colors)]


@lru_cache(maxsize=16)
def _tables(colors: tuple[BallColor, ...]) -> tuple[Bytes, Bytes, tuple[int, ...]]:
    """The colours' table, that which reaches into the dark, and which of them are pale."""
    pale = [i for i, color in enumerate(colors) if is_pale(color)]
    return color_table(colors), with_shade(colors), tuple(pale[: MAX_COLORS - len(colors)])


def warm_up() -> None:
    """Compile the loops, or load them from the cache, before the first picture arrives."""
    table = color_table((BallColor.named("red"),))
    bits, shaded = classify(np.zeros((64, 64, 3), np.uint8), table, table, 4)
    bits[5:12, 5:12] = 1
    much_in_shade(bits, shaded, 1)
    distinct(_circles(majority(bits), 1, 4, 64, AcquisitionSettings(max_radius_share=1.0)))


def _circles(bits: Bytes, bit: int, step: int, height: int, config: AcquisitionSettings) -> Floats:
    """Circles (k, 5) of one colour, best first: centre x, y, radius in px, share seen, filled."""
    radii = (config.min_radius_px / step, config.max_radius_share * height / step)
    circles = circles_of(
        bits, bit, radii, config.min_seen, config.min_filled, config.max_candidates
    )
    circles[:, :3] *= step
    circles[:, :2] += (step - 1) / 2
    return circles
