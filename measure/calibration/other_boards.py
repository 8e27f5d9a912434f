"""Which board pictures show where it is not the chosen one, and what its file must say instead.

Markers carry numbers, and so tell the dictionary. Their places tell the layout: the middles of a
board's markers lie on a square grid, which a homography takes to the picture.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, Ints, rms_length
from measure.calibration.boards import (
    MIN_MARKS,
    AprilGrid,
    Board,
    Charuco,
    Chessboard,
    MirroredBoardError,
    Stretched,
    aruco_dictionary,
    mapped,
)

_FAMILIES = (
    *("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL"),
    *("DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10", "DICT_APRILTAG_36h11"),
    "DICT_ARUCO_MIP_36h12",
)
"""The largest dictionary of each family: the smaller ones are its first markers."""
_SMALLER = (50, 100, 250)
_MOST_SQUARES = 20  # Along a side of a board that is held
_FEWEST_PLACED = 6  # Markers of a picture that tell a grid: four fit any
_STRAY = 10  # A gap in the numbers that no hidden part of a board makes
_OFF_GRID = 0.1  # Share of a grid's step by which a lens, at most, displaces markers
_SEARCH_SIDE_PX = 640
_LARGE, _SMALL = (5, 4), (3, 3)
"""Least numbers of inner corners with which a chessboard of unknown size is looked for."""
_ORDINARY_SQUARE_MM = 25.0
_GAP_OFF = 0.05  # Relative difference of gaps between tags that no print has


@dataclass(frozen=True)
class OtherBoard:
    """A board in pictures that is not the chosen one."""

    seen: str  # what is seen, and what was chosen: "9x6 squares seen, 10x7 chosen"
    remedy: str = ""  # what the chosen board's file must say to be it
    board: Charuco | Chessboard | None = None  # the seen one, its squares as large as the chosen's

    @property
    def text(self) -> str:
        """For people who hold it."""
        return f"this is another board: {self.seen}"


def other_board(board: Board, grays: Sequence[Bytes]) -> OtherBoard | None:
    """The board in pictures (h, w) without the chosen one; None where there is none.

    It takes a second or two: ask when a board has not been found for a while.
    """
    chosen = board.drawn if isinstance(board, Stretched) else board
    inverted = isinstance(chosen, Charuco) and chosen.inverted
    own: Sequence[str] = _FAMILIES
    if isinstance(chosen, Charuco):
        own = tuple(name for name in _FAMILIES if _is_of(chosen.dictionary, name))
    seen = [] if isinstance(chosen, Chessboard) else _families_seen(grays, own, inverted)
    # Squares of a chessboard make a search for all markers long, and ChArUco boards small ones.
    if not seen and (plain := _other_chessboard(chosen, grays, _LARGE)):
        return plain
    for other in () if seen else (inverted, not inverted):
        seen = seen or _families_seen(grays, _FAMILIES, other)
    if not seen:
        return _other_chessboard(chosen, grays, _SMALL)
    best = max(seen, key=lambda one: one.total)
    return _other_charuco(chosen, best, grays)


class _Markers(NamedTuple):
    """Markers of a family in pictures."""

    family: str
    inverted: bool
    pictures: list[tuple[Ints, Floats]]  # numbers (k,) and corners (k, 4, 2) px

    @property
    def total(self) -> int:
        """How many are seen."""
        return sum(len(numbers) for numbers, _ in self.pictures)

    @property
    def numbers(self) -> Ints:
        """Those that are seen, in order."""
        return np.unique(np.concatenate([numbers for numbers, _ in self.pictures]))

    @property
    def dictionary(self) -> str:
        """The smallest of the family with all numbers."""
        highest = int(self.numbers[-1])
        sizes = (size for size in _SMALLER if self.family.endswith("_1000") and size > highest)
        return self.family.replace("1000", str(next(sizes, 1000)))


def _is_of(dictionary: str, family: str) -> bool:
    return dictionary.startswith(family.removesuffix("1000"))


def _families_seen(
    grays: Sequence[Bytes], families: Sequence[str], inverted: bool
) -> list[_Markers]:
    """The markers of each family that shows enough of them."""
    detector = cv2.aruco.ArucoDetector([*map(aruco_dictionary, families)])
    found = [_Markers(name, inverted, []) for name in families]
    for gray in grays:
        shown = np.asarray(255 - gray if inverted else gray, np.uint8)
        corners, numbers, _, kinds = detector.detectMarkersMultiDict(shown)
        if not len(corners):
            continue
        sides = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
        for kind in np.unique(kinds):
            mine = np.ravel(kinds) == kind
            found[int(kind)].pictures.append((np.ravel(numbers)[mine].astype(int), sides[mine]))
    enough = [one for one in found if one.total >= MIN_MARKS]
    return [one for one in map(_without_strays, enough) if one.total >= MIN_MARKS]


def _without_strays(seen: _Markers) -> _Markers:
    """Without what a search sometimes mistakes for markers: numbers far from all others."""
    numbers = seen.numbers
    heaps = np.split(numbers, np.flatnonzero(np.diff(numbers) > _STRAY) + 1)
    heap = max(heaps, key=len)
    kept = [(n, at, np.isin(n, heap)) for n, at in seen.pictures]
    return seen._replace(pictures=[(n[own], at[own]) for n, at, own in kept])


def _misfit(pictures: Sequence[tuple[Ints, Floats]], places: Floats, first: int) -> float:
    """How far (RMS) markers lie from a grid's places (n, 2), in steps of it; inf if by nothing."""
    off = []
    for numbers, corners in pictures:
        known = (numbers >= first) & (numbers - first < len(places))
        flat = places[numbers[known] - first]
        if not known.all() or len(flat) < _FEWEST_PLACED or not np.ptp(flat, axis=0).all():
            continue
        off.append(rms_length(mapped(corners.mean(axis=1), flat, corners.mean(axis=1)) - flat))
    return float(np.median(off)) if off else np.inf


