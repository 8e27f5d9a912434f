"""Duplicate images: a stalled camera or driver delivers its last image again, with a new stamp.

Sensor noise makes two exposures differ, so identical pixels mean the same exposure. Measured at the
new stamp it would put the body where it was before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.model import FrameSet, Image

_ROW_STEP = 32  # Every so many rows are compared
_FIRST_PIXELS = 64
"""Pixels of the middle row that are compared first: nearly always enough to tell images apart."""
_MIN_IMAGES = 2  # New images with which a frame set is measured without the duplicates


class DuplicateImages:
    """Compares every camera's image with its last one."""

    def __init__(self) -> None:
        self._last: dict[str, Image] = {}

    def without_duplicates(self, frame_set: FrameSet) -> tuple[FrameSet, str]:
        """The frame set without duplicates if two others are left; else the same, and a flag."""
        duplicates = self.of(frame_set)
        if not duplicates:
            return frame_set, ""
        new = {name: i for name, i in frame_set.images.items() if name not in duplicates}
        if len(new) >= _MIN_IMAGES:
            return replace(frame_set, images=new), ""
        return frame_set, f"the pictures of {', '.join(duplicates)} repeat those before: a stall?"

    def of(self, frame_set: FrameSet) -> list[str]:
        """The cameras whose image is the same as in the frame set of the last call."""
        duplicates = [name for name, image in frame_set.images.items() if self._same(image)]
        self._last.update(frame_set.images)
        return duplicates

    def _same(self, image: Image) -> bool:
        last = self._last.get(image.camera)
        if last is None or last.frame == image.frame:
            return False
        if image.encoded is not None and last.encoded is not None:
            return image.encoded == last.encoded
        a, b = np.asarray(last.pixels), np.asarray(image.pixels)
        if a.ndim != 3 or a.shape != b.shape:
            return False
        middle = len(a) // 2
        if a[middle, :_FIRST_PIXELS].tobytes() != b[middle, :_FIRST_PIXELS].tobytes():
            return False
        return np.array_equal(a[middle], b[middle]) and np.array_equal(
            a[::_ROW_STEP], b[::_ROW_STEP]
        )
