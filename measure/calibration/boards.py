"""Boards: flat patterns whose corners are known, and how they are found in a picture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, Protocol

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, Ints, rms_length
from measure.errors import CalibrationError

MIN_POINTS = 6  # Places from which a pose is found without knowing any
_LOOK_SIDES_PX = (640, 960)
"""Longer sides of the pictures in which chessboards are looked for. In the first, at a tenth of the
time of all pixels, squares of 15 px of a 720p picture are found; in the second those of 10."""
_PLANE_SHARE, _NEARER = 0.25, 1.15
"""By how much of its side a marker may miss its board's plane; and times as large as another copy's
the markers of a board must be to count as the nearer one."""
_AROUND_SHARE = 0.25  # Border of the part that is searched again, in sizes of what was found there

CornerRule = Literal["pattern", "gradient"]
"""How corners are localised: by the detector's own sub-pixel fit, or by the grey gradient around
each. Which is better depends on noise, sharpening and compression: the data decide."""


@dataclass(frozen=True, eq=False)
class Corners:
    """Board corners seen in one picture."""

    ids: Ints  # (n,) which of the board's points
    pixels: Floats  # (n, 2) sub-pixel places
    # steepest slope across the pattern's edges as a share of their contrast, per px: about 0.5 in
    # focus, below 0.2 blurred.
    sharpness: float
    source: str = ""  # the picture, for messages
    # (n, 2) the same corners by another rule (see `refine_by_gradient`), or None.
    by_gradient: Floats | None = None
    twice: bool = False  # whether a second copy of the board is in view, farther away

    def localised(self, rule: CornerRule) -> Corners:
        """The same view with the corners of one rule."""
        if rule == "pattern" or self.by_gradient is None:
            return self
        return replace(self, pixels=self.by_gradient)

    def only(self, places: Ints) -> Corners:
        """The same view with some of its corners."""
        by_gradient = None if self.by_gradient is None else self.by_gradient[places]
        return replace(
            self, ids=self.ids[places], pixels=self.pixels[places], by_gradient=by_gradient
        )


class MirroredBoardError(CalibrationError):
    """A picture that shows a board only when mirrored: a selfie mode, or the board's back.

    Attributes:
        corners: as they appear in the picture; good for the lens, not for a pose.
    """

    def __init__(self, message: str, corners: Corners) -> None:
        super().__init__(message)
        self.corners = corners


class Board(Protocol):
    """A flat pattern in the plane z = 0 of the board frame, z pointing away from the viewer."""

    @property
    def points(self) -> Floats:
        """All corners (n, 3) in mm."""

    @property
    def turns(self) -> tuple[Ints, ...]:
        """Renumberings (n,) of the corners by turns that leave the pattern as it was.

        The first is none at all. Where there are more a picture cannot tell which corner is which;
        a pattern that carries numbers has no other.
        """
        return (np.arange(len(self.points)),)

    @property
    def title(self) -> str:
        """What it is, for people who hold it."""

    def find(self, gray: Bytes, source: str = "") -> Corners | None:
        """The corners in a grey picture (h, w), or None where there is no board."""

    def look(self, gray: Bytes) -> Corners | None:
        """The same as fast as a waved board asks for; it may miss what `find` takes long for."""
        return self.find(gray)


def in_squares(inner_corners: tuple[int, int]) -> str:
    """The size of a board as it is printed and ordered."""
    return "{}x{} squares".format(*(count + 1 for count in inner_corners))


def same_after(board: Board) -> str:
    """After which turn a board with several of them looks the same."""
    columns, rows = np.ptp(board.points[:, :2], axis=0) / np.abs(np.diff(board.points[:2, 0])) + 2
    name = f"the board of {columns:.0f}x{rows:.0f} squares"
    turn = "half a turn" if len(board.turns) == 2 else "a quarter turn"
    return f"{name} looks the same after {turn}"


MIN_MARKS = 4  # Places that tell how a flat thing lies, and one of them more than a line


def aruco_dictionary(name: str) -> Any:
    """OpenCV's markers of that name, such as "DICT_4X4_100"."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def mapped(flat: Floats, seen: Floats, points: Floats) -> Floats:
    """Where points (m, 2) of a plane appear (m, 2), by the homography of (n, 2) to (n, 2)."""
    H, _ = cv2.findHomography(flat, seen)
    return np.asarray(cv2.perspectiveTransform(points[None], H), dtype=np.float64)[0]


