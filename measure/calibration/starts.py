"""Rough camera poses: from a board of known pose, or from markers alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, rms_length
from measure.calibration.boards import Board, Corners
from measure.calibration.extrinsics import located_by_marks
from measure.calibration.intrinsics import fit_pose_only
from measure.calibration.observations import BoardObservation, MarkerObservation
from measure.calibration.single_camera import board_pose
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics

_MIN_MARKS_ALONE = 6
_FLAT_RATIO = 0.02
_MAX_BOARD_RMS_PX = 3.0
CONTRADICTION_PX = 8.0
_NO_POSE = (
    "camera {name}: no camera pose explains its marks: are marker names mixed up, or is the "
    "picture mirrored?"
)


@dataclass(frozen=True, eq=False)
class DetectedBoard:
    """The board of known pose in one camera's picture."""

    corners: Corners
    world_from_board: RigidTransform


def start_from_board(name: str, lens: Intrinsics, board: Board, seen: DetectedBoard) -> Camera:
    """The camera as located by its board.

    Raises:
        CalibrationError: the corners do not fit the board under this lens.
    """
    points = board.points[seen.corners.ids]
    rms = fit_pose_only(lens, board.points, seen.corners).rms_px
    if rms > _MAX_BOARD_RMS_PX:
        raise CalibrationError(
            f"camera {name}: in {seen.corners.source} the board's corners miss by {rms:.1f} "
            "px under "
            "this camera's lens: is it this camera's picture, at the same zoom and focus?"
        )
    camera_from_board = board_pose(lens, points, seen.corners.pixels)
    return Camera(name, lens, seen.world_from_board @ camera_from_board.inverse())


def start_from_marks(
    name: str, lens: Intrinsics, markers: MarkerField, marks: MarkerObservation
) -> Camera:
    """The camera as located by its marks.

    Raises:
        CalibrationError: fewer than six marks, marks in one plane, or marks that fit no pose.
    """
    points = markers.points[marks.ids]
    if len(points) < _MIN_MARKS_ALONE:
        raise CalibrationError(
            f"camera {name}: without a board at least {_MIN_MARKS_ALONE} markers are needed, "
            f"{len(points)} are marked"
        )
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extent[2] < _FLAT_RATIO * extent[0]:
        raise CalibrationError(
            f"camera {name}: without a board the markers must not lie in one plane (extents "
            f"{extent[0]:.0f}, {extent[1]:.0f}, {extent[2]:.1f} mm)"
        )
    try:
        camera = Camera(name, lens, board_pose(lens, points, marks.pixels).inverse())
    except CalibrationError:
        raise CalibrationError(_NO_POSE.format(name=name)) from None
    camera = located_by_marks(camera, markers.points, marks)
    rms = mark_rms(camera, markers.points, marks)
    if rms > 3 * CONTRADICTION_PX:
        raise CalibrationError(f"{_NO_POSE.format(name=name)} (RMS {rms:.0f} px)")
    return camera


def mark_rms(camera: Camera, points: Floats, marks: MarkerObservation) -> float:
    """RMS length in px of marks less predicted markers; infinite if one lies behind."""
    error = marks.pixels - camera.project(points[marks.ids])
    value = rms_length(error)
    return value if np.isfinite(value) else np.inf


def board_observation(board: Board, seen: DetectedBoard) -> BoardObservation:
    """A seen board as an observation for the joint fit."""
    return BoardObservation(
        board.points[seen.corners.ids], seen.corners.pixels, seen.world_from_board
    )


def mm_per_px(camera: Camera, points: Floats) -> float:
    """What a pixel is worth at points (n, 3): their median distance over the focal length."""
    distance = float(np.median(np.linalg.norm(points - camera.center, axis=1)))
    return distance / camera.intrinsics.focal_px
