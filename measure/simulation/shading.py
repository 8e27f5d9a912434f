"""Light on matt and glossy surfaces, in linear light.

Everything is in one frame (the camera's, while a picture is made). Irradiance is scaled so that a
white matt surface under irradiance 1 has radiance 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform

Rgb = tuple[float, float, float]
REFERENCE_MM = 1000.0
"""A light's `irradiance_rgb` is what it gives at this distance."""


@dataclass(frozen=True, eq=False)
class Material:
    """A surface.

    Attributes:
        albedo_rgb: diffuse reflectance, linear, 0 to 1.
        reflectance: mirror reflectance at normal incidence (0.04 for plastic; 0 is ideally matt).
        roughness_rad: spread of the mirrored light.
        texture: albedo (n, 3) of points (n, 3) in the shape's own frame, instead of `albedo_rgb`.
    """

    albedo_rgb: Rgb
    reflectance: float = 0.0
    roughness_rad: float = 0.05
    texture: Callable[[Floats], Floats] | None = None


@dataclass(frozen=True, eq=False)
class Light:
    """A round lamp.

    Attributes:
        position_mm: (3,) in the world.
        irradiance_rgb: at `REFERENCE_MM`; falls with the square of the distance.
        radius_mm: its size softens shading, highlight and shadow.
    """

    position_mm: Floats
    irradiance_rgb: Rgb = (1.0, 1.0, 1.0)
    radius_mm: float = 80.0


@dataclass(frozen=True, eq=False)
class Lighting:
    """All the light of a scene.

    Attributes:
        lights: the lamps.
        ambient_rgb: diffuse light from all sides, from above; less comes from below.
        surround_rgb: radiance of the surroundings as mirrored by glossy things, looking up.
        below: share of `ambient_rgb` and `surround_rgb` that comes from below.
        shadows: whether balls darken each other and what stands behind them.
        up: (3,) unit vector, away from the floor.
    """

    lights: tuple[Light, ...]
    ambient_rgb: Rgb = (0.25, 0.25, 0.25)
    surround_rgb: Rgb = (0.12, 0.12, 0.12)
    below: float = 0.3
    shadows: bool = False
    up: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def seen_from(self, camera_from_world: RigidTransform) -> Lighting:
        """The same light in a camera's frame."""
        lamps = tuple(
            replace(lamp, position_mm=camera_from_world.apply(lamp.position_mm))
            for lamp in self.lights
        )
        return replace(self, lights=lamps, up=camera_from_world.rotate(self.up))


@dataclass(frozen=True, eq=False)
class Surface:
    """Points to be shaded.

    Attributes:
        points: (n, 3) in mm, in the camera frame (the viewer is at the origin).
        normals: (n, 3) outward unit vectors.
        albedo: (n, 3) or (3,) linear, in the order of the output's channels.
        material: how the surface reflects.
    """

    points: Floats
    normals: Floats
    albedo: Floats
    material: Material


