"""Rough camera poses: from a board of known pose, or from markers alone; and its marks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.arrays import Floats, rms_length
from measure.calibration.board_views import board_pose
from measure.calibration.boards import same_after
from measure.calibration.capture import CameraCapture, Capture
from measure.calibration.extrinsics import located_by_marks
from measure.calibration.intrinsics import fit_pose_only
from measure.calibration.markers import FoundMarkers, find_markers
from measure.calibration.observations import BoardObservation, MarkerObservation
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.model import Camera, Intrinsics

_MIN_MARKS_ALONE = 6
_FLAT_RATIO = 0.02
_MAX_BOARD_RMS_PX = 3.0
CONTRADICTION_PX = 8.0
_NO_POSE = (
    "camera {name}: no camera pose explains its marks: are marker names mixed up, or is the "
    "picture mirrored?"
)


def start_from_board(name: str, lens: Intrinsics, seen: BoardObservation) -> Camera:
    """The camera as located by its board; CalibrationError if the corners do not fit it."""
    rms = fit_pose_only(lens, seen.board.points, seen.corners).rms_px
    if rms > _MAX_BOARD_RMS_PX:
        raise CalibrationError(
            f"camera {name}: in {seen.corners.source} the board's corners miss by {rms:.1f} "
            "px under this camera's lens: is it this camera's picture, at the same zoom and focus?"
        )
    camera_from_board = board_pose(lens, seen.points, seen.corners.pixels)
    return Camera(name, lens, seen.world_from_board @ camera_from_board.inverse())


def start_from_marks(
    name: str, lens: Intrinsics, markers: MarkerField, marks: MarkerObservation
) -> Camera:
    """The camera as located by its marks; CalibrationError: under six, in a plane, or no pose."""
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


def mm_per_px(camera: Camera, points: Floats) -> float:
    """What a pixel is worth at points (n, 3): their median distance over the focal length."""
    distance = float(np.median(np.linalg.norm(points - camera.center, axis=1)))
    return distance / camera.intrinsics.focal_px


_CLEAR_RATIO = 3.0  # How much worse the marks must fit any other turn


def oriented_board(
    camera: CameraCapture, lens: Intrinsics, seen: BoardObservation, capture: Capture
) -> BoardObservation:
    """The board with its corners numbered as they are.

    Of the turns after which the board looks the same it is the one whose origin the capture says
    is near `board_origin_px`; or else the one that puts the camera where its marks agree, and
    above the floor.

    Raises:
        CalibrationError: nothing tells which.
    """
    turned = [
        replace(seen, corners=replace(seen.corners, ids=turn[seen.corners.ids]))
        for turn in seen.board.turns
    ]
    if len(turned) == 1:
        return seen
    origins = np.stack([one.corners.pixels[np.argmin(one.corners.ids)] for one in turned])
    if camera.board_origin_px is not None:
        apart = np.linalg.norm(origins - camera.board_origin_px, axis=1)
        return turned[int(np.argmin(apart))]
    misfit = [_misfit_px(camera, lens, one, capture) for one in turned]
    best, second = np.sort(misfit)[:2]
    if best < second and second > max(CONTRADICTION_PX, _CLEAR_RATIO * best):
        return turned[int(np.argmin(misfit))]
    places = " or ".join(f"[{u:.0f}, {v:.0f}]" for u, v in origins)
    raise CalibrationError(
        f"camera {camera.name}: {same_after(seen.board)}, and no marks tell which of its corners "
        f"is the origin in {seen.corners.source}: write board_origin_px = {places} for this "
        "camera, or take a board with an odd and an even number of inner corners, or a "
        "ChArUco board"
    )


def _misfit_px(
    camera: CameraCapture, lens: Intrinsics, seen: BoardObservation, capture: Capture
) -> float:
    """By how much a camera's marks miss if its board lies so; 0 without marks.

    Infinite if the camera would stand under the floor, or no marks are found.
    """
    start = start_from_board(camera.name, lens, seen)
    floor = capture.settings.floor_z_mm
    if floor is not None and start.center[2] < floor:
        return np.inf
    try:
        _, marks, _ = marks_of(camera, lens, start, capture)
    except CalibrationError:
        return np.inf
    return 0.0 if marks is None else mark_rms(start, capture.markers.points, marks)


def marks_of(
    camera: CameraCapture, lens: Intrinsics, start: Camera | None, capture: Capture
) -> tuple[Camera, MarkerObservation | None, FoundMarkers | None]:
    """The rough camera, its marks by hand and by search (the hand wins), and the search's finds.

    Raises:
        CalibrationError: neither board nor marks locate the camera, or too few markers
            are found and none is marked.
        SessionError: a picture that cannot be read.
    """
    markers = capture.markers
    by_hand = marker_observation(camera.marks, markers)
    if start is None:
        if by_hand is None:
            raise CalibrationError(
                f"camera {camera.name}: nothing tells where it stands: give board_image with the "
                f"board's pose, or mark at least six markers in marks.csv ({capture.path})"
            )
        start = start_from_marks(camera.name, lens, markers, by_hand)
    if camera.marker_image is None or not markers.names:
        return start, by_hand, None
    visible = lens.contains(start.project(markers.points), 5.0)
    names = [name for name, seen in zip(markers.names, visible, strict=True) if seen]
    if all(name in camera.marks for name in names):
        return start, by_hand, None
    picture = camera.still(camera.marker_image, lens)
    try:
        finds = find_markers(picture, start, markers, capture.settings.marker_kind)
    except CalibrationError:
        if by_hand is None:
            raise
        return start, by_hand, None
    observed = marker_observation({**finds.marks, **camera.marks}, markers)
    if observed is not None and 2 * len(camera.marks) < len(observed.ids):
        observed = replace(observed, searched=True)
    return start, observed, finds


def marker_observation(marks: dict[str, Floats], markers: MarkerField) -> MarkerObservation | None:
    """Marks by name as an observation; None if there are none."""
    if not marks:
        return None
    names = [name for name in markers.names if name in marks]
    ids = np.array([markers.index(name) for name in names], dtype=np.int64)
    return MarkerObservation(ids, np.stack([marks[name] for name in names]))
