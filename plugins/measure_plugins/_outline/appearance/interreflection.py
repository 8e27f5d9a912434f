"""A ball's neighbours: those that occlude it, and the reflection of one right behind it.

What is seen beside a ball is mirrored at grazing angles, and taken to extend as far as the surface
deflects the line of sight. Another ball ends: where it does follows from its place and size.
See docs/explanation/outline.md, formula 21.
"""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure_plugins._outline.appearance.dichromatic import GREY
from measure_plugins._outline.appearance.radial_basis import DEFLECTIONS, RadialTables

_SPACING = float(DEFLECTIONS[1] - DEFLECTIONS[0])
_SAME_MM = 1e-6  # Balls whose distances differ by less neither occlude nor mirror each other


def balls_nearer(cone: Floats, cones: Floats) -> Floats:
    """Axes and half angles (m, 4) of the outlines of balls nearer than one; see `balls_behind`."""
    return np.ascontiguousarray(cones[cones[:, 4] < cone[4] - _SAME_MM, :4])


def balls_behind(cone: Floats, cones: Floats) -> Floats:
    """Balls further away than one (m, 4): their centres from its centre and radii, in its radii.

    Args:
        cone: (5,) its axis, half angle in rad and distance in mm, see `batch.cones_of`.
        cones: (k, 5) of all balls; columns beyond those are ignored.
    """
    further, radius = cones[cones[:, 4] > cone[4] + _SAME_MM], cone[4] * np.sin(cone[3])
    centers = further[:, 4:5] * further[:, :3] - cone[4] * cone[:3]
    radii = further[:, 4] * np.sin(further[:, 3])
    return np.column_stack([centers, radii]) / radius


@compiled
def ball_reflection_shares(
    behind: Floats, frame: Floats, half_angle: float, around: Floats
) -> Floats:
    """Shares of the light mirrored about `DEFLECTIONS` that are of the ball right behind a ray.

    Where several stand behind one another, it is the first.

    Args:
        behind: (m, 4) see `balls_behind`.
        frame: (3, 3) about the ball's axis, see `rays.frame_about`.
        half_angle: of its cone, rad.

    Returns:
        Shares (k, n); -1 on rays before no ball, and (k, 0) if all are.
    """
    shares, found = np.full((len(DEFLECTIONS), len(around)), -1.0), False
    edge = np.cos(half_angle), np.sin(half_angle)
    for i in range(len(around)):
        first = np.inf
        for b in range(len(behind)):
            ends, begins = _ends(behind[b], frame, edge, around[i])
            if ends > 0 and begins < first:
                first, found = begins, True
                for k in range(len(DEFLECTIONS)):
                    shares[k, i] = min(max((ends - DEFLECTIONS[k]) / _SPACING + 0.5, 0.0), 1.0)
    return shares if found else np.empty((len(DEFLECTIONS), 0))


@compiled
def _ends(
    ball: Floats, frame: Floats, edge: tuple[float, float], around: Floats
) -> tuple[float, float]:
    """Deflection in rad at which a line of sight past the outline leaves the ball behind it.

    Args:
        ball: (4,) see `balls_behind`.
        frame: (3, 3) about the axis of the ball before.
        around: (2,) cosine and sine of the place on the outline.

    Returns:
        The angle, 0 or less where the undeflected line of sight misses the ball; and the distance
        behind the outline at which it meets it, in radii of the ball before.
    """
    axial, radial = edge
    up, ahead, sideways = -1.0, 0.0, 0.0  # of the ball's centre, from the outline
    for a in range(3):
        outward = around[0] * frame[0, a] + around[1] * frame[1, a]
        up += ball[a] * (axial * outward - radial * frame[2, a])
        ahead += ball[a] * (axial * frame[2, a] + radial * outward)
        sideways += ball[a] * (around[0] * frame[1, a] - around[1] * frame[0, a])
    square = ball[3] * ball[3] - sideways * sideways
    far = ahead * ahead + up * up
    if square <= 0 or far <= square or ahead <= 0 or up * up >= square:
        return 0.0, np.inf
    ends = np.arctan2(up, ahead) + np.arcsin(np.sqrt(square / far))
    return float(ends), float(ahead - np.sqrt(square - up * up))


@compiled
def add_ball_reflection(
    shares: Floats,
    background: Floats,
    behind_grey: Floats,
    tables: RadialTables,
    first: int,
    out: Floats,
) -> None:
    """Replace the grazing reflection of rays in front of another ball by that of the ball.

    Surfaces without grazing reflection are left alone.

    Args:
        background: (3, n) light outside the outline.
        behind_grey: (n,) grey component of that, whose reflection is fitted anyway.
        first: the step at which the prediction begins.
        out: (3, m - first, n) the predicted light, changed.
    """
    if np.max(tables.grazing_reflection) <= 0.0:
        return
    for i in range(shares.shape[1]):
        if shares[0, i] >= 0.0:
            for j in range(out.shape[1]):
                more = -tables.grazing_reflection[first + j]
                for k in range(len(shares)):
                    more += shares[k, i] * tables.grey[first + j, k]
                for c in range(3):
                    value = out[c, j, i] + more * (background[c, i] - behind_grey[i] * GREY)
                    out[c, j, i] = value if value > 0.0 else 0.0
