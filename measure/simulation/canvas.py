"""The pixel grid of a camera: which pixels to draw, and with how many rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.errors import ConfigError
from measure.limits import AT_ONCE
from measure.model import Intrinsics
from measure.simulation.caster import Stage, spread
from measure.simulation.kernels import NOTHING
from measure.simulation.scene import Cuboid
from measure.simulation.sensor import Linear

Index: TypeAlias = tuple[slice, slice]
_BLOCK_PX = 8
_MIDDLE = _BLOCK_PX // 2 + 1  # index in the grid, which begins one pixel before the picture
_BLOCK_MARGIN_PX = 0.75 * _BLOCK_PX + 2.0
_TEXTURE_STEP = 0.05
"""Relative difference of neighbouring pixels on a flat face from which they are supersampled."""


class Canvas:
    """The pixel grid of one camera, with the ray of every pixel."""

    def __init__(self, intrinsics: Intrinsics, row_time_s: float = 0.0) -> None:
        self.width, self.height = intrinsics.size_wh
        self.row_time_s = row_time_s
        self._ideal = ideal_grid(intrinsics)
        self._block_shape = (-(-self.height // _BLOCK_PX), -(-self.width // _BLOCK_PX))
        rows = np.minimum(np.arange(self._block_shape[0]) * _BLOCK_PX + _MIDDLE, self.height)
        columns = np.minimum(np.arange(self._block_shape[1]) * _BLOCK_PX + _MIDDLE, self.width)
        self._block_ideal = self._ideal[np.ix_(rows, columns)].reshape(-1, 2)

    def empty(self) -> Linear:
        """A black picture (h, w, 3)."""
        return np.zeros((self.height, self.width, 3), np.float32)

    def draw(
        self, stage: Stage, redraw: int, samples: int, backdrop: Linear, before: Linear
    ) -> Linear:
        """Draw the pixels in which the first `redraw` shapes of a stage can be visible.

        Args:
            redraw: number of shapes that are not in `before` already.
            samples: rays through a pixel that an edge crosses.
            backdrop: (h, w, 3) radiance of rays that meet no shape.
            before: (h, w, 3) radiance of all other pixels.
        """
        out = before.copy()
        rows, columns, near = self._pixels_near(stage, redraw)
        if not rows.size:
            return out
        ideal, delays = self._ideal[rows + 1, columns + 1], self._delays(rows)
        seen, met = stage.colours(ideal[:, None], near, delays)
        first = met[:, 0]
        missed = first == NOTHING
        seen[missed] = backdrop[rows[missed], columns[missed]]
        out[rows, columns] = seen
        fine = stage.silhouettes(ideal, near) | self._steps(stage, rows, columns, first, seen)
        for part in np.array_split(np.flatnonzero(fine), np.count_nonzero(fine) // AT_ONCE + 1):
            r, c = rows[part], columns[part]
            out[r, c] = self._sample(stage, near[:, part], r, c, samples, backdrop)
        return out

    def _pixels_near(self, stage: Stage, redraw: int) -> tuple[Ints, Ints, Bools]:
        """Rows and columns (n,) of pixels to draw, and which shapes (k, n) are near each."""
        count = len(self._block_ideal)
        near = np.zeros((len(stage.shapes), count), bool)
        for k in range(len(stage.shapes)):
            gaps = stage.gaps_px(k, self._block_ideal)
            near[k] = gaps < _BLOCK_MARGIN_PX + stage.smear_px(k)
        blocks = np.flatnonzero(near[:redraw].any(axis=0))
        top, left = np.divmod(blocks, self._block_shape[1])
        inner = np.arange(_BLOCK_PX)
        shape = (len(blocks), _BLOCK_PX, _BLOCK_PX)
        rows = np.broadcast_to((top[:, None] * _BLOCK_PX + inner)[:, :, None], shape).ravel()
        columns = np.broadcast_to((left[:, None] * _BLOCK_PX + inner)[:, None, :], shape).ravel()
        inside = (rows < self.height) & (columns < self.width)
        near = np.repeat(near[:, blocks], _BLOCK_PX * _BLOCK_PX, axis=1)
        return rows[inside], columns[inside], near[:, inside]

    def _steps(self, stage: Stage, rows: Ints, columns: Ints, first: Ints, seen: Floats) -> Bools:
        """Pixels (n,) beside which another shape begins, or a flat face changes its colour."""
        top, left = int(rows.min()), int(columns.min())
        shape = (int(rows.max()) - top + 1, int(columns.max()) - left + 1)
        ids = np.full(shape, NOTHING - 1, np.int16)
        r, c = rows - top, columns - left
        ids[r, c] = first
        # Outlines of round shapes are found analytically (`silhouettes`); these are the borders
        # between shapes and the edges and textures of cuboids.
        flat = np.array([isinstance(s, Cuboid) for s in stage.shapes] + [False])
        lowest = NOTHING if flat[first].any() else 0
        step = _beside(
            lambda a, b: (ids[a] != ids[b]) & (np.minimum(ids[a], ids[b]) >= lowest), shape
        )
        if flat[first].any():
            grey = np.zeros(shape)
            grey[r, c] = seen.sum(axis=1) * flat[first]
            step |= _beside(
                lambda a, b: (
                    np.abs(grey[a] - grey[b]) > _TEXTURE_STEP * np.maximum(grey[a], grey[b])
                ),
                shape,
            )
        return step[r, c]

    def _sample(
        self, stage: Stage, near: Bools, rows: Ints, columns: Ints, samples: int, backdrop: Linear
    ) -> Floats:
        """Mean radiance (n, 3) over the area of pixels."""
        r, c = rows + 1, columns + 1
        by_column = (self._ideal[r, c + 1] - self._ideal[r, c - 1]) / 2
        by_row = (self._ideal[r + 1, c] - self._ideal[r - 1, c]) / 2
        offset = spread(samples)
        ideal = self._ideal[r, c][:, None] + (
            offset[:, :1] * by_column[:, None] + offset[:, 1:] * by_row[:, None]
        )
        seen, first = stage.colours(ideal, near, self._delays(rows))
        missed = np.mean(first == NOTHING, axis=1)
        return seen + missed[:, None] * backdrop[rows, columns]

    def _delays(self, rows: Ints) -> Floats:
        """Delays (n,) in s of the exposure of rows (n,) after the middle row."""
        return np.asarray((rows - (self.height - 1) / 2) * self.row_time_s, dtype=np.float64)


def ideal_grid(intrinsics: Intrinsics) -> Floats:
    """Undistorted normalised coordinates (h + 2, w + 2, 2) of all pixels and one beyond the border.

    The lens model is inverted at every eighth pixel and interpolated by bicubic splines, true to
    1e-6 px for ordinary lenses. ConfigError: the lens model has no inverse somewhere in the
    picture.
    """
    from scipy.interpolate import RectBivariateSpline

    width, height = intrinsics.size_wh
    u, v = _knots(width), _knots(height)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    bearings = intrinsics.unproject(uv)
    if not np.isfinite(bearings).all():
        raise ConfigError("the lens distortion cannot be inverted over the whole picture")
    ideal = (bearings[:, :2] / bearings[:, 2:]).reshape(len(v), len(u), 2)
    rows, columns = np.arange(-1, height + 1), np.arange(-1, width + 1)
    return np.stack(
        [RectBivariateSpline(v, u, ideal[..., k])(rows, columns) for k in range(2)], axis=-1
    )


def reduced(intrinsics: Intrinsics, factor: int) -> Intrinsics:
    """The same lens with pixels `factor` times as large."""
    width, height = intrinsics.size_wh
    matrix = intrinsics.matrix / factor
    matrix[:2, 2] -= (factor - 1) / (2 * factor)
    matrix[2, 2] = 1.0
    size = (-(-width // factor), -(-height // factor))
    return replace(intrinsics, size_wh=size, matrix=matrix)


def _knots(length: int) -> Floats:
    """Positions from before the first to after the last of `length` pixels, about 8 px apart."""
    return np.linspace(-2.0, length + 1.0, max(length // _BLOCK_PX, 8))


def _beside(differ: Callable[[Index, Index], Bools], shape: tuple[int, int]) -> Bools:
    """Pixels (h, w) that differ from one of their eight neighbours."""
    out = np.zeros(shape, bool)
    for a, b in (
        (np.s_[1:, :], np.s_[:-1, :]),
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:, 1:], np.s_[:-1, :-1]),
        (np.s_[1:, :-1], np.s_[:-1, 1:]),
    ):
        hit = differ(a, b)
        out[a] |= hit
        out[b] |= hit
    return out
