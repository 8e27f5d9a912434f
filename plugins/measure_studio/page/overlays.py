"""What is drawn over pictures, as SVG in their px.

Pixel centres are at integers; SVG counts from the picture's corner.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from measure import api

Floats = NDArray[np.float64]
_AXES = ("x", "y", "z")


def over(size_wh: tuple[int, int], *parts: str) -> str:
    """Parts over a picture of this size; empty without any."""
    width, height = size_wh
    inside = "".join(parts)
    head = f'<svg viewBox="0 0 {width} {height}" aria-hidden="true" font-size="{height / 16:.0f}">'
    return f"{head}{inside}</svg>" * bool(inside)


def cells(size_wh: tuple[int, int], counts: Floats) -> str:
    """Parts of the picture (rows, columns): those with enough corners green, the empty framed."""
    rows, columns = counts.shape
    width, height = size_wh[0] / columns, size_wh[1] / rows
    return "".join(
        f'<rect class="cell {"covered" if counts[row, column] else "empty-cell"}" '
        f'x="{width * column:.1f}" y="{height * row:.1f}" '
        f'width="{width:.1f}" height="{height:.1f}"/>'
        for row in range(rows)
        for column in range(columns)
    )


def axes(camera: api.Camera, world_from_frame: api.RigidTransform, length_mm: float) -> str:
    """The axes of a frame as a camera sees them; empty where its origin is not in the picture."""
    tips = np.vstack([np.zeros(3), length_mm * np.eye(3)])
    points = world_from_frame.apply(tips)
    ahead = camera.world_from_camera.inverse().apply(points)[:, 2]
    if np.min(ahead) <= 0 or not camera.intrinsics.contains(camera.project(points[:1]))[0]:
        return ""
    (u0, v0), *ends = camera.project(points) + 0.5
    return "".join(
        f'<path class="axis {name}" d="M{u0:.1f} {v0:.1f}L{u:.1f} {v:.1f}"/>'
        f'<text class="axis {name}" x="{u + 6:.1f}" y="{v:.1f}">{name}</text>'
        for name, (u, v) in zip(_AXES, ends, strict=True)
    )
