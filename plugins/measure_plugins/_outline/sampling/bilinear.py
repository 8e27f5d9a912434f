"""Reading a picture between its pixels: three colours of four pixels at once."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_INDEX = ir.IntType(32)
_FOUR = ir.VectorType(ir.FloatType(), 4)
_NOTHING = ir.Constant(_FOUR, ir.Undefined)


@intrinsic  # type: ignore[untyped-decorator]
def between_pixels(context: Any, flat: Any, at: Any, row: Any, weights: Any) -> Any:  # noqa: ARG001
    """Blue, green and red (3,) between four pixels, by their weights.

    Four bytes are one vector of the machine: those of a pixel, and one that is left out in the end.
    Compilers do not see that in loops over colours.

    Args:
        context: of the compiler.
        flat: (k,) bytes of a picture.
        at: of the upper left pixel's first colour.
        row: length of a picture row.
        weights: (4,) float32 of the upper left and right, lower left and right pixel.
    """
    single = types.float32
    four = types.UniTuple(single, 4)
    return types.UniTuple(single, 3)(flat, types.intp, types.intp, four), _emit_values


@intrinsic  # type: ignore[untyped-decorator]
def light_between(context: Any, flat: Any, of: Any, at: Any, row: Any, weights: Any) -> Any:  # noqa: ARG001
    """Light of blue, green and red (3,) between four pixels, by their weights.

    Args:
        context: of the compiler.
        flat: (k,) bytes of a picture.
        of: (256,) float32, the light of each of them.
        at: of the upper left pixel's first colour.
        row: length of a picture row.
        weights: (4,) float32 of the upper left and right, lower left and right pixel.
    """
    single = types.float32
    four = types.UniTuple(single, 4)
    return types.UniTuple(single, 3)(flat, of, types.intp, types.intp, four), _emit_light


def _emit_light(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Four bytes at once, as below; their light is looked up one by one."""
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    table = context.make_array(signature.args[1])(context, builder, arguments[1]).data
    at, row, weights = arguments[2:]
    right = builder.add(at, ir.Constant(at.type, 2))
    places = [at, right, builder.add(at, row), builder.add(right, row)]
    total = None
    for k, weight in enumerate(cgutils.unpack_tuple(builder, weights)):
        light = _looked_up(builder, data, table, places[k], k % 2)
        light = builder.fmul(_all_four(builder, weight), light)
        total = light if total is None else builder.fadd(total, light)
    colors = [builder.extract_element(total, ir.Constant(_INDEX, c)) for c in range(3)]
    return context.make_tuple(builder, signature.return_type, colors)


def _looked_up(builder: Any, data: Any, table: Any, at: Any, skipped: int) -> Any:
    """Light of three of the four bytes at a place (the first is the lowest), some `skipped`."""
    address = builder.bitcast(builder.gep(data, [at]), _INDEX.as_pointer())
    word = builder.zext(builder.load(address, align=1), at.type)
    out = _NOTHING
    for c in range(3):
        shifted = builder.lshr(word, ir.Constant(at.type, 8 * (c + skipped)))
        byte = builder.and_(shifted, ir.Constant(at.type, 255))
        light = builder.load(builder.gep(table, [byte]))
        out = builder.insert_element(out, light, ir.Constant(_INDEX, c))
    return out


def _emit_values(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Four bytes of a left pixel end in the right one's first; of a right one, begin before it."""
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    at, row, weights = arguments[1:]
    upper_left, upper_right, lower_left, lower_right = cgutils.unpack_tuple(builder, weights)
    right = builder.add(at, ir.Constant(at.type, 2))
    lefts = _column(builder, data, at, row, upper_left, lower_left)
    rights = _column(builder, data, right, row, upper_right, lower_right)
    total = builder.fadd(lefts, _arranged(builder, rights, [1, 2, 3, 3]))
    colors = [builder.extract_element(total, ir.Constant(_INDEX, c)) for c in range(3)]
    return context.make_tuple(builder, signature.return_type, colors)


def _column(builder: Any, data: Any, at: Any, row: Any, upper: Any, lower: Any) -> Any:
    """Weighted sum of the four bytes at a place and of those below."""
    above = builder.fmul(_bytes(builder, data, at), _all_four(builder, upper))
    below = _bytes(builder, data, builder.add(at, row))
    return builder.fadd(above, builder.fmul(below, _all_four(builder, lower)))


def _bytes(builder: Any, data: Any, at: Any) -> Any:
    address = builder.bitcast(builder.gep(data, [at]), ir.VectorType(ir.IntType(8), 4).as_pointer())
    return builder.uitofp(builder.load(address, align=1), _FOUR)


def _all_four(builder: Any, weight: Any) -> Any:
    one = builder.insert_element(_NOTHING, weight, ir.Constant(_INDEX, 0))
    return _arranged(builder, one, [0, 0, 0, 0])


def _arranged(builder: Any, four: Any, order: list[int]) -> Any:
    return builder.shuffle_vector(four, _NOTHING, ir.Constant(ir.VectorType(_INDEX, 4), order))