def _charuco_places(columns: int, legacy: bool) -> Floats:
    """Column and row of the white squares (n, 2) of a board with so many columns."""
    every = np.array([(x, y) for y in range(2 * _MOST_SQUARES) for x in range(columns)])
    return every[every.sum(axis=1) % 2 == (0 if legacy else 1)].astype(np.float64)


def _other_charuco(chosen: Board, seen: _Markers, grays: Sequence[Bytes]) -> OtherBoard:
    """A ChArUco board of markers that are seen; in words what they are if they are of none."""
    numbers, dictionary = seen.numbers, seen.dictionary
    if isinstance(chosen, Charuco) and _is_of(chosen.dictionary, seen.family):
        dictionary = chosen.dictionary
    if _twice(seen):
        return OtherBoard("its markers are seen twice: take one of the two boards out of view")
    found = _charuco_of(seen, chosen)
    if found is None:
        return OtherBoard(
            f"{seen.total} markers of {dictionary} are seen, with numbers from {numbers[0]} to "
            f"{numbers[-1]}, but no {chosen.title}: count again"
        )
    (columns, rows), legacy, first = found
    side_mm = _side_mm(chosen)
    plain = chosen if isinstance(chosen, Charuco) else Charuco((7, 4), side_mm, 0.7 * side_mm)
    tried = replace(plain, inner_corners=(columns - 1, rows - 1), dictionary=dictionary)
    tried = replace(tried, inverted=seen.inverted, first_marker=first)
    tried = replace(tried, legacy=legacy if rows % 2 == 0 else plain.legacy)
    if not isinstance(chosen, Charuco):
        words = f"a {tried.title} ({dictionary}) seen, a {chosen.title} chosen"
        return OtherBoard(words, board=tried)
    if not any(_is_seen(tried, gray) for gray in grays):
        tried = replace(tried, legacy=chosen.legacy)
    remedy = _difference(chosen, tried)
    counts = f"{columns}x{rows} squares seen, {{}}x{{}} chosen".format(*chosen.squares)
    same = chosen.squares == tried.squares
    words = (_in_words(chosen, tried) if same else "") or counts
    return OtherBoard(words, f"write {remedy}" if remedy else "", tried)


def _twice(seen: _Markers) -> bool:
    most = [Counter(numbers.tolist()).most_common(1)[0][1] for numbers, _ in seen.pictures]
    return 2 * sum(count > 1 for count in most) > len(most)


