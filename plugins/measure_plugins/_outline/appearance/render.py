"""The picture a ball's model predicts along its rays, were its outline where it is predicted.

The ball's own light and what it reflects are fitted to the picture (`shading`), the surroundings
are taken as seen. Together and blurred they say what the camera would show, so the edge finder's
own error there can be measured.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.compiling import compiled
from measure.geometry.linear_kernels import times
from measure_plugins._outline.appearance.dichromatic import GREY, own_color, reflected_light, split
from measure_plugins._outline.appearance.interreflection import mirror_behind
from measure_plugins._outline.appearance.point_lights import fit_lamp_light, lamp_body
from measure_plugins._outline.appearance.radial_basis import Radial
from measure_plugins._outline.appearance.spherical_harmonics import (
    angular_terms,
    fit_shading,
    shaded,
)
from measure_plugins._outline.sampling.rays import Statuses

FIT_LAST_PX = 1.0
"""No light further out is fitted."""
_NOTHING = 1e-9
"""Share of the surroundings' light too small to take off."""


class Ambient(NamedTuple):
    """What a camera's pictures taught about the light round a ball, along n rays across it.

    Attributes:
        lit: (m, n) light its lamps draw from the ball, see `lamps.lamp_light`; empty if none are
            known, then shading is a polynomial.
        mirrored: (3, m, n) what the ball mirrors of the room, see `room.room_light`; empty if
            that is not known.
        behind: (k, n) how much of that is a ball behind, see `behind.mirrored_behind`.
    """

    lit: Floats
    mirrored: Floats
    behind: Floats


@compiled
def predict_light(
    profiles: Floats,
    status: Statuses,
    around: Floats,
    background: Floats,
    steps: Floats,
    radial: Radial,
    ambient: Ambient,
    first: int,
) -> Floats:
    """Light (3, m - first, n) the model predicts along the rays.

    Args:
        profiles: (3, m, n) light the picture shows at `steps`.
        status: (n,) see `RaySet`.
        around: (n, 2) cosine and sine around the axis.
        background: (3, n) light outside the outline.
        steps: (m,) px along the normal.
        radial: the ball's tables at the same steps.
        ambient: of the same rays and steps.
        first: the step at which the prediction begins.
    """
    used = int(np.searchsorted(steps, FIT_LAST_PX, side="right"))
    lit, shown = ambient.lit, _without(profiles, ambient.mirrored, used)
    own, amounts, grey, behind_grey = split_light(shown, status, background, steps, radial, used)
    if lit.size > 0:
        fitted = fit_lamp_light(amounts, status, around, radial.diffuse, lit, used)
        body = lamp_body(fitted, around, radial.diffuse, lit, first)
    else:
        angular = angular_terms(around)
        fitted = fit_shading(amounts, status, angular, radial.diffuse, used)
        body = shaded(fitted, angular, radial.diffuse[first:])
    reflected = reflected_light(grey, status, radial.solve_grey)
    for k in range(len(reflected)):
        for i in range(len(status)):
            tied = reflected[k, i] + radial.tie_grey[k] * behind_grey[i]
            reflected[k, i] = max(tied, 0.0)
    out = _compose(own, body, reflected, background, behind_grey, radial, first)
    mirror_behind(ambient.behind, background, behind_grey, radial, first, out)
    _add(ambient.mirrored, first, out)
    return out


@compiled
def _without(profiles: Floats, mirrored: Floats, used: int) -> Floats:
    """Profiles (3, m, n), at least the first `used` steps, less what is mirrored, if known."""
    if mirrored.size == 0:
        return profiles
    out = np.empty((3, used, profiles.shape[2]))
    for c in range(3):
        for j in range(used):
            for i in range(profiles.shape[2]):
                out[c, j, i] = profiles[c, j, i] - mirrored[c, j, i]
    return out


@compiled
def _add(mirrored: Floats, first: int, out: Floats) -> None:
    """Add what is mirrored (3, m, n), if that is known, to light (3, m - first, n)."""
    if mirrored.size > 0:
        for c in range(3):
            for j in range(out.shape[1]):
                for i in range(out.shape[2]):
                    out[c, j, i] = max(out[c, j, i] + mirrored[c, first + j, i], 0.0)


@compiled
def split_light(
    profiles: Floats, status: Statuses, background: Floats, steps: Floats, radial: Radial, used: int
) -> tuple[Floats, Floats, Floats, Floats]:
    """What a ball's light is made of, the surroundings taken off.

    Args:
        profiles: (3, m, n) light the picture shows at `steps`.
        status: (n,) see `RaySet`.
        background: (3, n) light outside the outline.
        steps: (m,) px along the normal.
        radial: the ball's tables at the same steps.
        used: how many of the steps are wanted.

    Returns:
        The ball's own colour (3,), how much of it and of grey the rays show, both (used, n), and
        the surroundings' grey (n,).
    """
    n = profiles.shape[2]
    own = own_color(profiles, status, steps)
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
        if radial.outside[j] > _NOTHING:
            for i in range(n):
                amounts[j, i] -= radial.outside[j] * behind[i]
                grey[j, i] -= radial.outside[j] * behind_grey[i]
    return own, amounts, grey, behind_grey


@compiled
def _compose(
    own: Floats,
    body: Floats,
    reflected: Floats,
    background: Floats,
    behind_grey: Floats,
    radial: Radial,
    first: int,
) -> Floats:
    """Own light (m, n), reflected light (k, n) and surroundings (3, n), laid along the rays."""
    m, n = body.shape
    out, grey = np.empty((3, m, n)), np.zeros((m, n))
    times(radial.grey[first:], reflected, grey)
    for j in range(m):
        near, through = (
            radial.nearby[first + j],
            radial.nearby[first + j] + radial.outside[first + j],
        )
        for i in range(n):
            grey[j, i] = (grey[j, i] - near * behind_grey[i]) * GREY
            body[j, i] = body[j, i] if body[j, i] > 0.0 else 0.0
        for c in range(3):
            for i in range(n):
                value = body[j, i] * own[c] + grey[j, i] + through * background[c, i]
                out[c, j, i] = value if value > 0.0 else 0.0
    return out
