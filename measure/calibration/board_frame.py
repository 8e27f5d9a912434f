"""Where a board lies, by cameras that are calibrated already."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from scipy.optimize import least_squares

from measure.arrays import Bytes, Floats, rms_length
from measure.calibration.board_views import board_pose
from measure.calibration.boards import Board, Corners, same_after
from measure.errors import CalibrationError
from measure.geometry import RigidTransform, UncertainTransform, skew
from measure.model import Camera

_View = tuple[Camera, Corners]
_UP_FROM_BOARD = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
_LEAST_SD_PX = 0.05  # Corners are never more exact, however few there are
_WRONG_PX = 5.0
"""Corners further off than this are no noise: the board moved, or a camera did."""


def board_frame(
    board: Board, cameras: Sequence[Camera], pictures: Mapping[str, Bytes]
) -> UncertainTransform:
    """The frame world_from_board of a board that lies still, its z axis towards the viewer.

    Its origin is the board's and its x axis is printed; y runs against the board's own, so that z
    comes out of the paper. Least squares over the corners in all pictures (BGR by camera name, of
    one instant); the covariance holds the corners' scatter and what the cameras' own uncertainties
    do to it. CalibrationError: the board is in no picture, looks the same after a turn, or the
    pictures contradict each other.
    """
    if len(board.turns) > 1:
        raise CalibrationError(
            f"{same_after(board)}, and a frame cannot be told from it: take a ChArUco board, or "
            "one with an odd and an even number of inner corners"
        )
    looked = [(c, _corners(board, pictures[c.name], c.name)) for c in cameras if c.name in pictures]
    views = [(camera, corners) for camera, corners in looked if corners is not None]
    if not views:
        raise CalibrationError(f"no board found in any of {len(pictures)} pictures")
    pose = _fit(board, views)
    off = [float(rms_length(_residuals(board, [v], pose).reshape(-1, 2))) for v in views]
    if max(off) > _WRONG_PX:
        worst = views[int(np.argmax(off))][0].name
        raise CalibrationError(
            f"camera {worst}: the board's corners lie {max(off):.1f} px from where the other "
            "pictures put them: did the board or a camera move, or is square_mm wrong?"
        )
    return UncertainTransform(pose @ _UP_FROM_BOARD.inverse(), _covariance(board, views, pose))


def _corners(board: Board, bgr: Bytes, name: str) -> Corners | None:
    return board.find(np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8), name)


def _fit(board: Board, views: Sequence[_View]) -> RigidTransform:
    start = min((_by_one(board, *view) for view in views), key=lambda p: _cost(board, views, p))

    def residuals(delta: Floats) -> Floats:
        return _residuals(board, views, start.perturb(delta))

    scale = [1.0] * 3 + [0.01] * 3
    solved = least_squares(residuals, np.zeros(6), jac="3-point", x_scale=scale, loss="soft_l1")
    return start.perturb(solved.x)


def _by_one(board: Board, camera: Camera, seen: Corners) -> RigidTransform:
    pose = board_pose(camera.intrinsics, board.points[seen.ids], seen.pixels)
    return camera.world_from_camera @ pose


def _residuals(board: Board, views: Sequence[_View], pose: RigidTransform) -> Floats:
    parts = [c.project(pose.apply(board.points[v.ids])) - v.pixels for c, v in views]
    return np.nan_to_num(np.concatenate(parts).ravel(), nan=1e3)


def _cost(board: Board, views: Sequence[_View], pose: RigidTransform) -> float:
    return float(np.sum(np.abs(_residuals(board, views, pose))))


def _covariance(board: Board, views: Sequence[_View], pose: RigidTransform) -> Floats:
    """By the corners' scatter, and by the cameras' covariances through the normal equations."""
    normal, by_cameras = np.zeros((6, 6)), []
    for camera, seen in views:
        places = pose.apply(board.points[seen.ids])
        _, by_world, by_pose, by_lens = camera.project_with_jacobians(places)
        turn = -by_world @ skew(places - pose.translation)
        J = np.concatenate([by_world, turn], axis=2).reshape(-1, 6)
        normal += J.T @ J
        if camera.covariance is not None:
            K = np.concatenate([by_pose, by_lens], axis=2).reshape(len(J), -1)
            by_cameras.append((J.T @ K, camera.covariance))
    off = _residuals(board, views, pose)
    variance = max(float(off @ off) / max(len(off) - 6, 1), _LEAST_SD_PX**2)
    inverse = np.linalg.inv(normal)
    shared = sum((inverse @ G @ P @ G.T @ inverse for G, P in by_cameras), np.zeros((6, 6)))
    return np.asarray(variance * inverse + shared)
