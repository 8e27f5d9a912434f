"""What cameras see of a printed board, through their true lenses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest

import cv2
import numpy as np

from measure.arrays import Bytes, Floats
from measure.geometry import RigidTransform
from measure.model import Camera
from measure.simulation.canvas import ideal_grid
from measure.simulation.sensor import Linear

_INK, _PAPER, _BACK = 0.02, 0.52, 0.3  # Radiance: print, paper in the light, and the board's back
_FINER = 2  # Rays through a pixel, along each side
_SIDE_PX = 4.0  # Beyond its outline, for the area in which a board is drawn


@dataclass(frozen=True, eq=False)
class RenderedSheet:
    """A printed sheet, stiff and flat.

    Its frame is that of the board on it: in the plane z = 0, x right, y down, z into the paper.
    """

    print: Bytes  # (h, w) from 0, black, to 255, white
    px_per_mm: float  # of the print
    corner_mm: tuple[float, float]  # where the print's upper left corner lies in the frame

    @property
    def outline(self) -> Floats:
        """Its corners (4, 3), mm."""
        height, width = np.array(self.print.shape) / self.px_per_mm
        flat = np.array([[0, 0], [width, 0], [width, height], [0, height]]) + self.corner_mm
        return np.column_stack([flat, np.zeros(4)])


class SheetPainter:
    """Draws a sheet into the pictures of one camera."""

    def __init__(self, sheet: RenderedSheet, camera: Camera) -> None:
        self._sheet, self._camera = sheet, camera

    def paint(self, before: Linear, world_from_sheet: RigidTransform) -> Linear:
        """A picture's radiance (h, w, 3) with the sheet in it, before all else.

        A sheet that reaches behind the camera is left out.
        """
        pose = self._camera.camera_from_world @ world_from_sheet
        rows, columns = self._area(pose)
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return before
        light, covered = self._seen(pose, rows, columns)
        out = before.copy()
        kept = 1 - covered[..., None]
        out[rows, columns] = out[rows, columns] * kept + light[..., None]
        return out

    @cached_property
    def _ideal(self) -> Linear:
        """Undistorted coordinates (h + 2, w + 2, 2), one pixel beyond the picture's border."""
        return ideal_grid(self._camera.intrinsics).astype(np.float32)

    def _area(self, pose: RigidTransform) -> tuple[slice, slice]:
        """Rows and columns in which it can be seen."""
        width, height = self._camera.intrinsics.size_wh
        ends = self._sheet.outline
        edges = np.concatenate([np.linspace(ends[k - 1], ends[k], 9) for k in range(4)])
        if (pose.apply(edges)[:, 2] <= 0).any():
            return slice(0), slice(0)
        pixels = self._camera.intrinsics.project(pose.apply(edges))
        low = np.clip(np.floor(pixels.min(axis=0) - _SIDE_PX), 0, (width, height)).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0) + _SIDE_PX), 0, (width, height)).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _seen(self, pose: RigidTransform, rows: slice, columns: slice) -> tuple[Linear, Linear]:
        """The sheet's light over an area (h, w), and which share of each pixel it covers."""
        at = self._ideal[rows.start : rows.stop + 2, columns.start : columns.stop + 2]
        middle = at[1:-1, 1:-1]
        by_column, by_row = (at[1:-1, 2:] - at[1:-1, :-2]) / 2, (at[2:, 1:-1] - at[:-2, 1:-1]) / 2
        print_from_ideal = self._homography(pose)
        light = np.zeros(middle.shape[:2], np.float32)
        covered = np.zeros_like(light)
        steps = (np.arange(_FINER, dtype=np.float32) + 0.5) / _FINER - np.float32(0.5)
        for down in steps:
            for across in steps:
                rays = middle + across * by_column + down * by_row
                level, inside = self._met(print_from_ideal, rays)
                light += level * inside
                covered += inside
        rays_a_pixel = np.float32(_FINER**2)
        return light / rays_a_pixel, covered / rays_a_pixel

    def _homography(self, pose: RigidTransform) -> Floats:
        """From rays (x, y, 1) to pixels of the print (3, 3); the last one is positive in front."""
        plane = np.column_stack([pose.rotation[:, :2], pose.translation])
        scale = self._sheet.px_per_mm
        to_print = np.array([[scale, 0, -0.5], [0, scale, -0.5], [0, 0, 1.0]])
        to_print[:2, 2] -= scale * np.array(self._sheet.corner_mm)
        return np.asarray(to_print @ np.linalg.inv(plane), dtype=np.float64)

    def _met(self, print_from_ideal: Floats, rays: Linear) -> tuple[Linear, Linear]:
        """The radiance (h, w) that rays (h, w, 2) meet, and whether they meet the sheet."""
        height, width = self._sheet.print.shape
        x, y, w = cv2.split(cv2.transform(rays, print_from_ideal.astype(np.float32)))
        u, v = (np.asarray(place / w, np.float32) for place in (x, y))
        inside = (w > 0) & (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
        if np.linalg.det(print_from_ideal) < 0:
            return np.full_like(u, _BACK), inside.astype(np.float32)
        ink = cv2.remap(self._sheet.print, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        level = np.float32(_INK) + np.float32((_PAPER - _INK) / 255) * ink.astype(np.float32)
        return level, inside.astype(np.float32)


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
_TRIES = 50


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
    for _ in range(_TRIES):
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