def _grid(inner_corners: tuple[int, int], square_mm: float) -> Floats:
    columns, rows = inner_corners
    y, x = np.mgrid[:rows, :columns]
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * square_mm


@dataclass(frozen=True)
class Chessboard(Board):
    """A chessboard.

    Origin at one outermost inner corner, x along the first count, y along the second. The outer
    square diagonal to the origin is black; the opposite one is white where the two ends differ.
    """

    inner_corners: tuple[int, int]  # along x and along y
    square_mm: float

    @cached_property
    def points(self) -> Floats:
        """All corners (n, 3) in mm."""
        return _grid(self.inner_corners, self.square_mm)

    @property
    def title(self) -> str:
        """What it is, for people who hold it."""
        return f"chessboard of {in_squares(self.inner_corners)}"

    @property
    def turns(self) -> tuple[Ints, ...]:
        """Renumberings (n,) of the corners by turns that leave the pattern as it was."""
        columns, rows = self.inner_corners
        numbers = np.arange(columns * rows).reshape(rows, columns)
        if (columns + rows) % 2:
            return (numbers.ravel(),)
        quarters = range(4) if columns == rows and rows % 2 == 0 else (0, 2)
        return tuple(np.rot90(numbers, quarter).ravel() for quarter in quarters)

    def find(self, gray: Bytes, source: str = "") -> Corners | None:
        """The corners in a grey picture (h, w), or None where there is no board."""
        pixels = self._searched(gray, cv2.CALIB_CB_ACCURACY, self.look(gray))
        if pixels is None:
            flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
            pixels = self._searched(gray, flags)
        if pixels is None:
            return None
        pixels = self._oriented(pixels, gray)
        return _corners(np.arange(len(pixels)), pixels, gray, source)

    def look(self, gray: Bytes) -> Corners | None:
        """The same by small pictures, the corners localised by their gradients in the large one."""
        for side in _LOOK_SIDES_PX:
            share = min(side / max(gray.shape), 1.0)
            size_wh = tuple(round(share * length) for length in gray.shape[::-1])
            small = cv2.resize(gray, size_wh, interpolation=cv2.INTER_AREA) if share < 1 else gray
            pixels = self._searched(np.asarray(small, np.uint8), 0)
            if pixels is not None:
                scale = np.array(gray.shape[::-1]) / size_wh
                start = self._oriented((pixels + 0.5) * scale - 0.5, gray)
                pixels = refine_by_gradient(gray, start)
                return Corners(np.arange(len(pixels)), pixels, sharpness(gray, pixels))
            if share == 1:
                break
        return None

    def _searched(self, gray: Bytes, flags: int, around: Corners | None = None) -> Floats | None:
        """The corners (n, 2) by a search of the picture, first around where they were seen."""
        corner = np.zeros(2)
        part = gray
        if around is not None:
            low, high = around.pixels.min(axis=0), around.pixels.max(axis=0)
            border = _AROUND_SHARE * float(np.max(high - low))
            corner = np.maximum(low - border, 0).astype(int)
            u, v = (high + border).astype(int) + 1
            part = np.ascontiguousarray(gray[corner[1] : v, corner[0] : u])
        cv2.setRNGSeed(0)  # The search draws: it must not depend on what was drawn before
        found, raw = cv2.findChessboardCornersSB(part, self.inner_corners, flags=flags)
        if found:
            return np.asarray(raw, dtype=np.float64).reshape(-1, 2) + corner
        return None if around is None else self._searched(gray, flags)

    def _oriented(self, pixels: Floats, gray: Bytes) -> Floats:
        columns, rows = self.inner_corners
        grid = pixels.reshape(rows, columns, 2)
        along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
        if along[0] * down[1] - along[1] * down[0] < 0:  # x to the right, y down: never mirrored
            grid = grid[:, ::-1]
        quarters = range(4) if columns == rows else (0, 2)
        if len(self.turns) < len(quarters):
            turned = [np.rot90(grid, quarter) for quarter in quarters]
            grid = min(turned, key=lambda corners: _outer_level(corners, gray))
        return np.ascontiguousarray(grid.reshape(-1, 2))


