"""Four numbers at a time, in loops over the pixels that a spot lights.

These loops are too short to be vectorised: where the compiler does not know how long a loop is, it takes sixteen
numbers at a time and the rest one by one. The results have the same bits as in a loop that is compiled by
`small.compiled`. Arrays are contiguous and of float64, or compilation fails; indices count in the flattened array.
Nothing checks bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

LANES = 4
_FOUR = ir.VectorType(ir.DoubleType(), LANES)
# A product and a sum may be computed as one operation, as in `small.compiled`.
_FUSED = ("contract",)


def _intrinsic(function: Callable[..., Any]) -> Any:
    """Numba's `intrinsic`, typed: a function that generates LLVM code at the place of its call."""
    return intrinsic(function)


@_intrinsic
def add_product(_: Any, out: Any, at: Any, factor: Any, x: Any, begin: Any) -> Any:
    """out[at + p] += factor * x[begin + p] for four p."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        values = builder.load(_four(context, builder, x, given[3], given[4]), align=8)
        _add(builder, _four(context, builder, out, given[0], given[1]), given[2], values)
        return context.get_dummy_value()

    return _signature(out, at, factor, x, begin), generate


@_intrinsic
def add_cubic(_: Any, out: Any, at: Any, factor: Any, d: Any, table: Any, begin: Any, stride: Any) -> Any:
    """out[at + p] += factor * (c0 + d (c1 + d (c2 + d c3))) for four p, with ck = table[begin + k stride + p]."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        value = _cubic(context, builder, given[3], table, *given[4:])
        _add(builder, _four(context, builder, out, given[0], given[1]), given[2], value)
        return context.get_dummy_value()

    return _signature(out, at, factor, d, table, begin, stride), generate


@_intrinsic
def put_cubic(_: Any, out: Any, at: Any, factor: Any, d: Any, table: Any, begin: Any, stride: Any) -> Any:
    """As `add_cubic`, in place of what was there."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        value = builder.fmul(_broadcast(builder, given[2]), _cubic(context, builder, given[3], table, *given[4:]))
        builder.store(value, _four(context, builder, out, given[0], given[1]), align=8)
        return context.get_dummy_value()

    return _signature(out, at, factor, d, table, begin, stride), generate


def _signature(*arguments: Any) -> Any:
    """The signature of a function of these types without a result.

    Raises TypingError for an array that is not contiguous or not of float64: its memory would be taken for another's.
    """
    for kind in arguments:
        if isinstance(kind, types.Array) and (kind.layout != "C" or kind.dtype != types.float64):
            raise TypingError(f"four numbers at a time need a contiguous array of float64, not {kind}")
    return types.void(*arguments)


def _four(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to four numbers of an array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _FOUR.as_pointer())


def _broadcast(builder: Any, number: Any) -> Any:
    """The same number four times."""
    first = builder.insert_element(ir.Constant(_FOUR, ir.Undefined), number, ir.IntType(32)(0))
    places = ir.VectorType(ir.IntType(32), LANES)([0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(_FOUR, ir.Undefined), places)


def _cubic(context: Any, builder: Any, d: Any, kind: Any, table: Any, index: Any, stride: Any) -> Any:
    """Four cubic polynomials of d, with coefficients from a table, by Horner's rule."""
    coefficients, distance = [], _broadcast(builder, d)
    for _ in range(4):
        coefficients.append(builder.load(_four(context, builder, kind, table, index), align=8))
        index = builder.add(index, stride)
    value = coefficients.pop()
    for each in reversed(coefficients):
        value = builder.fadd(each, builder.fmul(distance, value, flags=_FUSED), flags=_FUSED)
    return value


def _add(builder: Any, place: Any, factor: Any, values: Any) -> None:
    """Four products added to what a pointer points to."""
    product = builder.fmul(_broadcast(builder, factor), values, flags=_FUSED)
    builder.store(builder.fadd(builder.load(place, align=8), product, flags=_FUSED), place, align=8)
