"""Board views: which are sharp, and differ from each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, rms_length
from measure.calibration import boards
from measure.calibration.other_boards import OtherBoard, other_board, tag_gap
from measure.errors import CalibrationError

MAX_VIEWS = 40
ALL_VIEWS = 1000
MIN_VIEWS = 5
ALIKE_SHARE = 0.02
"""Views whose corners moved by less than this share of the image diagonal are one view."""
SAME_SHARE = 0.004  # Views that differ by less than this are the same: the second one is left out
_EXPLAINED = 6  # Pictures in which another board than the stated one is looked for
BLURRED_SHARE = 0.5
_COVERAGE_GRID = (8, 6)


@dataclass(frozen=True, eq=False)
class ViewSet:
    """The views a lens is calibrated from."""

    size_wh: tuple[int, int]  # of the images, px
    views: tuple[boards.Corners, ...]
    # why, and by how much, by name of picture; two of one reason are alike.
    left_out: dict[str, tuple[str, str]]
    # how many pictures showed the board mirrored, or its back: they serve the lens, but a camera in
    # mirror mode must not be located.
    mirrored: int = 0

    def coverage(self) -> Floats:
        """Corners in each cell of an 8 x 6 map of the image (rows, columns)."""
        pixels = np.concatenate([view.pixels for view in self.views])
        columns, rows = _COVERAGE_GRID
        counts, _, _ = np.histogram2d(
            pixels[:, 1],
            pixels[:, 0],
            bins=(rows, columns),
            range=((0, self.size_wh[1]), (0, self.size_wh[0])),
        )
        return np.asarray(counts, dtype=np.float64)

    @property
    def covered_share(self) -> float:
        """Share of the map's cells that hold a corner."""
        return float(np.mean(self.coverage() > 0))


class NoBoardError(CalibrationError):
    """Pictures (h, w) in which a board is not found, and what they show instead.

    Attributes:
        other: the board that they show; None if they show none.
    """

    def __init__(self, where: str, board: boards.Board, grays: Sequence[Bytes]) -> None:
        self.other = other_board(board, grays)
        super().__init__(f"{where}; {_to_mend(self.other)}")


def _to_mend(other: OtherBoard | None) -> str:
    if other is None:
        return (
            "check that board.toml describes the printed board (inner corners, not squares) and "
            "that all of it is in view, and sharp"
        )
    return f"{other.text}: {other.remedy}" if other.remedy else other.text


def find_views(
    board: boards.Board, pictures: Iterable[tuple[str, Bytes]], camera: str, limit: int = MAX_VIEWS
) -> ViewSet:
    """Find the board in pictures (name and BGR pixels) of one size, and choose different views."""
    seen: list[boards.Corners] = []
    left_out: dict[str, tuple[str, str]] = {}
    size: tuple[int, int] | None = None
    mirrored = 0
    missed: list[Bytes] = []
    for name, bgr in pictures:
        here = bgr.shape[1], bgr.shape[0]
        if (size := size or here) != here:
            turned = "; was it, or the camera, turned by a quarter? Turn it back, or leave it out"
            text = f"{name} is {here[0]}x{here[1]} px, the others {size[0]}x{size[1]}"
            raise CalibrationError(f"camera {camera}: {text}{turned * (here == size[::-1])}")
        gray = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        try:
            corners = board.find(gray, name)
        except boards.MirroredBoardError as problem:
            corners = problem.corners
            mirrored += 1
        if corners is None:
            left_out[name] = "no board found", ""
            missed = [*missed, gray][-_EXPLAINED:]
        else:
            seen.append(corners)
    if size is None or not seen:
        raise NoBoardError(
            f"camera {camera}: no board found in any of {len(left_out)} pictures", board, missed
        )
    gap = ""
    if isinstance(board, boards.AprilGrid):
        gap = tag_gap(board, [(view.ids, view.pixels) for view in seen])
    if gap:
        raise CalibrationError(f"camera {camera}: {gap}")
    chosen = choose_views(board, seen, size, camera, left_out, limit)
    return replace(chosen, mirrored=mirrored)


def choose_views(
    board: boards.Board,
    seen: list[boards.Corners],
    size_wh: tuple[int, int],
    camera: str,
    left_out: dict[str, tuple[str, str]] | None = None,
    limit: int = MAX_VIEWS,
) -> ViewSet:
    """Keep sharp views that differ, the most different first; CalibrationError if too few do."""
    left_out = dict(left_out or {})
    floor = BLURRED_SHARE * float(np.median([view.sharpness for view in seen]))
    sharp = []
    for view in seen:
        if view.sharpness < floor:
            sharpness = f"sharpness {view.sharpness:.2f}, others {2 * floor:.2f}"
            left_out[view.source] = "blurred", sharpness
        else:
            sharp.append(view)
    different = len(_different(board, sharp, ALIKE_SHARE * float(np.hypot(*size_wh)), limit))
    if different < MIN_VIEWS:
        alike = len(sharp) - different
        raise CalibrationError(
            f"camera {camera}: {different} different sharp views of the board, at least "
            f"{MIN_VIEWS} are needed"
            + (f" ({alike} more are all alike)" if alike else "")
            + "; tilt the board in several directions and move it into all corners of the image"
        )
    chosen = _different(board, sharp, SAME_SHARE * float(np.hypot(*size_wh)), limit)
    if limit >= ALL_VIEWS:
        chosen = list(range(len(sharp)))
    for number, view in enumerate(sharp):
        if number not in chosen:
            left_out[view.source] = "the same as another view", ""
    return ViewSet(size_wh, tuple(sharp[i] for i in sorted(chosen)), left_out)


def _different(
    board: boards.Board, views: list[boards.Corners], least_px: float, limit: int
) -> list[int]:
    """Numbers of views, each as different as can be, and by `least_px`, from those before it."""
    outlines = [outline(board, view) for view in views]
    chosen = [int(np.argmax([len(view.ids) for view in views]))]
    nearest = np.full(len(views), np.inf)
    while len(chosen) < min(limit, len(views)):
        moved = [rms_length(outline - outlines[chosen[-1]]) for outline in outlines]
        nearest = np.minimum(nearest, moved)
        following = int(np.argmax(nearest))
        if nearest[following] < least_px:
            break
        chosen.append(following)
    return chosen


def outline(board: boards.Board, view: boards.Corners) -> Floats:
    """Where the board's four outer corners would appear (4, 2), by the view's homography."""
    flat = board.points[:, :2]
    low, high = flat.min(axis=0), flat.max(axis=0)
    rectangle = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    return boards.mapped(flat[view.ids], view.pixels, rectangle)
