"""Kalibr's AprilGrid: rows of AprilTags, of which any part may be seen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, Ints, rms_length
from measure.calibration.boards import (
    Board,
    Corners,
    aruco_dictionary,
    mapped,
    refine_by_gradient,
    sharpness,
)

DICTIONARY = "DICT_APRILTAG_36h11"
BORDER_BITS = 2  # Width of the tags' black border in cells, as Kalibr prints them; others print one
_LEAST_TAGS = 4
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
            if len(tags) >= _LEAST_TAGS:
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
