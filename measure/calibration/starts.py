"""Rough camera poses, from a board or from markers alone; and what it means if these disagree."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats, rms_length
from measure.calibration.board_views import board_pose, unmirrored
from measure.calibration.boards import MIN_POINTS, Board, Corners, same_after
from measure.calibration.capture import Capture, CaptureCamera
from measure.calibration.extrinsics import located_by_marks
from measure.calibration.intrinsics import fit_pose_only
from measure.calibration.markers import FoundMarkers, assign, find_markers
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.limits import CLEAR_RATIO
from measure.model import BoardObservation, Camera, Intrinsics, MarkerObservation
from measure.model.body import MIN_BREADTH_RATIO
from measure.reading import listed
from measure.session import read_picture

_MAX_BOARD_RMS_PX = 3.0
CONTRADICTION_PX = 8.0
_NO_POSE = (
    "camera {name}: no camera pose explains its marks: are marker names mixed up, or is the "
    "picture mirrored?"
)


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """A board of known pose in a picture of one camera."""

    board: Board
    corners: Corners  # those that are seen
    world_from_board: RigidTransform

    @property
    def observation(self) -> BoardObservation:
        """What a fit needs of it."""
        points = self.board.points[self.corners.ids]
        return BoardObservation(points, self.corners.pixels, self.world_from_board)


def start_from_board(name: str, lens: Intrinsics, seen: SeenBoard) -> Camera:
    """The camera as located by its board; CalibrationError if the corners do not fit it."""
    rms = fit_pose_only(lens, seen.board.points, seen.corners).rms_px
    if rms > _MAX_BOARD_RMS_PX:
        raise CalibrationError(
            f"camera {name}: in {seen.corners.source} the board's corners miss by {rms:.1f} "
            "px under this camera's lens: is it this camera's picture, at the same zoom and focus?"
        )
    camera_from_board = board_pose(lens, seen.observation.points, seen.corners.pixels)
    return Camera(name, lens, seen.world_from_board @ camera_from_board.inverse())


def start_from_marks(
    name: str, lens: Intrinsics, markers: MarkerField, marks: MarkerObservation
) -> Camera:
    """The camera as located by its marks, see `check_located`; CalibrationError if no pose fits."""
    points = markers.points[marks.ids]
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


def check_located(capture: Capture) -> None:
    """Refuse (CalibrationError) what cannot locate its cameras, before lenses take minutes.

    A camera needs a board of known pose, or six marks that do not lie in one plane; and its
    pictures must be there.
    """
    for camera in capture.cameras:
        for picture in filter(None, (camera.board_image, camera.marker_image)):
            read_picture(capture.path.parent / picture)
        marks = marker_observation(capture.marks.get(camera.name, {}), capture.markers)
        if camera.board_image is None and marks is None:
            raise CalibrationError(
                f"camera {camera.name}: nothing tells where it stands: give board_image with the "
                f"board's pose, or mark at least six markers in marks.csv ({capture.path})"
            )
        if camera.board_image is None and marks is not None:
            _check_spread(camera.name, capture.markers.points[marks.ids])


def _check_spread(name: str, points: Floats) -> None:
    if len(points) < MIN_POINTS:
        raise CalibrationError(
            f"camera {name}: without a board at least {MIN_POINTS} markers are needed, "
            f"{len(points)} are marked"
        )
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extent[2] < MIN_BREADTH_RATIO * extent[0]:
        raise CalibrationError(
            f"camera {name}: without a board the markers must not lie in one plane (extents "
            f"{extent[0]:.0f}, {extent[1]:.0f}, {extent[2]:.1f} mm)"
        )


def oriented_board(
    camera: CaptureCamera, lens: Intrinsics, seen: SeenBoard, capture: Capture
) -> SeenBoard:
    """The board with its corners numbered as they are; CalibrationError if nothing tells how.

    Of the turns after which the board looks the same it is the one whose origin the capture says is
    near `board_origin_px`; or else the one that puts the camera where its marks agree, and above
    the floor.
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
    if best < second and second > max(CONTRADICTION_PX, CLEAR_RATIO * best):
        return turned[int(np.argmin(misfit))]
    places = " or ".join(f"[{u:.0f}, {v:.0f}]" for u, v in origins)
    raise CalibrationError(
        f"camera {camera.name}: {same_after(seen.board)}, and no marks tell which of its corners "
        f"is the origin in {seen.corners.source}: write board_origin_px = {places} for this "
        "camera, or take a board with an odd and an even number of squares, or a "
        "ChArUco board"
    )