def shade(
    surface: Surface, lighting: Lighting, blockers: tuple[tuple[Floats, float], ...]
) -> Floats:
    """Radiance (n, 3), linear, channels in the order B G R.

    Diffuse light has to cross the surface twice, so it fades as (1 - F(in)) (1 - F(out)) towards
    grazing angles (Schlick 1994 for F); the mirrored part is the lamp's disc widened by the
    roughness, and the surroundings. That is why the colour edge of a glossy ball lies inside its
    outline.

    Args:
        surface: where.
        lighting: in the camera frame.
        blockers: spheres (centre, radius) that may stand between surface and light.
    """
    material = surface.material
    view = -surface.points / np.linalg.norm(surface.points, axis=1, keepdims=True)
    facing = np.clip(np.einsum("ij,ij->i", surface.normals, view), 0.0, 1.0)
    mirrored = 2 * facing[:, None] * surface.normals - view
    fresnel_out = _fresnel(facing, material.reflectance)
    upward = _mix(surface.normals @ lighting.up, lighting.below)
    diffuse = np.outer(upward * _openness(surface, blockers), lighting.ambient_rgb[::-1])
    gloss = np.outer(
        fresnel_out * _mix(mirrored @ lighting.up, lighting.below), lighting.surround_rgb[::-1]
    )
    for lamp in lighting.lights:
        towards = lamp.position_mm - surface.points
        distance = np.linalg.norm(towards, axis=1)
        towards /= distance[:, None]
        size = lamp.radius_mm / distance
        strength = (REFERENCE_MM / distance) ** 2 * _unblocked(
            surface.points, towards, size, blockers
        )
        cosine = np.einsum("ij,ij->i", surface.normals, towards)
        lit = strength * _soft_clamp(cosine, size)
        fresnel_in = _fresnel(np.clip(cosine, 0, 1), material.reflectance)
        colour = np.array(lamp.irradiance_rgb[::-1])
        diffuse += np.outer(lit * (1 - fresnel_in), colour)
        if material.reflectance > 0:
            gloss += np.outer(
                fresnel_out * strength * _highlight(mirrored, towards, size, cosine, material),
                colour,
            )
    return surface.albedo * diffuse * (1 - fresnel_out)[:, None] + gloss


def _fresnel(cosine: Floats, reflectance: float) -> Floats:
    if reflectance <= 0:
        return np.zeros_like(cosine)
    return reflectance + (1 - reflectance) * (1 - cosine) ** 5


def _mix(cosine_up: Floats, below: float) -> Floats:
    """From `below` (looking down) to 1 (looking up)."""
    return below + (1 - below) * 0.5 * (1 + cosine_up)


def _soft_clamp(cosine: Floats, size: Floats) -> Floats:
    """max(0, cosine), rounded over the lamp's angular radius: a lamp sets gradually."""
    rising = (cosine + size) ** 2 / (4 * size)
    return np.where(cosine > size, cosine, np.where(cosine < -size, 0.0, rising))


def _highlight(
    mirrored: Floats, towards: Floats, size: Floats, cosine: Floats, material: Material
) -> Floats:
    """Mirrored lamp, as a Gaussian lobe that keeps its energy."""
    variance = size**2 / 2 + (2 * material.roughness_rad) ** 2
    off = 1 - np.einsum("ij,ij->i", mirrored, towards)
    lobe = np.exp(-off / variance) / (2 * variance)
    return np.where(cosine > -size, lobe, 0.0)


def _openness(surface: Surface, blockers: tuple[tuple[Floats, float], ...]) -> Floats:
    """Share of the ambient light that other spheres leave (form factor of a sphere)."""
    left = np.ones(len(surface.points))
    for center, radius in blockers:
        towards = center - surface.points
        distance2 = np.einsum("ij,ij->i", towards, towards)
        cosine = np.einsum("ij,ij->i", towards, surface.normals) / np.sqrt(distance2)
        hidden = np.clip(cosine, 0, 1) * radius**2 / np.maximum(distance2, radius**2)
        # A sphere does not hide the sky from its own surface.
        left *= np.where(distance2 > (radius * 1.0001) ** 2, 1 - 0.8 * hidden, 1.0)
    return left


def _unblocked(
    points: Floats, towards: Floats, size: Floats, blockers: tuple[tuple[Floats, float], ...]
) -> Floats:
    """Share of a lamp's disc that is seen past the spheres in between."""
    left = np.ones(len(points))
    for center, radius in blockers:
        offset = center - points
        along = np.einsum("ij,ij->i", offset, towards)
        across = np.sqrt(np.maximum(np.einsum("ij,ij->i", offset, offset) - along**2, 0))
        width = np.maximum(along * size, 1e-6)
        share = np.clip((across - radius) / (2 * width) + 0.5, 0, 1)
        left *= np.where(along > radius * 1.0001, share * share * (3 - 2 * share), 1.0)
    return left
