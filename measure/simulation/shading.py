"""Materials and light. The formulas that join them stand in `light_kernels`.

Irradiance is scaled so that a white matt surface under irradiance 1 has radiance 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeAlias

import numpy as np

from measure.arrays import Floats, Ints
from measure.geometry import RigidTransform

Rgb = tuple[float, float, float]
Texture: TypeAlias = Callable[[Floats], Floats]


@dataclass(frozen=True, eq=False)
class Material:
    """A surface."""

    albedo_rgb: Rgb  # diffuse reflectance, linear, 0 to 1
    # mirror reflectance at normal incidence (0.04 for plastic; 0 is ideally matt).
    reflectance: float = 0.0
    # standard deviation, per axis, of the slopes of the microfacets: highlights and mirror images
    # are blurred by twice that.
    roughness_rad: float = 0.05
    # albedo (n, 3) of points (n, 3) in the frame of a `Cuboid`, instead of `albedo_rgb`.
    texture: Texture | None = None


@dataclass(frozen=True, eq=False)
class Lamp:
    """A round lamp."""

    position_mm: Floats  # (3,) in the world
    # at a distance of one metre; falls with the square of the distance.
    irradiance_rgb: Rgb = (1.0, 1.0, 1.0)
    radius_mm: float = 80.0  # radius of its disc; it softens shading, highlight and shadow


class Mirror(Protocol):
    """What the glossy shapes of a stage mirror beside the lamps."""

    def radiance(self, points: Any, numbers: Ints, per_pixel: int) -> Floats:
        """Radiance (n, 3) that surface points (n,) mirror to their viewers, B G R.

        Args:
            points: the `Points`.
            numbers: (n,) index of each point in its pixel.
            per_pixel: rays through a pixel.
        """


@dataclass(frozen=True, eq=False)
class Lighting:
    """The light of a scene."""

    lights: tuple[Lamp, ...]
    # diffuse light from all sides, from above; less comes from below.
    ambient_rgb: Rgb = (0.25, 0.25, 0.25)
    # radiance from straight above that a `mirror` shows where no shape is; it falls gradually to 0
    # at the horizon.
    surround_rgb: Rgb = (0.12, 0.12, 0.12)
    below: float = 0.3  # share of `ambient_rgb` that comes from below
    shadows: bool = False  # whether balls darken each other and what stands behind them
    # makes what glossy shapes mirror beside the lamps, of a stage's rows of shapes, lights,
    # reflectance by shape and place, and part of an exposure; None: what is behind, blurred.
    mirror: Callable[..., Mirror] | None = None
    # (3,) unit vector, away from the floor.
    up: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def seen_from(self, camera_from_world: RigidTransform) -> Lighting:
        """The same light in a camera's frame."""
        lamps = tuple(
            replace(lamp, position_mm=camera_from_world.apply(lamp.position_mm))
            for lamp in self.lights
        )
        return replace(self, lights=lamps, up=camera_from_world.rotate(self.up))
