"""Blurred profiles of a ball along a ray across its outline, for unit amounts of light.

Diffuse light leaves a glossy surface through a boundary whose reflectance rises towards grazing
angles (Fresnel): it fades to nothing at the outline, and the reflection of the surroundings takes
its place. Shading by distant lights is a quadratic polynomial of the normal (Ramamoorthi and
Hanrahan 2001); around the view axis it is a sum of angular times six radial functions, and all that
is costly depends on the radius alone.
See docs/explanation/outline.md, formulas 1, 2, 4, 5, 7 and 8.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure_plugins._outline.sampling.rays import STEPS

DEFLECTIONS = np.radians([0, 10, 20, 30, 40, 50, 60, 75])
"""Angles in rad by which the ball deflects the line of sight: the knots of the reflected light."""
REFRACTIVE_INDEX = 1.5
"""Of clear plastics and lacquers (1.45 to 1.6)."""
BLUR_PX = 1.0
"""Blur of a webcam's optics, pixels, colour mosaic and interpolation, before it is estimated."""
_FINE = np.arange(-24.0, 12.01, 0.25)
_INSIDE = (_FINE < 0).astype(np.float64)
_WIDTHS = np.diff(DEFLECTIONS)
_REFLECTION_RANGE_PX = (-13.0, 0.6)
_REFLECTION_USED = (
    np.abs(STEPS - np.mean(_REFLECTION_RANGE_PX))[:, None] <= np.ptp(_REFLECTION_RANGE_PX) / 2
)
_STIFFNESS, _FIRM = 0.02, 1e3
_SLANTING = 0.3  # Cosine at which Schlick's formula is fitted to a surface
FADE_RAD = np.radians(40)
_LOBES = 6


class RadialTables(NamedTuple):
    """Blurred radial functions at `STEPS`."""

    diffuse: Floats  # (m, 6) of the diffuse light, see `_lobes`
    grey: Floats  # (m, k) of light reflected from the directions around each of `DEFLECTIONS`
    grazing_reflection: Floats  # (m,) of what is right behind the ball, mirrored at grazing angles
    outside: Floats  # (m,) of the background outside the outline
    # (1,) share of light that the surface reflects at grazing incidence; at other incidence it is
    # (1 - cosine)^5 times as much (Schlick 1994).
    fresnel_loss: Floats
    # (k, m) from a profile to the reflected light, smooth where unobserved.
    reflection_solver: Floats
    reflection_prior: Floats  # (k,) from the grey of the background to the same


def radial_tables(
    radius_px: float, half_angle: float, blur_px: float, index: float, mirrors: bool = True
) -> RadialTables:
    """Tables for a ball; radius, angle and blur are rounded to negligible steps.

    Args:
        half_angle: of its cone, rad.
        index: refractive index of the surface.
        mirrors: whether the colours behind are mirrored at grazing angles.
    """
    size, angle, blur = round(4 * radius_px), round(200 * half_angle), round(20 * blur_px)
    return _radial(size, angle, blur, index, mirrors)


@lru_cache(maxsize=1024)
def _radial(radius4: int, angle200: int, blur20: int, index: float, mirrors: bool) -> RadialTables:
    half_angle = max(angle200, 1) / 200
    tilt, cosine = _surface(half_angle, half_angle / (radius4 / 4))
    mirrored = fresnel(cosine, index) * _INSIDE
    deflection = 2 * np.arcsin(np.clip(cosine, 0, 1))
    shown = np.concatenate(
        [
            (_INSIDE - mirrored) * _lobes(tilt),
            mirrored * _hats(deflection),
            [mirrored * np.clip(1 - deflection / FADE_RAD, 0, 1), 1 - _INSIDE],
        ]
    )
    blurred = _blur(blur20) @ shown.T
    grey = np.ascontiguousarray(blurred[:, _LOBES:-2])
    solve, tie = _reflection_solver(grey)
    return RadialTables(
        diffuse=np.ascontiguousarray(blurred[:, :_LOBES]),
        grey=grey,
        grazing_reflection=mirrors * blurred[:, -2],
        outside=np.ascontiguousarray(blurred[:, -1]),
        fresnel_loss=_fresnel_loss(index),
        reflection_solver=solve,
        reflection_prior=tie,
    )


@lru_cache(maxsize=64)
def _fresnel_loss(index: float) -> Floats:
    """See `RadialTables`: 0 of paint without a boundary, 1 of clear plastic (formula 5)."""
    straight, slanting = fresnel(np.array([1.0, _SLANTING]), index)
    return np.array([min((slanting - straight) / (1 - straight) / (1 - _SLANTING) ** 5, 1.0)])


def fresnel(cosine: Floats, index: float) -> Floats:
    """Reflected share of unpolarised light at a cosine of incidence; 0 for index 1 (formula 4)."""
    if index == 1:
        return np.zeros_like(cosine)
    transmitted = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * transmitted) / (cosine + index * transmitted)
    along = (index * cosine - transmitted) / (index * cosine + transmitted)
    return np.asarray(0.5 * (across**2 + along**2))


def _surface(half_angle: float, rad_per_px: float) -> tuple[Floats, Floats]:
    """Tilt of the normal from the axis and cosine of incidence, along the fine ray (formula 1)."""
    beta = np.maximum(half_angle + _FINE * rad_per_px, 0.0)
    incidence = np.arcsin(np.minimum(np.sin(beta) / np.sin(half_angle), 1.0))
    return incidence - beta, np.cos(incidence)


def _lobes(tilt: Floats) -> Floats:
    """Radial factors (6, n) of the quadratic polynomials of the normal (formula 7)."""
    s, c = np.sin(tilt), np.cos(tilt)
    return np.array([np.ones_like(s), c, 3 * c * c - 1, s, s * c, s * s])


def _hats(deflection: Floats) -> Floats:
    """Linear interpolation weights (k, n) of `DEFLECTIONS` at `deflection` (n,)."""
    last = len(DEFLECTIONS) - 2
    lower = np.minimum(np.searchsorted(DEFLECTIONS, deflection, side="right") - 1, last)
    start, width = DEFLECTIONS[lower], _WIDTHS[lower]
    share = np.minimum((deflection - start) / width, 1.0)
    out, each = np.zeros((len(DEFLECTIONS), len(deflection))), np.arange(len(deflection))
    out[lower, each], out[lower + 1, each] = 1 - share, share
    return out


@lru_cache(maxsize=64)
def _blur(blur20: int) -> Floats:
    """From the fine ray to `STEPS` (m, f)."""
    kernel = np.exp(-0.5 * ((STEPS[:, None] - _FINE[None, :]) / (blur20 / 20)) ** 2)
    return np.asarray(kernel / kernel.sum(axis=1, keepdims=True))


def _reflection_solver(grey: Floats) -> tuple[Floats, Floats]:
    """Ridge regression of the reflected light, smooth, and tied to the background (formula 8)."""
    design = grey * _REFLECTION_USED
    inverse = np.linalg.inv(design.T @ design + _REFLECTION_PRIOR)
    return np.ascontiguousarray(inverse @ design.T), np.ascontiguousarray(_FIRM * inverse[:, 0])


def _reflection_normal() -> Floats:
    """What the prior adds to the normal matrix (k, k)."""
    bend = np.diff(np.eye(len(DEFLECTIONS)), 2, axis=0)
    out = _STIFFNESS * bend.T @ bend + 1e-6 * np.eye(len(DEFLECTIONS))
    out[0, 0] += _FIRM
    return np.asarray(out)


_REFLECTION_PRIOR = _reflection_normal()
