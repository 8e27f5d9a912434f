"""How viewers turn a picture that its orientation tag (Exif) asks to be turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bytes, Floats

_CHANGES = {
    1: (False, False, False),
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}
"""By the tag's value: whether rows and columns are exchanged, then columns and rows reversed."""


@dataclass(frozen=True)
class Orientation:
    """From a picture as the sensor gave it to the same as a viewer shows it.

    Attributes:
        size_wh: of the stored picture, px.
        tag: value of its orientation tag; any but 1 to 8 means 1, as it is.
    """

    size_wh: tuple[int, int]
    tag: int = 1

    @property
    def turns(self) -> bool:
        """Whether a viewer shows the picture otherwise than it is stored."""
        return any(self._change)

    def shown(self, pixels: Bytes) -> Bytes:
        """The picture (h, w, 3) as it is shown, contiguous."""
        exchanged, columns, rows = self._change
        some = pixels.swapaxes(0, 1) if exchanged else pixels
        return np.ascontiguousarray(some[:: -1 if rows else 1, :: -1 if columns else 1])

    def points_shown(self, stored_px: Floats) -> Floats:
        """Where points (n, 2) of the stored picture are shown."""
        return stored_px @ self.matrix.T + self._offset

    def points_stored(self, shown_px: Floats) -> Floats:
        """Where points (n, 2) that are shown lie in the stored picture."""
        return np.asarray((shown_px - self._offset) @ self.matrix)

    @property
    def matrix(self) -> Floats:
        """By which directions (2,) in the stored picture turn, orthogonal (2, 2)."""
        exchanged, columns, rows = self._change
        signs = np.diag([-1.0 if columns else 1.0, -1.0 if rows else 1.0])
        return signs @ (np.eye(2)[::-1] if exchanged else np.eye(2))

    @property
    def _offset(self) -> Floats:
        exchanged, columns, rows = self._change
        width, height = self.size_wh[::-1] if exchanged else self.size_wh
        return np.array([width - 1.0 if columns else 0.0, height - 1.0 if rows else 0.0])

    @property
    def _change(self) -> tuple[bool, bool, bool]:
        return _CHANGES.get(self.tag, _CHANGES[1])
