"""All balls expected in one picture, each measured in one call of compiled code."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure_plugins._outline.appearance.radial_basis import RadialTables
from measure_plugins._outline.fitting.color import color_share
from measure_plugins._outline.fitting.measurement import (
    FROM_INSIDE,
    FROM_OUTSIDE,
    measure_known_size,
    measure_unknown_size,
    search_about_circle,
)
from measure_plugins._outline.fitting.scan import CameraImage, Outline, OutlineSearch
from measure_plugins._outline.sampling.rays import radius_px

_BEYOND_DOUBT = 0.8
"""Share of agreeing edges above which an outline is not compared with that of the colour."""
_FAR_APART_PX = 12.0  # Distance of the fewer rays about a circle above which more are cast
_COMPLETE = 0.5
"""Share of a circle seen times share of its inside filled that convinces by colour alone."""


class BallSearch(NamedTuple):
    """Where a ball is searched for."""

    outline: OutlineSearch
    tables: RadialTables | None  # what its size makes it show; None: edges are not corrected
    bit: int  # of its colour in the table of colours


class Measured(NamedTuple):
    """What was found of a ball."""

    outline: Outline
    color_share: float  # of samples inside the outline that have the ball's colour
    rays: int  # cast across it


def cones_of(centers: Floats, radii: Floats, lens: Floats) -> Floats:
    """Outlines (k, 6) of balls (mm, camera frame).

    Unit axis, half angle in rad, the ball's distance in mm, and the mean radius in px.
    """
    distances = np.sqrt(np.sum(centers**2, axis=1))
    axes, half_angles = centers / distances[:, None], np.arcsin(radii / distances)
    radii_px = [radius_px(*one, lens) for one in zip(axes, half_angles, strict=True)]
    return np.column_stack([axes, half_angles, distances, radii_px])


def measure_balls(
    view: CameraImage, searches: Iterable[BallSearch], give_up_share: float, colors: Bytes
) -> list[Measured]:
    """Measure every expected ball."""
    found = []
    for search, tables, bit in searches:
        if tables is not None:
            outline = measure_known_size(view, search, tables)
        else:
            outline = measure_unknown_size(view, search, give_up_share, colors, 0)
        found.append(_with_color(view, outline, search.rays, colors, bit))
    return found


def measure_circles(
    view: CameraImage,
    circles: Floats,
    bits: Ints,
    rays: tuple[int, int],
    min_contrast: float,
    give_up_share: float,
    colors: Bytes,
) -> list[Measured]:
    """Measure the outlines near rough circles, of unknown size and behind no known ball.

    Where too few edges agree, as on textured balls or in front of texture, the colour that has
    found a circle, if much of it, decides where it ends.

    Args:
        circles: (k, 6) centre x, y and radius, px, shares of the circle seen and of its inside
            filled, and the number of the bit that has found it.
        bits: (k,) of their colours in the table of colours.
        rays: cast across each outline, and how many across large ones.
    """
    found = []
    for circle, bit in zip(circles, bits.tolist(), strict=True):
        some = rays[int(2 * np.pi * circle[2] > _FAR_APART_PX * rays[0])]
        search = search_about_circle(view, circle, FROM_OUTSIDE, some, min_contrast)
        outline = measure_unknown_size(view, search, give_up_share, colors, 0)
        if circle[3] * circle[4] >= _COMPLETE and outline.share < _BEYOND_DOUBT:
            search = search_about_circle(view, circle, FROM_INSIDE, some, min_contrast)
            of_circle = 1 << int(circle[5])
            by_color = measure_unknown_size(view, search, give_up_share, colors, of_circle)
            if by_color.share > outline.share:
                outline = by_color
        found.append(_with_color(view, outline, some, colors, bit))
    return found


def _with_color(
    view: CameraImage, outline: Outline, rays: int, colors: Bytes, bit: int
) -> Measured:
    if outline.agreeing == 0:
        return Measured(outline, 0.0, rays)
    share = color_share(view.pixels, colors, bit, outline.center_px, outline.points_px)
    return Measured(outline, share, rays)
