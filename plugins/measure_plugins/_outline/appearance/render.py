"""The light along a ball's rays that the model predicts for an outline at the assumed place.

Body and surface reflection are fitted to the picture, the background is taken as seen. The bias of
the edge finder on the result is known, because the outline is.
See docs/explanation/outline.md, formula 3.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure_plugins._outline.appearance.dichromatic import GREY, body_color, reflected_light, split
from measure_plugins._outline.appearance.interreflection import add_ball_reflection
from measure_plugins._outline.appearance.radial_basis import RadialTables
from measure_plugins._outline.appearance.shading import fit_shading, shaded, shading_functions
from measure_plugins._outline.sampling.rays import Statuses

FIT_LAST_PX = 1.0
"""Last step along the normal that light is fitted to."""
_MIN_OUTSIDE = 1e-9  # Share of the background's light that is not subtracted


class Ambient(NamedTuple):
    """The light on a ball along n rays across it, as far as it is known."""

    # (m, n) diffuse light by the point lights, see `shade_by_lights`; empty if none are known:
    # shading is then a polynomial.
    light_shading: Floats
    # (k, n) share of the mirrored light that is a ball's, see `ball_reflection_shares`.
    ball_shares: Floats


@compiled
def predict_light(
    profiles: Floats,
    status: Statuses,
    around: Floats,
    background: Floats,
    steps: Floats,
    tables: RadialTables,
    ambient: Ambient,
    first: int,
) -> Floats:
    """Light (3, m - first, n) that the model predicts along the rays.

    Args:
        profiles: (3, m, n) light the picture shows at `steps`.
        background: (3, n) light outside the outline.
        steps: (m,) px along the normal.
        tables: of the ball, at the same steps.
        ambient: of the same rays and steps.
        first: the step at which the prediction begins.
    """
    used = int(np.searchsorted(steps, FIT_LAST_PX, side="right"))
    own, amounts, grey, behind_grey = split_light(profiles, status, background, steps, tables, used)
    functions = shading_functions(around, tables.diffuse, ambient.light_shading)
    body = shaded(fit_shading(amounts, status, functions, used), functions[:, first:])
    reflected = reflected_light(grey, status, tables.reflection_solver)
    for k in range(len(reflected)):
        for i in range(len(status)):
            tied = reflected[k, i] + tables.reflection_prior[k] * behind_grey[i]
            reflected[k, i] = max(tied, 0.0)
    out = _compose(own, body, reflected, background, behind_grey, tables, first)
    add_ball_reflection(ambient.ball_shares, background, behind_grey, tables, first, out)
    return out


@compiled
def split_light(
    profiles: Floats,
    status: Statuses,
    background: Floats,
    steps: Floats,
    tables: RadialTables,
    used: int,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Body and surface reflection of a ball, without the background.

    What is given is as in `predict_light`, of `used` steps.

    Returns:
        The body colour (3,), amounts of it and of grey along the rays, both (used, n), and the grey
        of the background (n,).
    """
    n = profiles.shape[2]
    own = body_color(profiles, status, steps)
    behind, behind_grey = np.empty(n), np.empty(n)
    split(background[0], background[1], background[2], own, behind, behind_grey)
    amounts, grey = np.empty((used, n)), np.empty((used, n))
    blue, green, red = profiles[0, :used], profiles[1, :used], profiles[2, :used]
    split(
        blue.reshape(-1),
        green.reshape(-1),
        red.reshape(-1),
        own,
        amounts.reshape(-1),
        grey.reshape(-1),
    )
    for j in range(used):
        if tables.outside[j] > _MIN_OUTSIDE:
            for i in range(n):
                amounts[j, i] -= tables.outside[j] * behind[i]
                grey[j, i] -= tables.outside[j] * behind_grey[i]
    return own, amounts, grey, behind_grey


@compiled
def _compose(
    own: Floats,
    body: Floats,
    reflected: Floats,
    background: Floats,
    behind_grey: Floats,
    tables: RadialTables,
    first: int,
) -> Floats:
    """Light (3, m, n) of body (m, n), reflection (k, n) and background (3, n)."""
    m, n = body.shape
    out, grey = np.empty((3, m, n)), np.dot(tables.grey[first:], reflected)
    for j in range(m):
        near, through = (
            tables.grazing_reflection[first + j],
            tables.grazing_reflection[first + j] + tables.outside[first + j],
        )
        for i in range(n):
            grey[j, i] = (grey[j, i] - near * behind_grey[i]) * GREY
            body[j, i] = body[j, i] if body[j, i] > 0.0 else 0.0
        for c in range(3):
            for i in range(n):
                value = body[j, i] * own[c] + grey[j, i] + through * background[c, i]
                out[c, j, i] = value if value > 0.0 else 0.0
    return out
