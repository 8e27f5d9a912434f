"""Board and markers of one camera contradict each other: how far, and which usual cause it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from measure.calibration.board_views import board_pose
from measure.calibration.boards import Board, Corners
from measure.calibration.markers import assign
from measure.calibration.observations import BoardObservation, MarkerObservation
from measure.calibration.starts import CONTRADICTION_PX, mark_rms, mm_per_px
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics

CONTRADICTION_MM = 2.0
_UNEXPLAINED = (
    "the camera or the board moved between the two pictures, a picture is mirrored, or the stated "
    "board pose is wrong; take both again"
)
_EXPLAINED_MISFIT_RATIO = 0.25
"""A hypothesis that leaves less than this share of the misfit is named as the cause."""
_MIN_OTHER_MARKS = 3
"""So many marks must agree with the board before another is blamed for disagreeing."""


def check_board_against_marks(
    start: Camera,
    seen: Mapping[str, BoardObservation],
    markers: MarkerField,
    marks: MarkerObservation,
) -> float:
    """How far board and markers disagree in one camera.

    Args:
        start: the camera as located by its board.

    Returns:
        Disagreement in mm at the markers.

    Raises:
        CalibrationError: they contradict each other; the message names the cause if one of the
            usual ones explains it.
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
    seen: Mapping[str, BoardObservation]
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
        mirrored = _mirrored(board, mine, self.start.intrinsics)
        yield self._misfit(mirrored, pose), "its board picture is mirrored"
        half_turned = replace(mine, ids=len(board.points) - 1 - mine.ids)
        text = "the board fits after half a turn: its origin is at the other end"
        yield self._misfit(half_turned, pose), text
        for scale in np.geomspace(0.5, 2.0, 113):
            if abs(scale - 1) > 0.01:
                text = f"it fits squares of about {scale:.2f} times the stated size"
                left = self._misfit(mine, pose, float(scale))
                yield left, f"{text}: check square_mm"
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
    return ", ".join(renamed[:4]) + (", ..." if len(renamed) > 4 else "")