def _misfit_px(camera: CaptureCamera, lens: Intrinsics, seen: SeenBoard, capture: Capture) -> float:
    """By how much marks miss if the board lies so; infinite under the floor or without finds."""
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
    camera: CaptureCamera, lens: Intrinsics, start: Camera | None, capture: Capture
) -> tuple[Camera, MarkerObservation | None, FoundMarkers | None]:
    """The rough camera, its marks by hand and by search (the hand wins), and the search's finds."""
    markers = capture.markers
    own = capture.marks.get(camera.name, {})
    by_hand = marker_observation(own, markers)
    if start is None:
        assert by_hand is not None  # see `check_located`
        start = start_from_marks(camera.name, lens, markers, by_hand)
    if camera.marker_image is None or not markers.names:
        return start, by_hand, None
    visible = lens.contains(start.project(markers.points), 5.0)
    names = [name for name, seen in zip(markers.names, visible, strict=True) if seen]
    if all(name in own for name in names):
        return start, by_hand, None
    picture = capture.still(camera, camera.marker_image, lens)
    try:
        finds = find_markers(picture, start, markers, capture.settings.marker_kind)
    except CalibrationError:
        if by_hand is None:
            raise
        return start, by_hand, None
    observed = marker_observation({**finds.marks, **own}, markers)
    if observed is not None and 2 * len(own) < len(observed.ids):
        observed = replace(observed, searched=True)
    return start, observed, finds


def marker_observation(marks: dict[str, Floats], markers: MarkerField) -> MarkerObservation | None:
    """Marks by name as an observation; None if there are none."""
    if not marks:
        return None
    names = [name for name in markers.names if name in marks]
    ids = np.array([markers.index(name) for name in names], dtype=np.int64)
    return MarkerObservation(ids, np.stack([marks[name] for name in names]))


CONTRADICTION_MM = 2.0
_UNEXPLAINED = (
    "the camera or the board moved between the two pictures, a picture is mirrored, or the stated "
    "board pose is wrong; take both again"
)
_EXPLAINED_MISFIT_RATIO = 0.25
"""A hypothesis that leaves less than this share of the misfit is named as the cause."""
_UNITS_MM = {"metres": 1000.0, "centimetres": 10.0, "inches": 25.4}
_MIN_OTHER_MARKS = 3
"""So many marks must agree with the board before another is blamed for disagreeing."""


def check_board_against_marks(
    start: Camera, seen: Mapping[str, SeenBoard], markers: MarkerField, marks: MarkerObservation
) -> float:
    """How far, in mm at the markers, they disagree with the board by which a camera was located.

    CalibrationError if they contradict each other; the message names the cause if one of the usual
    ones explains it.
    """
    rms = mark_rms(start, markers.points, marks)
    worth = mm_per_px(start, markers.points[marks.ids])
    if not (rms > CONTRADICTION_PX and rms * worth > CONTRADICTION_MM):
        return rms * worth
    cause = _Contradiction(start, seen, markers, marks).cause(rms)
    shown = f"{rms * worth:.1f} mm ({rms:.0f} px)" if np.isfinite(rms) else "beyond measure"
    raise CalibrationError(f"camera {start.name}: board and markers disagree by {shown}: {cause}")


