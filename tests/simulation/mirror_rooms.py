"""Rooms to be mirrored, and what mirrored rays meet in them, computed independently."""

from __future__ import annotations

import numpy as np

from measure.geometry import RigidTransform
from measure.simulation import Cuboid, Lighting, Material, Renderer, Scene
from tests.simulated.mirroring import Mirror, mirrored
from tests.simulation.test_renderer import white_scene

EVEN = Lighting((), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), below=1.0, mirror=Mirror)
CENTER, RADIUS = np.array([0.0, 0.0, 250.0]), 20.0
SMOOTH = Material((0.0, 0.0, 0.0), 1.0, 0.0)
HALF_MM = 700.0


def beside(*offset_mm):
    """A place so far from the ball."""
    return CENTER + np.array(offset_mm)


def chequered(points):
    """Two colours in squares of 90 mm, by the place in a wall's own frame."""
    odd = np.floor(points / 90.0).astype(int)[:, 1:].sum(axis=1) % 2 == 1
    return np.where(odd[:, None], (0.9, 0.5, 0.1), (0.1, 0.3, 0.8))


def closed_room(paint=None, **material):
    """Six walls round the world's origin; their frames' x axes point at each wall in turn."""
    shapes = []
    for axis in range(3):
        for sign in (-1, 1):
            turn = np.roll(np.eye(3), axis, axis=0)
            place = np.zeros(3)
            place[axis] = sign * (HALF_MM + 5)
            wall = Material(paint or (0, 0, 0), **material)
            size = (10.0, 2 * HALF_MM + 40, 2 * HALF_MM + 40)
            shapes.append(Cuboid(RigidTransform(turn, place), size, wall))
    return tuple(shapes)


def scene(*fixed, walls=(), light=EVEN, **changes) -> Scene:
    plain = white_scene(lighting=light, fixed=fixed, backdrop=walls, backdrop_px=1, **changes)
    return mirrored(plain)


def seen(scene_, camera="cam0"):
    """Radiance (h, w, 3), R G B."""
    return Renderer(scene_, camera).radiance(0.0)[..., ::-1].astype(float)


def mirrored_rays(camera, center=CENTER, margin_px=1.0):
    """What pixels well inside a smooth ball mirror.

    Returns:
        The pixels (n, 2), where their rays meet the ball (n, 3), the normals there, and the
        directions in which they go on.
    """
    rows, columns = np.mgrid[0 : camera.intrinsics.size_wh[1], 0 : camera.intrinsics.size_wh[0]]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = camera.intrinsics.unproject(pixels.astype(float)) @ camera.world_from_camera.rotation.T
    to_center = center - camera.center
    along = rays @ to_center
    off = np.sqrt(to_center @ to_center - along**2)
    inside = off < RADIUS - margin_px * np.linalg.norm(to_center) / camera.intrinsics.focal_px
    rays, along, off = rays[inside], along[inside], off[inside]
    places = camera.center + (along - np.sqrt(RADIUS**2 - off**2))[:, None] * rays
    normals = (places - center) / RADIUS
    on = rays - 2 * np.sum(rays * normals, axis=1, keepdims=True) * normals
    return pixels[inside], places, normals, on


def wall_colours(places, directions):
    """What rays meet in the chequered room, and how far (n,) from a change of colour, in mm."""
    away = ((np.sign(directions) * HALF_MM) - places) / directions
    axis = np.argmin(away, axis=1)
    hits = places + np.min(away, axis=1)[:, None] * directions
    local = np.stack([np.roll(np.eye(3), k, axis=0) for k in range(3)])[axis]
    local = np.einsum("nij,ni->nj", local, hits)
    edge = np.abs(local[:, 1:] / 90.0 - np.rint(local[:, 1:] / 90.0)).min(axis=1) * 90.0
    return chequered(local), edge
