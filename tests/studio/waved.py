"""A board that is waved before cameras without distortion: drawn by its homography, exactly."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from measure.api import shipped_targets
from measure.arrays import Bytes, Floats
from measure.calibration import Charuco, Chessboard, Corners, read_board
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics

TARGET, PLAIN = "charuco_8x5_27", "chessboard_9x6_25"
SIZE_WH, NOISE_PX = (640, 480), 0.05
_PX_PER_MM, _FINER = 4, 3


def board() -> Charuco:
    """A board whose views count in part, too."""
    found = read_board(shipped_targets()[TARGET])
    assert isinstance(found, Charuco)
    return found


def plain_board() -> Chessboard:
    """A board that is seen whole or not at all."""
    found = read_board(shipped_targets()[PLAIN])
    assert isinstance(found, Chessboard)
    return found


def rig(azimuths_deg: tuple[float, ...] = (60, 120)) -> tuple[Camera, ...]:
    """Cameras at 520 mm from the middle, looking down at it from one side."""
    out = []
    for number, azimuth in enumerate(np.deg2rad(azimuths_deg)):
        center = np.array([330 * np.cos(azimuth), 330 * np.sin(azimuth), 400.0])
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        turn = np.column_stack([right, np.cross(forward, right), forward])
        matrix = np.array([[700.0 + 9 * number, 0, 322], [0, 703, 236], [0, 0, 1]])
        lens = Intrinsics(SIZE_WH, matrix, np.zeros(5))
        out.append(Camera(f"cam{number}", lens, RigidTransform(turn, center)))
    return tuple(out)


def waved(time_s: float, target: Charuco | Chessboard | None = None) -> RigidTransform:
    """world_from_board, of the ChArUco if none is given.

    It wanders about the middle, tilts to all sides, faces up.
    """
    t = time_s
    middle = [130 * np.sin(0.9 * t), 95 * np.sin(0.61 * t + 1), -20 + 70 * np.sin(0.37 * t)]
    tilt = np.deg2rad(38) * np.sin(0.7 * t + 0.3)
    axis = np.array([np.cos(0.5 * t), np.sin(0.5 * t), 0.0])
    over = RigidTransform.from_rotvec(np.array([np.pi, 0, 0])).rotation
    turn = RigidTransform.from_rotvec(tilt * axis).rotation @ over
    return RigidTransform(turn, np.array(middle) - turn @ (target or board()).points.mean(axis=0))


def corners(camera: Camera, world_from_board: RigidTransform) -> Floats:
    """Where the board's corners appear (n, 2)."""
    return camera.project(world_from_board.apply(board().points))


def looked_at(
    cameras: Sequence[Camera], time_s: float, rng: np.random.Generator, sharpness: float = 0.4
) -> dict[str, Corners]:
    """The waved board's corners inside the cameras' pictures, with noise, without drawing it."""
    views = {}
    for camera in cameras:
        at = corners(camera, waved(time_s))
        ids = np.flatnonzero(camera.intrinsics.contains(at))
        if len(ids) > 10:
            noisy = at[ids] + rng.normal(0, NOISE_PX, (len(ids), 2))
            views[camera.name] = Corners(ids, noisy, sharpness, "")
    return views


def picture(
    camera: Camera,
    world_from_board: RigidTransform,
    rng: np.random.Generator,
    target: Charuco | Chessboard | None = None,
) -> Bytes:
    """What the camera sees, with the blur of a lens and the noise of a sensor."""
    camera_from_board = camera.world_from_camera.inverse() @ world_from_board
    drawn, corner_mm = _sheet(target or board())
    margin = 40 * _PX_PER_MM
    sheet = cv2.copyMakeBorder(
        drawn, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255
    )
    to_mm = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, _PX_PER_MM]]) / _PX_PER_MM
    to_mm[:2, 2] += corner_mm - 40.0
    plane = np.column_stack([camera_from_board.rotation[:, :2], camera_from_board.translation])
    finer = np.diag([_FINER, _FINER, 1.0])
    finer[:2, 2] = (_FINER - 1) / 2
    seen = cv2.warpPerspective(
        cv2.blur(sheet, (3, 3)),
        finer @ camera.intrinsics.matrix @ plane @ to_mm,
        (_FINER * SIZE_WH[0], _FINER * SIZE_WH[1]),
        borderValue=110,
    )
    small = cv2.resize(seen, SIZE_WH, interpolation=cv2.INTER_AREA)
    levels = 30 + 0.75 * cv2.GaussianBlur(small, (0, 0), 0.6) + rng.normal(0, 1.5, small.shape)
    return np.dstack([np.clip(levels, 0, 255).astype(np.uint8)] * 3)


def _sheet(target: Charuco | Chessboard) -> tuple[Bytes, float]:
    """The printed squares, and where their first corner lies in the board's frame, in x and y."""
    across, down = np.array(target.inner_corners) + 1
    side = int(target.square_mm * _PX_PER_MM)
    if isinstance(target, Charuco):
        return np.asarray(target.pattern.generateImage((across * side, down * side))), 0.0
    y, x = np.mgrid[:down, :across]
    squares = np.where((x + y) % 2, 255, 0).astype(np.uint8)
    return np.repeat(np.repeat(squares, side, axis=0), side, axis=1), -target.square_mm


def dots(camera: Camera, points: Floats, radius_mm: float = 4.0) -> Bytes:
    """Bright dots at places (n, 3) on a dark ground, as a camera shows them."""
    width, height = camera.intrinsics.size_wh
    light = np.full((height, width), 0.05)
    ways = points - camera.center
    for (u, v), way in zip(camera.project(points), ways, strict=True):
        radius = radius_mm * camera.intrinsics.focal_px / np.linalg.norm(way)
        x, y = round(u) - 20, round(v) - 20
        if not (0 <= x < width - 41 and 0 <= y < height - 41):
            continue
        grid = (np.arange(41 * _FINER) + 0.5) / _FINER - 0.5
        across, down = np.meshgrid(grid + x - u, grid + y - v)
        disc = (np.hypot(across, down) < radius) * 0.6
        small = cv2.resize(disc, (41, 41), interpolation=cv2.INTER_AREA)
        light[y : y + 41, x : x + 41] = np.maximum(light[y : y + 41, x : x + 41], 0.05 + small)
    blurred = cv2.GaussianBlur(light, (0, 0), 0.7)
    code = np.where(blurred < 0.0031308, 12.92 * blurred, 1.055 * blurred ** (1 / 2.4) - 0.055)
    return np.dstack([np.rint(255 * code).astype(np.uint8)] * 3)