def _charuco_of(seen: _Markers, chosen: Board) -> tuple[tuple[int, int], bool, int] | None:
    """Squares along x and y, layout, and first number of the board that markers make up."""
    low, high = int(seen.numbers[0]), int(seen.numbers[-1])
    if isinstance(chosen, Charuco):  # the same board, with other numbers
        columns, rows = chosen.squares
        places = _charuco_places(columns, chosen.legacy and rows % 2 == 0)
        firsts = range(max(high + 1 - columns * rows // 2, 0), low + 1)
        fits = [n for n in firsts if _misfit(seen.pictures, places, n) < _OFF_GRID]
        if len(fits) == 1:
            return chosen.squares, chosen.legacy, fits[0]
    firsts_of_others = (0, low) if 2 * low < high - low else (low, 0)
    for first in firsts_of_others:
        misfit, columns, legacy = min(
            (_misfit(seen.pictures, _charuco_places(columns, legacy), first), columns, legacy)
            for legacy in (False, True)
            for columns in range(3, _MOST_SQUARES + 1)
        )
        if misfit < _OFF_GRID:
            heights = range(4 if legacy else 3, 2 * _MOST_SQUARES, 2 if legacy else 1)
            rows = next(r for r in heights if columns * r // 2 > high - first)
            return (columns, rows), legacy, first
    return None


def _is_seen(board: Charuco, gray: Bytes) -> bool:
    try:
        return board.find(gray) is not None
    except MirroredBoardError:
        return False


def _difference(board: Charuco, other: Charuco) -> str:
    """The TOML that makes one of the other."""
    changed = []
    for key in (field.name for field in fields(board)):
        value = getattr(other, key)
        if value != getattr(board, key):
            shown = list(value) if isinstance(value, tuple) else value
            text = f'"{shown}"' if isinstance(shown, str) else str(shown).lower()
            changed.append(f"{key} = {text}")
    return ", ".join(changed)


def _in_words(board: Charuco, other: Charuco) -> str:
    """What makes one of equal counts another."""
    layout = "after" if board.legacy else "before"
    each = {
        "dictionary": f"its markers are {other.dictionary}",
        "inverted": f"its markers are {'white on black' if other.inverted else 'black on white'}",
        "first_marker": f"its markers begin with number {other.first_marker}",
        "legacy": f"its markers lie as OpenCV {layout} 4.6 draws them",
    }
    return ", ".join(
        text for key, text in each.items() if getattr(other, key) != getattr(board, key)
    )


def _other_chessboard(
    chosen: Board, grays: Sequence[Bytes], least: tuple[int, int]
) -> OtherBoard | None:
    """A chessboard, of other counts if one was chosen."""
    found = [counts for gray in grays if (counts := _chessboard_corners(gray, least))]
    if not found:
        return None
    counts = max(found, key=lambda one: one[0] * one[1])
    if not isinstance(chosen, Chessboard):
        seen = Chessboard(counts, _side_mm(chosen))
        return OtherBoard(f"a {seen.title} seen, a {chosen.title} chosen", board=seen)
    stated = chosen.inner_corners
    counts = counts if (stated[0] >= stated[1]) == (counts[0] >= counts[1]) else counts[::-1]
    if counts == stated:
        return None
    squares = [count + 1 for count in (*counts, *stated)]
    remedy = f"write inner_corners = {list(counts)}"
    seen = Chessboard(counts, chosen.square_mm)
    return OtherBoard("{}x{} squares seen, {}x{} chosen".format(*squares), remedy, seen)


def _side_mm(board: Board) -> float:
    """The side of a board's squares; that of an ordinary one, where it has none."""
    return board.square_mm if isinstance(board, Charuco | Chessboard) else _ORDINARY_SQUARE_MM


def _chessboard_corners(gray: Bytes, least: tuple[int, int]) -> tuple[int, int] | None:
    """Inner corners of a chessboard of at least so many, the larger number first."""
    share = min(_SEARCH_SIDE_PX / max(gray.shape), 1.0)
    small = cv2.resize(gray, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    cv2.setRNGSeed(0)  # The search draws: it must not depend on what was drawn before
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, least, cv2.CALIB_CB_LARGER)
    rows, columns = np.shape(meta)[:2] if found else (0, 0)
    return (max(rows, columns), min(rows, columns)) if found else None


def tag_gap(board: AprilGrid, views: Sequence[tuple[Ints, Floats]]) -> str:
    """What is wrong with the stated gap between tags, by corners (n,), (n, 2) px; else ""."""
    gaps = [gap for gap in (_seen_gap(board, ids, pixels) for ids, pixels in views) if gap]
    seen, stated = float(np.median(gaps)) if gaps else board.tag_spacing, board.tag_spacing
    if abs(seen / stated - 1) <= _GAP_OFF:
        return ""
    return (
        f"the gaps between tags are {seen:.3f} times as long as a tag's side, and tag_spacing, "
        f"{stated:g}, is that ratio, no length in m or mm: write tag_spacing = {seen:.3f}"
    )


def _seen_gap(board: AprilGrid, ids: Ints, pixels: Floats) -> float | None:
    """The gap in a picture, in sides of a tag; None where too few tags tell."""
    tags, corners = ids.reshape(-1, 4)[:, 0] // 4, pixels.reshape(-1, 4, 2)
    flat = np.column_stack([tags % board.tags[0], -(tags // board.tags[0])]).astype(np.float64)
    if len(flat) < _FEWEST_PLACED or not np.ptp(flat, axis=0).all():
        return None
    grid = mapped(corners.mean(axis=1), flat, pixels).reshape(-1, 4, 2)
    sides = np.linalg.norm(grid - np.roll(grid, 1, axis=1), axis=2)
    return float(1 / np.median(sides) - 1)
