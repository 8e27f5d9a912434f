"""What a board file says wrongly of a ChArUco board whose markers are seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import product

import cv2
import numpy as np

from measure.arrays import Bytes
from measure.calibration.boards import Board, Charuco, MirroredBoardError, aruco_dictionary

_FAMILIES = (
    *("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL"),
    *("DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10", "DICT_APRILTAG_36h11"),
    "DICT_ARUCO_MIP_36h12",
)
"""The largest dictionary of each family: the smaller ones are its first markers."""
_SMALLER = (50, 100, 250)
_LEAST_MARKERS = 4


def charuco_slip(board: Board, grays: Sequence[Bytes]) -> str:
    """What to write into the file of a board that none of these pictures (h, w) shows; else "".

    Tries the other layout, counts swapped or of squares, inverted print and other dictionaries.
    """
    if not isinstance(board, Charuco):
        return ""
    own = next(name for name in _FAMILIES if _is_of(board.dictionary, name))
    seen = _families_seen(grays, [own], board.inverted)
    for inverted in () if seen else (board.inverted, not board.inverted):
        seen += _families_seen(grays, _FAMILIES, inverted)
    if not seen:
        return ""
    count, family, inverted, highest = max(seen)
    dictionary = board.dictionary
    if not _is_of(dictionary, family):
        sizes = (size for size in _SMALLER if family.endswith("_1000") and size > highest)
        dictionary = family.replace("1000", str(next(sizes, 1000)))
    columns, rows = board.inner_corners
    counts = [(columns, rows), (rows, columns), (columns - 1, rows - 1), (rows - 1, columns - 1)]
    for legacy, inner in product((board.legacy, not board.legacy), counts):
        if min(inner) < 2:
            continue
        tried = replace(board, inner_corners=inner, legacy=legacy, inverted=inverted)
        tried = replace(tried, dictionary=dictionary)
        if _fits(tried) and any(_is_seen(tried, gray) for gray in grays):
            return f"the pictures show another one: write {_difference(board, tried)}"
    return (
        f"{count} markers of {dictionary} are seen, with numbers up to {highest}, but no board of "
        f"{columns}x{rows} inner corners: count them again"
    )


def _is_of(dictionary: str, family: str) -> bool:
    return dictionary.startswith(family.removesuffix("1000"))


def _families_seen(
    grays: Sequence[Bytes], families: Sequence[str], inverted: bool
) -> list[tuple[int, str, bool, int]]:
    """How many markers of which family, printed inverted or not, are seen, up to which number."""
    kinds = list(map(aruco_dictionary, families))
    detector = cv2.aruco.ArucoDetector(kinds)
    ids: list[list[int]] = [[] for _ in families]
    for gray in grays:
        shown = np.asarray(255 - gray if inverted else gray, np.uint8)
        _, numbers, _, kind_of = detector.detectMarkersMultiDict(shown)
        some = () if numbers is None else zip(np.ravel(numbers), np.ravel(kind_of), strict=True)
        for number, kind in some:
            ids[int(kind)].append(int(number))
    return [
        (len(found), name, inverted, max(found))
        for found, name in zip(ids, families, strict=True)
        if len(found) >= _LEAST_MARKERS
    ]


def _fits(board: Charuco) -> bool:
    columns, rows = board.squares
    return columns * rows // 2 <= len(aruco_dictionary(board.dictionary).bytesList)


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
