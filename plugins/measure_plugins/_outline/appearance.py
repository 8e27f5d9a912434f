"""Forward model of a ball's picture: the camera, the ball's neighbours, and the light on its rays.

The formulas are those of docs/explanation/outline.md. A camera turns light into picture values by a
tone curve (10). Webcams interpolate a colour mosaic and store chroma at half the resolution of luma
(4:2:0 or 4:2:2), both in encoded values: chroma is blurred more than luma. Interpolation between
pixels blurs those once more (9).

What is seen beside a ball is mirrored at grazing angles, and taken to extend as far as the surface
deflects the line of sight. Another ball ends: where it does follows from its place and size (21).

The light along a ball's rays is predicted for an outline at the assumed place. Body and surface
reflection are fitted to the picture, the background is taken as seen. The bias of the edge finder
on the result is known, because the outline is (3).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Reals, Singles
from measure.compiling import compiled
from measure.errors import ConfigError
from measure_plugins._outline import reflectance
from measure_plugins._outline.rays import STEPS, Statuses
from measure_plugins._outline.reflectance import (
    DEFLECTIONS,
    GREY,
    RadialTables,
    body_color,
    fit_shading,
    no_point_lights,
    reflected_light,
    shaded,
    shading_functions,
    split,
)

CHROMA_PX = 0.8
"""Blur of chroma beyond that of luma."""
_BLUE, _GREEN, _RED = 0.114, 0.587, 0.299  # Weights of the luma of JPEG (BT.601)
CHROMA_REACH = 3
"""Steps to either side over which chroma is blurred: three sigma."""
_STEP = float(STEPS[1] - STEPS[0])
_INTERPOLATED = 1 / 6
"""Variance in px^2 of the blur by bilinear interpolation: t (1 - t), averaged over all places t
between two pixels."""
_SIDE_WEIGHT = _INTERPOLATED / (2 * _STEP**2)
_INTERPOLATING = np.array([0.5 - _SIDE_WEIGHT, _SIDE_WEIGHT])
"""Half the weight of a step in a blur of that variance, and the weight of its neighbours."""
_OFFSETS_PX = np.arange(CHROMA_REACH + 1) * _STEP
_BLURRING = np.exp(-0.5 * _OFFSETS_PX**2 / (CHROMA_PX**2 + _INTERPOLATED))
_BLURRING[0] /= 2
_BLURRING /= 2 * _BLURRING.sum()
"""The same in the blur of colour."""
_TABLE_STEPS = 2048
_NO_LIGHT, _FULL_LIGHT = np.float32(0), np.float32(1)


def encoding(table: Floats) -> Singles:
    """The inverse of a tone table (256,): picture values, 0 to 1, at even steps of sqrt(light).

    In steps of the root, since tone curves are steep in the shade: linear interpolation then errs
    by less than a thirtieth of a level. The last entry is repeated, for full light.
    """
    light = np.linspace(0.0, 1.0, _TABLE_STEPS + 1) ** 2
    values = np.interp(light, table, np.arange(len(table)) / (len(table) - 1))
    return np.append(values, values[-1]).astype(np.float32)


@compiled
def encode(light: Floats, inverse: Singles) -> Singles:
    """Picture values, 0 to 1, of light (3, m, n), by the table of `encoding`."""
    out, lows = np.empty(light.shape, np.float32), np.empty(light.size, np.int32)
    flat, read, top = light.reshape(-1), out.reshape(-1), np.float32(len(inverse) - 2)
    for i in range(light.size):  # single precision halves the time of the roots
        x = np.float32(flat[i])
        x = x if x > _NO_LIGHT else _NO_LIGHT
        x = x if x < _FULL_LIGHT else _FULL_LIGHT
        place = np.sqrt(x) * top
        lows[i] = np.int32(place)
        read[i] = place - np.float32(lows[i])
    for i in range(light.size):
        low = np.uint32(lows[i])  # unsigned: no check for negative indices
        value = inverse[low]
        read[i] = value + read[i] * (inverse[low + np.uint32(1)] - value)
    return out


@compiled
def read_off(values: Reals) -> Reals:
    """Blur BGR values (3, m, n) along the rays as cameras and interpolation do.

    Chroma (blue and red minus luma) is blurred by the camera and by interpolation between pixels,
    luma by the latter alone: the camera's blur of luma is in the light already.

    Args:
        values: (3, m, n).

    Returns:
        (3, m - CHROMA_REACH, n): from the step CHROMA_REACH on; beyond the last step, values are
        taken to go on as they are there.
    """
    m, n = values.shape[1:]
    number = values.dtype.type  # of the values' precision: loops stay in single precision
    of_blue, of_green, of_red = number(_BLUE), number(_GREEN), number(_RED)
    luma, bluer, redder = np.empty_like(values)
    for j in range(m):
        for i in range(n):
            blue, red = values[0, j, i], values[2, j, i]
            grey = of_blue * blue + of_green * values[1, j, i] + of_red * red
            luma[j, i], bluer[j, i], redder[j, i] = grey, blue - grey, red - grey
    out = np.zeros((3, m - CHROMA_REACH, n), values.dtype)
    _blur(bluer, _BLURRING, out[0])
    _blur(luma, _INTERPOLATING, out[1])
    _blur(redder, _BLURRING, out[2])
    for j in range(m - CHROMA_REACH):
        for i in range(n):
            blue, grey, red = out[0, j, i], out[1, j, i], out[2, j, i]
            out[0, j, i], out[2, j, i] = grey + blue, grey + red
            out[1, j, i] = grey - (of_blue * blue + of_red * red) / of_green
    return out


@compiled
def _blur(values: Reals, weights: Floats, out: Reals) -> None:
    """Add rows (m, n), blurred across, to those of `out`; its first is CHROMA_REACH."""
    m, n = values.shape
    for j in range(CHROMA_REACH, m):
        for k in range(len(weights)):
            weight, after = out.dtype.type(weights[k]), min(j + k, m - 1)
            for i in range(n):
                out[j - CHROMA_REACH, i] += weight * (values[j - k, i] + values[after, i])


GLOSSY, MATT = reflectance.REFRACTIVE_INDEX, 1.0001
"""Refractive index of lacquer and clear plastic; and of paint without a boundary that reflects."""
BENDS = 3
DEFAULT_CORRECTION_WEIGHT = 0.9
"""Correction weight before it is estimated how well predictions agree with pictures."""
_LEVELS = np.arange(256) / 255.0
_FLATTEST = 1e-4


@dataclass(frozen=True, eq=False)
class Appearance:
    """Parameters of the model that predicts a ball's picture."""

    tone: str  # name of the tone curve to start from, as in `tone_table`
    bends: Floats  # (3,) the camera's deviation from it, see `bent_table`
    blur_px: float  # sigma of the blur of brightness
    index: float
    # whether it mirrors, at grazing angles, the colours of what is behind the ball.
    mirrors: bool = True
    # (k, 4) in the camera frame, see `point_lights`; none if not known.
    point_lights: Floats = field(default_factory=no_point_lights)
    # share of the predicted bias of edges that is subtracted, see `trust`.
    correction_weight: float = DEFAULT_CORRECTION_WEIGHT

    @cached_property
    def table(self) -> Floats:
        """Light (256,) of each picture value."""
        return bent_table(self.tone, self.bends)

    @cached_property
    def encoding(self) -> Singles:
        """How the camera turns light into picture values, see `sensor.encoding`."""
        return encoding(self.table)

    def tables(self, radius_px: float, half_angle: float) -> reflectance.RadialTables:
        """Profiles of a ball of this size along a ray across its outline."""
        return reflectance.radial_tables(
            radius_px, half_angle, self.blur_px, self.index, self.mirrors
        )


