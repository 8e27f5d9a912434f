"""Backdrops: floors and walls of cloth."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.simulation.shading import Material
from measure.simulation.shapes import Cuboid, Shape

_FLAT_MM = 20.0


def room(
    floor: Material, walls: tuple[Material, ...], half_mm: float = 1400.0, height_mm: float = 2400.0
) -> tuple[Shape, ...]:
    """A floor at z = 0 and four walls; the wall materials repeat cyclically."""
    ground = RigidTransform(np.eye(3), np.array([0.0, 0.0, -_FLAT_MM / 2]))
    shapes: list[Shape] = [Cuboid(ground, (4 * half_mm, 4 * half_mm, _FLAT_MM), floor)]
    for k in range(4):
        turn = RigidTransform.from_rotvec([0.0, 0.0, k * np.pi / 2])
        place = RigidTransform(np.eye(3), np.array([half_mm, 0.0, height_mm / 2 - 100]))
        size = (_FLAT_MM, 2 * half_mm, height_mm)
        shapes.append(Cuboid(turn @ place, size, walls[k % len(walls)]))
    return tuple(shapes)


def cloth_room(level: float, seed: int = 0) -> tuple[Shape, ...]:
    """Floor and walls hung with cloth of one reflectance."""
    return room(cloth(level, seed), (cloth(level, seed + 1), cloth(1.2 * level, seed + 2)))


def cloth(level: float, seed: int = 0, unevenness: float = 0.35) -> Material:
    """A grey cloth with soft folds."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 1 / 180, (12, 3)) * rng.uniform(0.3, 3, (12, 1))
    phases = rng.uniform(0, 2 * np.pi, 12)

    def texture(points: Floats) -> Floats:
        folds = np.sin(points @ waves.T + phases).sum(axis=1) / np.sqrt(12)
        grey = level * (1 + unevenness * np.clip(folds, -1.5, 1.5) / 1.5)
        return np.repeat(grey[:, None], 3, axis=1)

    return Material((level, level, level), texture=texture)
