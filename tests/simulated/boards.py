"""Printed boards as shapes: chessboards drawn exactly, anything else from a bitmap."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from measure.arrays import Bytes, Floats
from measure.geometry import RigidTransform
from measure.simulation.scene import Cuboid, Material

_PAPER, _INK = 0.75, 0.025
_THICK_MM = 4.0


@dataclass(frozen=True)
class Chessboard:
    """A chessboard on a plate.

    The board frame has its origin at an outermost inner corner, x along the longer row of corners,
    y along the shorter, z into the board. The outer square diagonal to the origin is black; on the
    standard board, with an odd and an even number, the one at the opposite end is white.

    Attributes:
        inner_corners: along x and y.
        square_mm: edge of a square.
        margin_mm: white border.
    """

    inner_corners: tuple[int, int] = (9, 6)
    square_mm: float = 25.0
    margin_mm: float = 20.0

    @property
    def points(self) -> Floats:
        """The inner corners (n, 3) in the board frame, row by row."""
        columns, rows = self.inner_corners
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
        return np.column_stack([grid * self.square_mm, np.zeros(len(grid))])

    @property
    def outline(self) -> Floats:
        """The four outer corners (4, 3) of the pattern, without the margin."""
        (columns, rows), s = self.inner_corners, self.square_mm
        x, y = np.array([-s, columns * s, columns * s, -s]), np.array([-s, -s, rows * s, rows * s])
        return np.column_stack([x, y, np.zeros(4)])

    def shape(self, world_from_board: RigidTransform) -> Cuboid:
        """The plate in the world."""
        return _plate(world_from_board, self.outline, self.margin_mm, self._reflectance)

    def _reflectance(self, xy: Floats) -> Floats:
        square = np.floor(xy / self.square_mm).astype(int)
        inside = (square >= -1).all(axis=1) & (square < np.array(self.inner_corners)).all(axis=1)
        return np.where(inside & (square.sum(axis=1) % 2 == 0), _INK, _PAPER)


@dataclass(frozen=True, eq=False)
class Print:
    """A printed bitmap on a plate, such as a ChArUco board.

    Attributes:
        bitmap: (h, w) uint8, 0 black to 255 white; its top left corner is at `corner_mm`.
        pixel_mm: printed size of a pixel.
        corner_mm: where the bitmap's top left corner lies in the board frame.
        margin_mm: white border.
    """

    bitmap: Bytes
    pixel_mm: float
    corner_mm: tuple[float, float] = (0.0, 0.0)
    margin_mm: float = 20.0

    @property
    def outline(self) -> Floats:
        """The four outer corners (4, 3) of the print."""
        height, width = self.bitmap.shape
        (x, y), w, h = self.corner_mm, width * self.pixel_mm, height * self.pixel_mm
        return np.array([[x, y, 0], [x + w, y, 0], [x + w, y + h, 0], [x, y + h, 0]])

    def shape(self, world_from_board: RigidTransform) -> Cuboid:
        """The plate in the world."""
        return _plate(world_from_board, self.outline, self.margin_mm, self._reflectance)

    def _reflectance(self, xy: Floats) -> Floats:
        where = ((xy - self.corner_mm) / self.pixel_mm).astype(np.float32)
        # Nearest pixel: printed edges are sharp.
        u, v = np.floor(where[:, 0]).astype(int), np.floor(where[:, 1]).astype(int)
        height, width = self.bitmap.shape
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        level = self.bitmap[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] / 255.0
        return np.where(inside, _INK + (_PAPER - _INK) * level, _PAPER)


def charuco(
    inner_corners: tuple[int, int], square_mm: float, marker_mm: float, dictionary: str
) -> Print:
    """A ChArUco board; the frame's origin is its top left corner, as in OpenCV."""
    squares = (inner_corners[0] + 1, inner_corners[1] + 1)
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard(squares, square_mm, marker_mm, words)
    per_square = 240
    size = (squares[0] * per_square, squares[1] * per_square)
    bitmap = np.asarray(board.generateImage(size), dtype=np.uint8)
    return Print(bitmap, square_mm / per_square)


def _plate(
    world_from_board: RigidTransform, outline: Floats, margin_mm: float, reflectance: object
) -> Cuboid:
    """A box whose face towards the viewer (z = 0 of the board frame) carries the pattern."""
    middle = outline.mean(axis=0) + np.array([0.0, 0.0, _THICK_MM / 2])
    wide, high = np.ptp(outline[:, :2], axis=0) + 2 * margin_mm
    assert callable(reflectance)
    pattern = reflectance

    def texture(points: Floats) -> Floats:
        front = points[:, 2] < -_THICK_MM / 2 + 1e-6
        level = np.where(front, pattern(points[:, :2] + middle[:2]), 0.1)
        return np.repeat(level[:, None], 3, axis=1)

    pose = world_from_board @ RigidTransform(np.eye(3), middle)
    return Cuboid(
        pose, (float(wide), float(high), _THICK_MM), Material((0.5,) * 3, texture=texture)
    )
