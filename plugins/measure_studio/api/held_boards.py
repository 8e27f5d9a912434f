"""Printed boards, and how a person holds them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Bytes, Floats
from measure.geometry import RigidTransform
from measure.limits import MAX_STEPS
from measure.model import Camera
from measure.simulation.scene import Cuboid, Material

_INK, _PAPER, _BACK = 0.02, 0.52, 0.3  # Reflectance: print, paper, and the board's other sides
_THICK_MM = 2.0


def printed_board(print_: Bytes, px_per_mm: float, corner_mm: tuple[float, float]) -> Cuboid:
    """A stiff and flat board with a print; its frame is that of the target on it.

    That is in the plane z = 0, x right, y down, z into the board.

    Args:
        print_: (h, w) from 0, black, to 255, white.
        corner_mm: where the print's upper left corner lies in the frame.
    """
    height, width = print_.shape
    size = np.array([width / px_per_mm, height / px_per_mm, _THICK_MM])

    def reflectance(points: Floats) -> Floats:
        place = (points + size / 2) * (px_per_mm, px_per_mm, 1)
        u, v = np.clip(place[:, :2].astype(int), 0, (width - 1, height - 1)).T
        ink = _INK + (_PAPER - _INK) / 255 * print_[v, u]
        return np.repeat(np.where(place[:, 2] < 1e-3, ink, _BACK)[:, None], 3, axis=1)

    middle = RigidTransform(np.eye(3), np.array([*corner_mm, 0.0]) + size / 2)
    return Cuboid(middle, tuple(size), Material((_BACK,) * 3, texture=reflectance))


@dataclass(frozen=True)
class Held:
    """A pose each second."""

    poses: Sequence[RigidTransform]  # world_from_board

    def at(self, times_s: ArrayLike) -> RigidTransform:
        """world_from_board at times (n,)."""
        some = [self.poses[round(time_s)] for time_s in np.asarray(times_s).tolist()]
        places = np.array([one.translation for one in some])
        return RigidTransform(np.array([one.rotation for one in some]), places)


def held_poses(
    cameras: Sequence[Camera], points: Floats, middle: Floats, seed: int = 0
) -> list[RigidTransform]:
    """world_from_board as a person holds a board: to each camera, and between neighbours.

    Every camera gets it near and far, in the middle and in all corners of its picture, tilted to
    all sides; all corners of the board are in that picture.

    Args:
        points: corners of the board (n, 3), mm.
        middle: what all cameras look at (3,), mm in the world.
    """
    rng = np.random.default_rng(seed)
    alone = [list(_before(camera, points, rng)) for camera in cameras]
    shared = [
        [_between(pair, points, middle, rng) for _ in range(_SHARED)]
        for pair in zip(cameras, [*cameras[1:], cameras[0]], strict=True)
    ]
    rounds = zip_longest(zip(*alone, strict=True), zip(*shared, strict=True), fillvalue=())
    return [pose for both in rounds for some in both for pose in some]


_PLACES = ((0, 0, 0.6), (-1, -1, 0.45), (1, -1, 0.45), (-1, 1, 0.45), (1, 1, 0.45), (0.3, 0, 0.33))
"""Before a camera: to the side and down, from edge to edge, and width over the picture's."""
_TILT_RAD = np.deg2rad(28.0)
_SHARED = 6  # Poses between two neighbours
_EDGE_PX = 12.0  # Between the picture's edge and the corner nearest to it
_OBLIQUE_RAD = np.deg2rad(55.0)  # Chessboards are found by a camera up to here, and not much beyond


def _before(camera: Camera, points: Floats, rng: np.random.Generator) -> Iterator[RigidTransform]:
    """Poses before one camera."""
    lens = camera.intrinsics
    wide = float(np.ptp(points[:, 0]))
    for across, down, share in _PLACES:
        tilt = rng.uniform(0.75, 1.0) * _TILT_RAD * rng.choice([-1, 1], 2)
        turn = RigidTransform.from_rotvec([tilt[0], tilt[1], rng.uniform(-0.15, 0.15)])
        depth = wide * lens.focal_px / (share * lens.size_wh[0])
        for inward in np.linspace(1.0, 0.0, 21):  # until it is wholly in the picture
            offset = np.array([across, down]) * inward * np.array(lens.size_wh) / 2
            pixel = np.array(lens.size_wh) / 2 - 0.5 + offset
            bearing = lens.unproject(pixel[None])[0]
            place = bearing * depth / bearing[2] - turn.rotate(points.mean(axis=0))
            pose = replace(turn, translation=place)
            if lens.contains(lens.project(pose.apply(points)), _EDGE_PX).all():
                break
        yield camera.world_from_camera @ pose


def _between(
    pair: Sequence[Camera], points: Floats, middle: Floats, rng: np.random.Generator
) -> RigidTransform:
    """A pose near the middle, turned to a place between two cameras, which both see all of it."""
    towards = np.mean([camera.center for camera in pair], axis=0) - middle
    away = -towards / np.linalg.norm(towards)
    right = np.cross(away, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    facing = RigidTransform(np.column_stack([right, np.cross(away, right), away]), np.zeros(3))
    for _ in range(MAX_STEPS):
        turn = facing @ RigidTransform.from_rotvec(rng.uniform(-0.6, 0.6, 3) * _TILT_RAD)
        place = middle + rng.uniform(-45, 45, 3) - turn.rotate(points.mean(axis=0))
        pose = replace(turn, translation=place)
        if all(_shows(camera, pose, points) for camera in pair):
            break
    return pose


def _shows(camera: Camera, pose: RigidTransform, points: Floats) -> bool:
    """Whether the camera sees a board's points (n, 3), not too much from the side."""
    places = pose.apply(points)
    sight = places.mean(axis=0) - camera.center
    cosine = sight @ pose.rotation[:, 2] / np.linalg.norm(sight)
    inside = camera.intrinsics.contains(camera.project(places), _EDGE_PX)
    return bool(cosine > np.cos(_OBLIQUE_RAD) and inside.all())
