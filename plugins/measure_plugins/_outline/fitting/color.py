"""Where a ball's colour ends along rays, and how much of its inside has it."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bytes, Floats
from measure.compiling import compiled
from measure_plugins._outline.fitting.edges import Edges
from measure_plugins._outline.fitting.scan import STEP_PX, CameraImage, EdgeScan
from measure_plugins._outline.sampling.rays import CLEAR, OUT_OF_IMAGE, cast_rays, frame_about

COLOR_SD_PX = 0.5
"""Standard deviation of where a colour ends along a ray, seen in whole pixels; and of the centre
by all of them, where shade or a reflection ends the colour."""
_RINGS = (0.25, 0.5, 0.7, 0.85)
"""Radii, as shares of the outline's, at which the colour inside is sampled."""
_CUT = 2  # By how many bits picture values are cut for a table of colours


@compiled
def scan_color(
    view: CameraImage,
    axis: Floats,
    half_angle: float,
    count: int,
    reach_px: float,
    colors: Bytes,
    bit: int,
) -> EdgeScan:
    """Find where a colour ends on rays across an outline, nearest to it.

    Holes, prints, and things behind the ball that differ from it in brightness alone do not count.

    Args:
        axis: (3,) unit direction of the ball's centre in the camera frame.
        half_angle: of its cone, rad.
        colors: (64, 64, 64) bits by blue, green and red, each cut to as many levels.
    """
    frame = frame_about(axis)
    rays, scale = cast_rays(frame, half_angle, count, view.lens)
    height, width = view.pixels.shape[:2]
    at, clear, use = np.full(count, np.nan), np.zeros(count), np.zeros(count)
    for i in range(count):
        colored, s = False, -reach_px - STEP_PX
        while s < reach_px:
            s += STEP_PX
            x = round(rays.points[i, 0] + s * rays.normals[i, 0])
            y = round(rays.points[i, 1] + s * rays.normals[i, 1])
            if not (0 <= x < width and 0 <= y < height):
                rays.status[i] = OUT_OF_IMAGE
                break
            b, g, r = view.pixels[y, x]
            before, colored = colored, colors[b >> _CUT, g >> _CUT, r >> _CUT] & bit != 0
            if before and not colored and not abs(at[i]) <= abs(s - STEP_PX / 2):
                at[i] = s - STEP_PX / 2
        clear[i] = rays.status[i] == CLEAR
        use[i] = clear[i] * np.isfinite(at[i])
    dark = np.zeros((3, count))
    edges = Edges(at, np.full(count, COLOR_SD_PX), np.ones(count), dark, dark)
    return EdgeScan(frame, rays, scale, edges, clear, use)


@compiled
def color_share(pixels: Bytes, colors: Bytes, bit: int, center: Floats, points: Floats) -> float:
    """Share of the samples between the centre and edge points that have a colour.

    Args:
        pixels: (h, w, 3) uint8.
        center: (2,) px.
        points: (n, 2) px.
    """
    height, width = pixels.shape[:2]
    seen, alike = 0, 0
    for i in range(len(points)):
        for share in _RINGS:
            x = round(center[0] + share * (points[i, 0] - center[0]))
            y = round(center[1] + share * (points[i, 1] - center[1]))
            if 0 <= x < width and 0 <= y < height:
                b, g, r = pixels[y, x]
                seen += 1
                alike += colors[b >> _CUT, g >> _CUT, r >> _CUT] & bit != 0
    return alike / seen if seen else 0.0
