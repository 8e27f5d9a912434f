"""All balls expected in one picture, measured in one call of compiled code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Bytes, Floats, Ints
from measure.compiling import compiled
from measure_plugins._outline.appearance.interreflection import balls_behind, balls_nearer
from measure_plugins._outline.appearance.radial_basis import RadialTables, one_of
from measure_plugins._outline.fitting.color import color_share
from measure_plugins._outline.fitting.measurement import (
    FROM_INSIDE,
    FROM_OUTSIDE,
    measure_known_size,
    measure_step_gain,
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


class Expected(NamedTuple):
    """k balls to search for."""

    # (k, 5) unit axis of each outline in the camera frame, half angle in rad, and the ball's
    # distance in mm; columns beyond those are ignored.
    cones: Floats
    reach_px: Floats  # (k,) how far the outline may be from there
    tables: RadialTables  # (k, ...) what its size makes a ball show, if that is known
    sized: Bools  # (k,) whether the size is known: if not, edges are not corrected
    bits: Ints  # (k,) of the balls' colours in the table of colours
    # (k, 2, 2) see `step_gain.measure_step_gain`; the unit matrix where not known.
    step_gains: Floats


class Measured(NamedTuple):
    """What was found of k balls."""

    centers_px: Floats  # (k, 2) images of the spheres' centres
    covariances_px: Floats  # (k, 2, 2) of those
    points_px: Floats  # (k, n, 2) edge points; the first `count` of each ball count
    sd_px: Floats  # (k, n) their standard deviations along the normal
    # (k, 5) mean radius in px, count of edge points (0 where no outline was found), their share
    # among the rays that should show an edge, share of samples inside that have the ball's colour,
    # and the number of rays.
    numbers: Floats


@compiled
def cones_of(centers: Floats, radii: Floats, lens: Floats) -> Floats:
    """Outlines of balls (mm, camera frame): (k, 6) as `Expected.cones`, and mean radius in px."""
    out = np.empty((len(centers), 6))
    for i in range(len(centers)):
        distance = np.sqrt(np.sum(centers[i] * centers[i]))
        out[i, :3] = centers[i] / distance
        out[i, 3], out[i, 4] = np.arcsin(radii[i] / distance), distance
        out[i, 5] = radius_px(out[i, :3], out[i, 3], lens)
    return out


@compiled
def measure_balls(
    view: CameraImage,
    expected: Expected,
    rays: int,
    min_contrast: float,
    margin_px: float,
    give_up_share: float,
    colors: Bytes,
) -> Measured:
    """Measure every expected ball."""
    found = _none_found(len(expected.cones), rays)
    for i in range(len(expected.cones)):
        search = _search(expected, i, rays, min_contrast, margin_px)
        if expected.sized[i]:
            outline = measure_known_size(view, search, one_of(expected.tables, i))
        else:
            outline = measure_unknown_size(view, search, give_up_share, colors, 0)
        _store(view, outline, colors, expected.bits[i], i, found)
    return found


@compiled
def measure_circles(
    view: CameraImage,
    circles: Floats,
    bits: Ints,
    rays: tuple[int, int],
    min_contrast: float,
    give_up_share: float,
    colors: Bytes,
) -> Measured:
    """Measure the outlines near rough circles, of unknown size and behind no known ball.

    Where too few edges agree, as on textured balls or in front of texture, the colour that has
    found a circle, if much of it, decides where it ends.

    Args:
        circles: (k, 6) centre x, y and radius, px, shares of the circle seen and of its inside
            filled, and the number of the bit that has found it.
        bits: (k,) of their colours in the table of colours.
        rays: cast across each outline, and how many across large ones.
    """
    found = _none_found(len(circles), rays[1])
    for i in range(len(circles)):
        far_apart = 2 * np.pi * circles[i, 2] > _FAR_APART_PX * rays[0]
        some = rays[1] if far_apart else rays[0]
        found.numbers[i, 4] = some
        search = search_about_circle(view, circles[i], FROM_OUTSIDE, some, min_contrast)
        outline = measure_unknown_size(view, search, give_up_share, colors, 0)
        complete = circles[i, 3] * circles[i, 4] >= _COMPLETE
        if complete and outline.share < _BEYOND_DOUBT:
            search = search_about_circle(view, circles[i], FROM_INSIDE, some, min_contrast)
            bit = 1 << int(circles[i, 5])
            by_color = measure_unknown_size(view, search, give_up_share, colors, bit)
            if by_color.share > outline.share:
                outline = by_color
        _store(view, outline, colors, bits[i], i, found)
    return found


@compiled
def _none_found(k: int, rays: int) -> Measured:
    """Arrays for k balls, none of them found yet."""
    points, numbers = np.empty((k, rays, 2)), np.zeros((k, 5))
    numbers[:, 4] = rays
    return Measured(np.empty((k, 2)), np.empty((k, 2, 2)), points, np.empty((k, rays)), numbers)


def measure_step_gains(
    view: CameraImage, converged: Expected, rays: int, min_contrast: float, margin_px: float
) -> Floats:
    """Step gains (k, 2, 2) of balls of known size, see `measure_step_gain`."""
    found = [
        measure_step_gain(
            view, _search(converged, i, rays, min_contrast, margin_px), one_of(converged.tables, i)
        )
        for i in range(len(converged.cones))
    ]
    return np.stack(found)


@compiled
def _search(
    expected: Expected, i: int, rays: int, min_contrast: float, margin_px: float
) -> OutlineSearch:
    """The search for ball i."""
    return OutlineSearch(
        expected.cones[i, :3],
        expected.cones[i, 3],
        balls_nearer(expected.cones[i], expected.cones),
        balls_behind(expected.cones[i], expected.cones),
        expected.reach_px[i],
        rays,
        min_contrast,
        margin_px,
        expected.cones[i, 4],
        expected.step_gains[i],
    )


@compiled
def _store(
    view: CameraImage, outline: Outline, colors: Bytes, bit: int, i: int, found: Measured
) -> None:
    """Store ball i's outline, if one was found, and how much of its inside has its colour."""
    count = outline.agreeing
    if count == 0:
        return
    center, points = outline.center_px, outline.points_px
    found.centers_px[i], found.covariances_px[i] = center, outline.covariance_px
    found.points_px[i, :count], found.sd_px[i, :count] = points, outline.sd_px
    found.numbers[i, 0], found.numbers[i, 1] = outline.radius_px, count
    found.numbers[i, 2] = outline.share
    found.numbers[i, 3] = color_share(view.pixels, colors, bit, center, points)
