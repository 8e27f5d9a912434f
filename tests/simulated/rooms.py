"""Coloured backdrops: wood, plain paint, posters and rugs."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools, Floats
from measure.compiling import compiled
from measure.simulation.catalogue import room
from measure.simulation.scene import BALL_ALBEDO, Material, Rgb, Shape


def coloured_room(seed: int = 0) -> tuple[Shape, ...]:
    """A wooden floor with coloured rugs, and walls full of posters."""
    paints: tuple[Rgb, ...] = ((0.10, 0.14, 0.22), (0.26, 0.17, 0.17), (0.18, 0.22, 0.14))
    walls = tuple(patches(plain(paint), seed + k, (1, 2)) for k, paint in enumerate(paints))
    return room(patches(planks(seed), seed + 9, (0, 1), 40), walls, half_mm=900.0)


def planks(seed: int = 0, width_mm: float = 160.0) -> Material:
    """A wooden floor."""
    rng = np.random.default_rng(seed)
    shades = rng.uniform(0.75, 1.15, 64)
    wood = np.array([0.30, 0.19, 0.10])

    def texture(points: Floats) -> Floats:
        across = points[:, 1] / width_mm
        plank = np.floor(across).astype(int) % len(shades)
        grain = 1 + 0.06 * np.sin(points[:, 1] / 3 + 4 * np.sin(points[:, 0] / 200 + plank))
        gap = np.where(np.abs(across - np.rint(across)) < 0.012, 0.4, 1.0)
        return wood * (shades[plank] * grain * gap)[:, None]

    return Material((0.3, 0.19, 0.1), texture=texture)


def plain(paint: Rgb) -> Material:
    """One colour all over."""
    return Material(paint, texture=lambda points: np.tile(np.array(paint), (len(points), 1)))


def patches(
    ground: Material, seed: int = 0, plane: tuple[int, int] = (1, 2), count: int = 60
) -> Material:
    """Ellipses and rectangles in the colours of balls, on a textured ground.

    Args:
        ground: material under them.
        seed: of their places, sizes and colours.
        plane: the two axes of the box's frame that they lie in.
        count: how many.
    """
    under = ground.texture
    assert under is not None
    rng = np.random.default_rng(seed)
    names = list(BALL_ALBEDO)
    centers = rng.uniform(-900, 900, (count, 2))
    halves = rng.uniform((30, 25), (150, 90), (count, 2))
    colours = np.array([BALL_ALBEDO[names[k]] for k in rng.integers(0, len(names), count)])
    rounds = rng.random(count) < 0.5

    def texture(points: Floats) -> Floats:
        out = under(points)
        _paint(np.ascontiguousarray(points[:, plane]), centers, halves, rounds, colours, out)
        return out

    return Material(ground.albedo_rgb, texture=texture)


@compiled
def _paint(
    xy: Floats, centers: Floats, halves: Floats, rounds: Bools, colours: Floats, out: Floats
) -> None:
    """Give points (n, 2) the colour of the last patch that they lie on, if any."""
    for i in range(len(xy)):
        for k in range(len(centers) - 1, -1, -1):
            x = (xy[i, 0] - centers[k, 0]) / halves[k, 0]
            y = (xy[i, 1] - centers[k, 1]) / halves[k, 1]
            if (x * x + y * y < 1) if rounds[k] else (max(abs(x), abs(y)) < 1):
                for c in range(3):
                    out[i, c] = colours[k, c]
                break
