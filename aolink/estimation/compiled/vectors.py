"""Four numbers at a time, in loops over the pixels that a spot lights.

These are too short for the compiler: where it does not know how long a loop is, it takes sixteen numbers at a time and
the rest one by one. The results have the same bits as in a loop. Arrays are contiguous, and an index is that in the
flat array.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LANES = 4
_FOUR = ir.VectorType(ir.DoubleType(), LANES)
_FUSED = ("contract",)


def _intrinsic(function: Callable[..., Any]) -> Any:
    """Decorator of a function that generates code for others that are compiled."""
    return intrinsic(function)


@_intrinsic
def add_product(_: Any, out: Any, at: Any, factor: Any, x: Any, begin: Any) -> Any:
    """out[at + p] += factor * x[begin + p] for four p."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        values = builder.load(_four(context, builder, x, given[3], given[4]), align=8)
        _add(builder, _four(context, builder, out, given[0], given[1]), given[2], values)
        return context.get_dummy_value()

    return types.void(out, at, factor, x, begin), generate


@_intrinsic
def add_cubic(_: Any, out: Any, at: Any, factor: Any, d: Any, table: Any, begin: Any, stride: Any) -> Any:
    """out[at + p] += factor * (c0 + d (c1 + d (c2 + d c3))) for four p, with ck = table[begin + k stride + p]."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        value = _cubic(context, builder, given[3], table, *given[4:])
        _add(builder, _four(context, builder, out, given[0], given[1]), given[2], value)
        return context.get_dummy_value()

    return types.void(out, at, factor, d, table, begin, stride), generate


@_intrinsic
def put_cubic(_: Any, out: Any, at: Any, factor: Any, d: Any, table: Any, begin: Any, stride: Any) -> Any:
    """The same, in place of what was there."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        value = builder.fmul(_alike(builder, given[2]), _cubic(context, builder, given[3], table, *given[4:]))
        builder.store(value, _four(context, builder, out, given[0], given[1]), align=8)
        return context.get_dummy_value()

    return types.void(out, at, factor, d, table, begin, stride), generate


def _cubic(context: Any, builder: Any, d: Any, kind: Any, table: Any, index: Any, stride: Any) -> Any:
    coefficients, distance = [], _alike(builder, d)
    for _ in range(4):
        coefficients.append(builder.load(_four(context, builder, kind, table, index), align=8))
        index = builder.add(index, stride)
    value = coefficients.pop()
    for each in reversed(coefficients):
        value = builder.fadd(each, builder.fmul(distance, value, flags=_FUSED), flags=_FUSED)
    return value


def _four(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to four numbers of an array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _FOUR.as_pointer())


def _alike(builder: Any, number: Any) -> Any:
    """The same number four times."""
    first = builder.insert_element(ir.Constant(_FOUR, ir.Undefined), number, ir.IntType(32)(0))
    places = ir.VectorType(ir.IntType(32), LANES)([0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(_FOUR, ir.Undefined), places)


def _add(builder: Any, place: Any, factor: Any, values: Any) -> None:
    product = builder.fmul(_alike(builder, factor), values, flags=_FUSED)
    builder.store(builder.fadd(builder.load(place, align=8), product, flags=_FUSED), place, align=8)
