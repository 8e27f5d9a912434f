"""Asking for a picture's bytes before they are needed.

A picture is larger than the memory near a processor, which waits for what it has not asked for.
Rays cross hundreds of rows far apart in memory, and would wait for most of them: while one outline
is measured, the next one's part of the picture is fetched; and while some rows are searched, the
next ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from measure.arrays import Bytes, Floats
from measure.compiling import compiled
from measure.model.lens import to_pixel
from measure_plugins._outline.sampling.rays import STEPS

_LINE = 64
"""Bytes that memory hands over at once."""
_BORDER_PX = 3.0
"""Pixels between which rays are sampled, and a prediction that is a little off."""
_CHANNELS = 3


@compiled
def ask_for_outline(pixels: Bytes, axis: Floats, half_angle: float, lens: Floats) -> None:
    """Have the part of a picture (h, w, 3) brought near that rays across an outline will read.

    Args:
        pixels: (h, w, 3) uint8.
        axis: (3,) predicted unit direction of the ball's centre in the camera frame.
        half_angle: predicted half angle of its cone, rad.
        lens: (13,) lens row.
    """
    height, width = pixels.shape[:2]
    flat, last = pixels.reshape(-1), pixels.size - 1
    u, v = to_pixel(axis[0], axis[1], axis[2], lens)
    radius = np.tan(half_angle) * lens[0]
    reach = radius + STEPS[-1] + _BORDER_PX
    for y in range(max(int(v - reach), 0), min(int(v + reach) + 1, height)):
        for start, end in ring_in_row(u, v, radius, y, width):
            first = _CHANNELS * (y * width + start)
            for at in range(first, first + _CHANNELS * (end - start) + _LINE, _LINE):
                _ask_for(flat, min(at, last))


@compiled
def ask_for_row(rows: Bytes, y: int) -> None:
    """Have row y of a picture (h, w) of bytes brought near, if there is such a row."""
    if y < len(rows):
        for at in range(0, rows.shape[1], _LINE):
            _ask_for(rows[y], at)


@compiled
def ring_in_row(
    u: float, v: float, radius: float, y: int, width: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Columns of a picture row that rays across an outline read: from, to, on either side.

    Args:
        u: column of the outline's centre, px.
        v: row of the outline's centre, px.
        radius: of the outline, px.
        y: the row.
        width: of the picture, px.
    """
    inner = max(radius + STEPS[0] - _BORDER_PX, 0.0)
    outer = radius + STEPS[-1] + _BORDER_PX
    far = np.sqrt(max(outer * outer - (y - v) ** 2, 0.0))
    near = np.sqrt(max(inner * inner - (y - v) ** 2, 0.0))
    return _columns(u - far, u - near, width), _columns(u + near, u + far, width)


@compiled
def _columns(start: float, end: float, width: int) -> tuple[int, int]:
    """The pixels between two places that lie in the picture."""
    first = min(max(int(start), 0), width)
    return first, max(first, min(int(end) + 1, width))


@intrinsic  # type: ignore[untyped-decorator]
def _ask_for(context: Any, data: Any, offset: Any) -> Any:  # noqa: ARG001
    """Have the bytes at an offset in an array brought near (LLVM's `prefetch`); reads nothing."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        address = builder.gep(array.data, [arguments[1]])
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        to_read, near, data = (ir.Constant(number, n) for n in (0, 2, 1))
        builder.call(prefetch, [address, to_read, near, data])
        return context.get_dummy_value()

    return types.void(data, types.intp), emit
