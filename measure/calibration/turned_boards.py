"""Which way round a board of known pose lies, where its own pattern does not tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.calibration.boards import Board, same_after
from measure.calibration.capture import CameraCapture, Capture
from measure.calibration.marking import marks_of
from measure.calibration.starts import CONTRADICTION_PX, DetectedBoard, mark_rms, start_from_board
from measure.errors import CalibrationError
from measure.model import Intrinsics

_CLEAR_RATIO = 3.0
"""How much worse the marks must fit any other turn."""


def oriented_board(
    camera: CameraCapture, lens: Intrinsics, board: Board, seen: DetectedBoard, capture: Capture
) -> DetectedBoard:
    """The board with its corners numbered as they are.

    Of the turns after which the board looks the same it is the one whose origin the capture says
    is near `board_origin_px`; or else the one that puts the camera where its marks agree, and
    above the floor.

    Raises:
        CalibrationError: nothing tells which.
    """
    turned = [
        replace(seen, corners=replace(seen.corners, ids=turn[seen.corners.ids]))
        for turn in board.turns
    ]
    if len(turned) == 1:
        return seen
    origins = np.stack([one.corners.pixels[np.argmin(one.corners.ids)] for one in turned])
    if camera.board_origin_px is not None:
        apart = np.linalg.norm(origins - camera.board_origin_px, axis=1)
        return turned[int(np.argmin(apart))]
    misfit = [_misfit_px(camera, lens, board, one, capture) for one in turned]
    best, second = np.sort(misfit)[:2]
    if best < second and second > max(CONTRADICTION_PX, _CLEAR_RATIO * best):
        return turned[int(np.argmin(misfit))]
    places = " or ".join(f"[{u:.0f}, {v:.0f}]" for u, v in origins)
    raise CalibrationError(
        f"camera {camera.name}: {same_after(board)}, and no marks tell which of its corners is the "
        f"origin in {seen.corners.source}: write board_origin_px = {places} for this camera, or "
        "take a board with an odd and an even number of inner corners, or a ChArUco board"
    )


def _misfit_px(
    camera: CameraCapture, lens: Intrinsics, board: Board, seen: DetectedBoard, capture: Capture
) -> float:
    """By how much a camera's marks miss if its board lies so; 0 without marks.

    Infinite if the camera would stand under the floor, or no marks are found.
    """
    start = start_from_board(camera.name, lens, board, seen)
    floor = capture.settings.floor_z_mm
    if floor is not None and start.center[2] < floor:
        return np.inf
    try:
        _, marks, _ = marks_of(camera, lens, start, capture.markers, capture)
    except CalibrationError:
        return np.inf
    return 0.0 if marks is None else mark_rms(start, capture.markers.points, marks)