@dataclass(frozen=True, eq=False)
class _Contradiction:
    """One camera whose board and markers contradict each other, and what the others saw."""

    start: Camera
    seen: Mapping[str, SeenBoard]
    markers: MarkerField
    marks: MarkerObservation

    def cause(self, rms: float) -> str:
        left, text = min(self._causes())
        if left < CONTRADICTION_PX and left < _EXPLAINED_MISFIT_RATIO * rms:
            return text
        permuted = _permuted(self.start, self.markers, self.marks)
        return f"marker names are mixed up: {permuted}" if permuted else _UNEXPLAINED

    def _causes(self) -> Iterator[tuple[float, str]]:
        """What each usual cause would leave of the misfit, in px, and its name."""
        name, own = self.start.name, self.seen[self.start.name]
        board, mine, pose = own.board, own.corners, own.world_from_board
        for other, theirs in self.seen.items():
            if other == name:
                continue
            text = f"its board stands where the capture puts that of {other}: are the two swapped?"
            yield self._misfit(mine, theirs.world_from_board), text
            text = f"the board picture of {other} fits instead: are the two swapped?"
            yield self._misfit(theirs.corners, pose), text
        mirrored = unmirrored(board, mine, self.start.intrinsics)
        yield self._misfit(mirrored, pose), "its board picture is mirrored"
        over = np.array(self.start.intrinsics.size_wh) - 1 - mine.pixels
        yield self._misfit(replace(mine, pixels=over), pose), "its board picture is upside down"
        half_turned = replace(mine, ids=len(board.points) - 1 - mine.ids)
        text = "the board fits after half a turn: its origin is at the other end"
        yield self._misfit(half_turned, pose), text
        for scale in np.geomspace(0.5, 2.0, 113):
            if abs(scale - 1) > 0.01:
                text = f"it fits squares of about {scale:.2f} times the stated size"
                left = self._misfit(mine, pose, float(scale))
                yield left, f"{text}: check square_mm"
        zoom, left = zoomed(self.start, own.observation, self.markers, self.marks)
        yield left, f"{ZOOMED.format(zoom=zoom)}: {ZOOMED_CURE}"
        for unit, in_mm in _UNITS_MM.items():
            text = f"the markers' places are in {unit} (with mm they fit): write mm"
            yield mark_rms(self.start, in_mm * self.markers.points, self.marks), text
        for k, marker in enumerate(self.marks.ids):
            text = f"only {self.markers.names[marker]} does: its place or its mark is wrong"
            ids, pixels = np.delete(self.marks.ids, k), np.delete(self.marks.pixels, k, 0)
            others = replace(self.marks, ids=ids, pixels=pixels)
            if len(ids) >= _MIN_OTHER_MARKS:
                yield mark_rms(self.start, self.markers.points, others), text

    def _misfit(
        self, corners: Corners, world_from_board: RigidTransform, scale: float = 1.0
    ) -> float:
        """RMS px of the camera's marks if the board were seen, stood and measured so."""
        points = self.seen[self.start.name].board.points[corners.ids] * scale
        pose = board_pose(self.start.intrinsics, points, corners.pixels)
        camera = replace(self.start, world_from_camera=world_from_board @ pose.inverse())
        return mark_rms(camera, self.markers.points, self.marks)


ZOOMED = "board and marks fit pictures {zoom:.3f} times as large as the lens was calibrated with"
ZOOMED_CURE = (
    "zoom, focus or crop changed in between; take lens and pose pictures anew with the same, "
    "auto-focus off"
)
_ZOOMS = np.geomspace(0.6, 1.6, 197)


def zoomed(
    start: Camera, seen: BoardObservation, markers: MarkerField, marks: MarkerObservation
) -> tuple[float, float]:
    """How much larger pictures of board and markers make both agree best; and px RMS left then."""
    lens, middle = start.intrinsics, (np.array(start.intrinsics.size_wh) - 1) / 2

    def left(zoom: float) -> float:
        corners, own = (middle + (p - middle) / zoom for p in (seen.pixels, marks.pixels))
        camera_from_board = board_pose(lens, seen.points, corners)
        pose = seen.world_from_board @ camera_from_board.inverse()
        camera = replace(start, world_from_camera=pose)
        return mark_rms(camera, markers.points, replace(marks, pixels=own))

    return min(((float(zoom), left(float(zoom))) for zoom in _ZOOMS), key=lambda one: one[1])


def _permuted(start: Camera, markers: MarkerField, marks: MarkerObservation) -> str:
    """Which marks sit where another marker should be, if renaming makes them all fit."""
    ids, numbers = assign(start.project(markers.points), marks.pixels, 3 * CONTRADICTION_PX)
    if len(ids) < 0.8 * len(marks.ids):
        return ""
    renamed = [
        f"{markers.names[marks.ids[n]]} sits at the place of {markers.names[i]}"
        for i, n in zip(ids, numbers, strict=True)
        if marks.ids[n] != i
    ]
    return listed(renamed)
