"""Rough camera poses: from a board of known pose, or from markers alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.boards import Board, Corners
from measure.calibration.extrinsics import fit_rig
from measure.calibration.intrinsics import board_rms
from measure.calibration.markers import assign
from measure.calibration.sights import BoardSight, MarkSight, Sights, Tolerances
from measure.calibration.single_camera import board_pose
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics

_MIN_MARKS_ALONE = 6
_FLAT_RATIO = 0.02
_BOARD_FITS_PX = 3.0
WRONG_PX = 8.0
WRONG_MM = 2.0
_NO_POSE = (
    "camera {name}: no camera pose explains its marks: are marker names mixed up, or is the "
    "picture mirrored?"
)
_EXPLAINS = 0.25
"""A hypothesis that leaves less than this share of the misfit is named as the cause."""


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """The board of known pose in one camera's picture."""

    corners: Corners
    world_from_board: RigidTransform


def start_from_board(name: str, lens: Intrinsics, board: Board, seen: SeenBoard) -> Camera:
    """The camera where its board says it is.

    Raises:
        CalibrationError: the corners do not fit the board under this lens.
    """
    points = board.points[seen.corners.ids]
    rms = board_rms(lens, board.points, seen.corners)
    if rms > _BOARD_FITS_PX:
        raise CalibrationError(
            f"camera {name}: in {seen.corners.source} the board's corners miss by {rms:.1f} "
            "px under "
            "this camera's lens: is it this camera's picture, at the same zoom and focus?"
        )
    camera_from_board = board_pose(lens, points, seen.corners.pixels)
    return Camera(name, lens, seen.world_from_board @ camera_from_board.inverse())


def start_from_marks(name: str, lens: Intrinsics, markers: MarkerField, marks: MarkSight) -> Camera:
    """The camera where its marks say it is.

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
    held = replace(camera, intrinsics=replace(lens, covariance=None))
    sights = Sights(markers.points, marks={name: marks}, tolerances=Tolerances(0.0))
    camera = replace(
        camera, world_from_camera=fit_rig((held,), sights).cameras[0].world_from_camera
    )
    rms = mark_rms(camera, markers.points, marks)
    if rms > 3 * WRONG_PX:
        raise CalibrationError(f"{_NO_POSE.format(name=name)} (RMS {rms:.0f} px)")
    return camera


def mark_rms(camera: Camera, points: Floats, marks: MarkSight) -> float:
    """RMS length in px of marks less predicted markers; infinite if one lies behind."""
    error = marks.pixels - camera.project(points[marks.ids])
    value = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    return value if np.isfinite(value) else np.inf


def mm_per_px(camera: Camera, points: Floats) -> float:
    """What a pixel is worth at points (n, 3): their median distance over the focal length."""
    distance = float(np.median(np.linalg.norm(points - camera.center, axis=1)))
    return distance / camera.intrinsics.focal_px


def check_board_against_marks(
    start: Camera,
    board: Board,
    seen: dict[str, SeenBoard],
    markers: MarkerField,
    marks: MarkSight,
) -> float:
    """How far board and markers disagree in one camera.

    Returns:
        Disagreement in mm at the markers.

    Raises:
        CalibrationError: they contradict each other; the message names the cause if one of the
            usual ones explains it.
    """
    rms = mark_rms(start, markers.points, marks)
    worth = mm_per_px(start, markers.points[marks.ids])
    if not (rms > WRONG_PX and rms * worth > WRONG_MM):
        return rms * worth
    cause = _cause(start, board, seen, markers, marks, rms)
    shown = f"{rms * worth:.1f} mm ({rms:.0f} px)" if np.isfinite(rms) else "beyond measure"
    raise CalibrationError(f"camera {start.name}: board and markers disagree by {shown}: {cause}")


def _cause(
    start: Camera,
    board: Board,
    seen: dict[str, SeenBoard],
    markers: MarkerField,
    marks: MarkSight,
    rms: float,
) -> str:
    name, mine = start.name, seen[start.name]

    def misfit(corners: Corners, world_from_board: RigidTransform, scale: float = 1.0) -> float:
        points = board.points[corners.ids] * scale
        pose = board_pose(start.intrinsics, points, corners.pixels)
        camera = replace(start, world_from_camera=world_from_board @ pose.inverse())
        return mark_rms(camera, markers.points, marks)

    causes = [
        (
            misfit(mine.corners, there.world_from_board),
            f"its board stands where the capture puts that of {other}: are the two swapped?",
        )
        for other, there in seen.items()
        if other != name
    ]
    mirrored = _mirrored(board, mine.corners, start.intrinsics)
    causes.append((misfit(mirrored, mine.world_from_board), "its board picture is mirrored"))
    turned = "the board fits after half a turn: its origin is at the other end"
    causes.append((misfit(_half_turned(board, mine.corners), mine.world_from_board), turned))
    for scale in np.geomspace(0.5, 2.0, 113):
        if abs(scale - 1) > 0.01:
            text = f"it fits squares of about {scale:.2f} times the stated size: check square_mm"
            causes.append((misfit(mine.corners, mine.world_from_board, float(scale)), text))
    left, text = min(causes)
    if left < WRONG_PX and left < _EXPLAINS * rms:
        return text
    permuted = _permuted(start, markers, marks)
    if permuted:
        return f"marker names are mixed up: {permuted}"
    return (
        "the camera or the board moved between the two pictures, a picture is mirrored, or the "
        "stated board pose is wrong; take both again"
    )


def _half_turned(board: Board, corners: Corners) -> Corners:
    """The view with the board's numbering turned by half a turn (chessboards)."""
    return replace(corners, ids=len(board.points) - 1 - corners.ids)


def _mirrored(board: Board, corners: Corners, lens: Intrinsics) -> Corners:
    """The view as it was before someone mirrored the picture left to right."""
    pixels = corners.pixels.copy()
    pixels[:, 0] = lens.size_wh[0] - 1 - pixels[:, 0]
    columns = int(np.sum(board.points[:, 1] == board.points[0, 1]))
    rows = len(board.points) // columns
    if len(corners.ids) != len(board.points):
        return replace(corners, pixels=pixels)
    # A mirrored chessboard was numbered along x the wrong way round; which end depends on colours.
    numbers = np.arange(len(board.points)).reshape(rows, columns)
    flipped = numbers[::-1] if rows % 2 == 0 and columns % 2 == 1 else numbers[:, ::-1]
    return replace(corners, pixels=pixels, ids=corners.ids[flipped.ravel()])


def _permuted(start: Camera, markers: MarkerField, marks: MarkSight) -> str:
    """Which marks sit where another marker should be, if renaming makes them all fit."""
    ids, numbers = assign(start.project(markers.points), marks.pixels, 3 * WRONG_PX)
    if len(ids) < 0.8 * len(marks.ids):
        return ""
    renamed = [
        f"{markers.names[marks.ids[n]]} sits at the place of {markers.names[i]}"
        for i, n in zip(ids, numbers, strict=True)
        if marks.ids[n] != i
    ]
    return ", ".join(renamed[:4]) + (", ..." if len(renamed) > 4 else "")


def board_sight(board: Board, seen: SeenBoard) -> BoardSight:
    """A seen board as an observation for the joint fit."""
    return BoardSight(board.points[seen.corners.ids], seen.corners.pixels, seen.world_from_board)