def _outer_level(grid: Floats, gray: Bytes) -> float:
    """Mean grey of the outer square diagonal to the first corner of a grid (rows, columns, 2)."""
    first = grid[0, 0]
    centre = first - (grid[0, 1] - first) / 2 - (grid[1, 0] - first) / 2
    patch = cv2.getRectSubPix(gray, (5, 5), (float(centre[0]), float(centre[1])))
    return float(np.mean(patch))


@dataclass(frozen=True)
class Charuco(Board):
    """A chessboard with ArUco markers in its white squares: partial views count, ends are known."""

    inner_corners: tuple[int, int]  # along x and along y
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_4X4_100"  # OpenCV's name, such as "DICT_4X4_1000"
    inverted: bool = False  # printed white on black
    # OpenCV's pattern before 4.6 (differs for an even number of rows of squares).
    legacy: bool = False
    first_marker: int = 0  # number of the marker at the upper left; the others follow

    @property
    def title(self) -> str:
        """What it is, for people who hold it."""
        return f"ChArUco board of {in_squares(self.inner_corners)}"

    @property
    def squares(self) -> tuple[int, int]:
        """Squares along x and along y."""
        return self.inner_corners[0] + 1, self.inner_corners[1] + 1

    @cached_property
    def pattern(self) -> Any:
        """OpenCV's description of this board."""
        markers = aruco_dictionary(self.dictionary)
        side_mm, marker_mm = float(self.square_mm), float(self.marker_mm)
        numbers = self.first_marker + np.arange(self.squares[0] * self.squares[1] // 2)
        pattern = cv2.aruco.CharucoBoard(self.squares, side_mm, marker_mm, markers, numbers)
        pattern.setLegacyPattern(self.legacy)
        return pattern

    @cached_property
    def points(self) -> Floats:
        """All corners (n, 3) in mm, in the order of OpenCV's corner numbers."""
        return np.asarray(self.pattern.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)

    def find(self, gray: Bytes, source: str = "") -> Corners | None:
        """The corners in a grey picture (h, w), or None where there is no board."""
        corners = self._find(gray, source)
        if corners is not None:
            return corners
        mirrored = self._find(np.ascontiguousarray(gray[:, ::-1]), source)
        if mirrored is None:
            return None
        pixels = mirrored.pixels * [-1, 1] + [gray.shape[1] - 1, 0]
        raise MirroredBoardError(
            f"{source or 'picture'}: the ChArUco board decodes only in a mirror: switch off the "
            "camera's mirror (selfie) mode, or show the board's front",
            replace(mirrored, pixels=pixels, by_gradient=None),
        )

    def _find(self, gray: Bytes, source: str) -> Corners | None:
        picture = np.asarray(255 - gray if self.inverted else gray, dtype=np.uint8)
        detector = cv2.aruco.ArucoDetector(aruco_dictionary(self.dictionary))
        sides, found, _ = detector.detectMarkers(picture)
        if not len(sides):
            return None
        own = self._nearest_copy(np.ravel(found), np.reshape(sides, (-1, 4, 2)))
        search = cv2.aruco.CharucoDetector(self.pattern, cv2.aruco.CharucoParameters())
        pixels, ids, _, _ = search.detectBoard(
            picture,
            markerCorners=[sides[i] for i in own],
            markerIds=np.reshape(found, (-1, 1))[own],
        )
        if ids is None or np.size(ids) < MIN_POINTS:
            return None
        numbers = np.asarray(ids, dtype=np.int64).reshape(-1)
        if np.any(np.ptp(self.points[numbers, :2], axis=0) == 0):  # one row tells no pose
            return None
        places = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        corners = _corners(numbers, places, picture, source)
        return replace(corners, twice=len(own) < len(found))

    def _nearest_copy(self, numbers: Ints, corners: Floats) -> Ints:
        """Which markers (k,) with their corners (k, 4, 2) are of one board, the nearest of several.

        All of them if none is seen twice; none of them if two copies are about equally large.
        """
        every = np.arange(len(numbers))
        if len(np.unique(numbers)) == len(numbers):
            return every
        flat = {
            int(n): np.asarray(place, dtype=np.float64)[:, :2]
            for n, place in zip(self.pattern.getIds(), self.pattern.getObjPoints(), strict=True)
        }
        rest = np.array([i for i in every if int(numbers[i]) in flat], dtype=np.int64)
        copies: list[tuple[float, Ints]] = []
        while len(rest) >= MIN_MARKS:
            sides_px = np.linalg.norm(corners[rest, 0] - corners[rest, 1], axis=1)
            places = np.concatenate([flat[int(numbers[i])] for i in rest])
            reach_px = _PLANE_SHARE * float(np.median(sides_px))
            _, fits = cv2.findHomography(places, corners[rest].reshape(-1, 2), cv2.RANSAC, reach_px)
            one = np.zeros(len(rest), bool) if fits is None else np.all(fits.reshape(-1, 4), axis=1)
            if np.count_nonzero(one) < MIN_MARKS:
                break
            copies.append((float(np.median(sides_px[one])), rest[one]))
            rest = rest[~one]
        copies.sort(key=lambda copy: -copy[0])
        if not copies or (len(copies) > 1 and copies[0][0] < _NEARER * copies[1][0]):
            return every[:0]
        return copies[0][1]


def _corners(ids: Ints, pixels: Floats, gray: Bytes, source: str) -> Corners:
    refined = refine_by_gradient(gray, pixels)
    return Corners(ids, pixels, sharpness(gray, pixels), source, refined)


def spacing_px(pixels: Floats) -> float:
    """The least distance of two corners (n, 2)."""
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    return float(np.min(apart + np.diag(np.full(len(pixels), np.inf))))


def refine_by_gradient(gray: Bytes, pixels: Floats) -> Floats:
    """Corners (n, 2) where the grey gradients around each are perpendicular to the way there.

    Förstner 1987, in OpenCV's `cornerSubPix`; the window reaches a third of the way to the nearest
    other corner.
    """
    half = int(np.clip(spacing_px(pixels) / 3, 3, 15))
    start = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float32)
    refined = cv2.cornerSubPix(gray, start, (half, half), (-1, -1), (3, 50, 1e-3))
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def sharpness(gray: Bytes, pixels: Floats) -> float:
    """Median over corners (n, 2) of the steepest slope as a share of the local contrast, per px."""
    slopes, half = [], 6
    for u, v in np.rint(pixels).astype(int):
        patch = gray[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
        if min(patch.shape) < half:
            continue
        values = patch.astype(np.float64)
        low, high = np.quantile(values, (0.1, 0.9))
        gx, gy = np.gradient(values)
        slopes.append(np.quantile(np.hypot(gx, gy), 0.98) / max(high - low, 1.0))
    return float(np.median(slopes)) if slopes else 0.0


DICTIONARY = "DICT_APRILTAG_36h11"
BORDER_BITS = 2  # Width of the tags' black border in cells, as Kalibr prints them; others print one
_CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
"""Of a tag, in its sides: in this order half a turn of the board reverses all numbers."""
_AROUND = np.array([0, 1, 3, 2])  # The same in the order of OpenCV's markers: clockwise


@dataclass(frozen=True)
class AprilGrid(Board):
    """A grid of tags of the family 36h11, number 0 at the bottom left, counted along the rows.

    Origin at the outer corner of the tag at the top left, x to the right, y down.
    """

    tags: tuple[int, int]  # along x and along y
    tag_mm: float  # side of a tag, with its black border
    tag_spacing: float  # gap between tags, in sides of a tag

    @property
    def title(self) -> str:
        """What it is, for people who hold it."""
        return "AprilGrid of {}x{} tags".format(*self.tags)

    @cached_property
    def points(self) -> Floats:
        """All corners (n, 3) in mm, four a tag, in the order of the tags."""
        columns, rows = self.tags
        row, column = np.divmod(np.arange(columns * rows), columns)
        first = np.column_stack([column, rows - 1 - row]) * (1 + self.tag_spacing)
        flat = (first[:, None] + _CORNERS).reshape(-1, 2) * self.tag_mm
        return np.column_stack([flat, np.zeros(len(flat))])

    def find(self, gray: Bytes, source: str = "") -> Corners | None:
        """The corners in a grey picture (h, w), or None where there are fewer than four tags."""
        for border in (BORDER_BITS, 1):
            tags, pixels = self._detected(gray, border)
            if len(tags) >= MIN_MARKS:
                break
        else:
            return None
        # Printers turn the tags in different ways; their numbers tell which way round the grid is.
        ids, _ = min(
            (self._numbered(tags, pixels, turn) for turn in range(4)), key=lambda found: found[1]
        )
        corners = refine_by_gradient(gray, pixels.reshape(-1, 2))
        return Corners(ids, corners, sharpness(gray, corners), source)

    def _detected(self, gray: Bytes, border: int) -> tuple[Ints, Floats]:
        """Numbers (k,) of tags and their corners (k, 4, 2), clockwise."""
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        detector = cv2.aruco.ArucoDetector(aruco_dictionary(DICTIONARY), parameters)
        found, ids, _ = detector.detectMarkers(gray)
        tags = np.array([] if ids is None else ids, dtype=np.int64).reshape(-1)
        pixels = np.array(found, dtype=np.float64).reshape(-1, 4, 2)
        mine = tags < self.tags[0] * self.tags[1]
        return tags[mine], pixels[mine]

    def _numbered(self, tags: Ints, pixels: Floats, turn: int) -> tuple[Ints, float]:
        """Numbers (4k,) of the corners if each tag is turned so, and how badly a plane fits."""
        ids = (4 * tags[:, None] + np.roll(_AROUND, turn)).reshape(-1)
        seen = pixels.reshape(-1, 2)
        flat = self.points[ids, :2]
        return ids, rms_length(mapped(flat, seen, flat) - seen)


@dataclass(frozen=True)
class Stretched(Board):
    """A board whose squares are longer along one side: printers stretch paper one way."""

    drawn: Board
    by_xy: tuple[float, float]  # how many times as long they are along x and along y

    @cached_property
    def points(self) -> Floats:
        """All corners (n, 3) in mm."""
        return self.drawn.points * [*self.by_xy, 1.0]

    @property
    def turns(self) -> tuple[Ints, ...]:
        """Those of the board that was drawn."""
        return self.drawn.turns

    @property
    def title(self) -> str:
        """What it is, for people who hold it."""
        return self.drawn.title

    def find(self, gray: Bytes, source: str = "") -> Corners | None:
        """The corners in a grey picture (h, w), or None where there is no board."""
        return self.drawn.find(gray, source)

    def look(self, gray: Bytes) -> Corners | None:
        """The same as quickly as can be."""
        return self.drawn.look(gray)