def first_appearance(tone: str) -> Appearance:
    """Assumed before the first estimate: the stated curve, a webcam's blur, glossy balls."""
    return Appearance(tone, np.zeros(BENDS), reflectance.BLUR_PX, GLOSSY)


def bent_table(tone: str, bends: Floats) -> Floats:
    """A tone table with a lift of the blacks, a bow and an S of its values (formula 10).

    The response curves of real cameras lie near a space of few dimensions (Grossberg and Nayar
    2003).

    Args:
        bends: (3,) lift of the blacks, bow, S; shares of the largest value.

    Returns:
        (256,) light, rising, 0 to 1.
    """
    lift, bow, s_shape = bends
    values = _LEVELS - lift * (1 - _LEVELS)
    values = values + bow * np.sin(np.pi * _LEVELS) + s_shape * np.sin(2 * np.pi * _LEVELS)
    values = np.maximum.accumulate(np.clip(values, 0, None)) + _FLATTEST * _LEVELS
    return np.interp(values / values[-1], _LEVELS, tone_table(tone))


def srgb_to_light(value: Floats) -> Floats:
    """The sRGB transfer function (IEC 61966-2-1), values and light 0 to 1."""
    bent = ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(value <= 0.04045, value / 12.92, bent)


def tone_table(tone: str) -> Floats:
    """The table (256,) of a tone curve.

    Args:
        tone: "srgb", "none" (values are taken as they are), or "gamma" with its exponent, like
            "gamma2.2".

    Raises:
        ConfigError: the curve is not one of these.
    """
    if tone == "srgb":
        return srgb_to_light(_LEVELS)
    if tone == "none":
        return _LEVELS.copy()
    try:
        exponent = float(tone.removeprefix("gamma"))
    except ValueError:
        exponent = 0.0
    if not tone.startswith("gamma") or not 0.3 <= exponent <= 5.0:
        raise ConfigError(
            f"tone '{tone}' is not known: use srgb, none, or gamma with its exponent, like gamma2.2"
        )
    return np.asarray(_LEVELS**exponent)


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
