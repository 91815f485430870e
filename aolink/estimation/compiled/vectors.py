"""Several numbers at a time, 32 bytes: four of float64, eight of float32.

It is for loops over the pixels that a spot lights and over points of one path. Those over pixels are too short to be
vectorised: where the compiler does not know how long a loop is, it takes sixteen numbers at a time and the rest one by
one. In the others it keeps no sum in a register from one term to the next. The results have the same bits as in a loop
that is compiled by `small.compiled`.

Arrays of a call are contiguous and of one type, float64 or float32, or compilation fails; numbers are converted to that
type. Indices count in the flattened array. Nothing checks bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

BYTES = 32
"""A pixel's table has a multiple of these bytes."""
_ROWS = 4
_VECTORS = 4
# A product and a sum may be computed as one operation, as in `small.compiled`.
_FUSED = ("contract",)


def _intrinsic(function: Callable[..., Any]) -> Any:
    """Numba's `intrinsic`, typed: a function that generates LLVM code at the place of its call."""
    return intrinsic(function)


@_intrinsic
def lanes_of(_: Any, array: Any) -> Any:
    """How many numbers of an array are taken at a time."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return context.get_constant(types.intp, _lanes(array))

    return types.intp(array), generate


@_intrinsic
def sums_of(_: Any, array: Any) -> Any:
    """How many sums `put_sums` computes for an array."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return context.get_constant(types.intp, _VECTORS * _lanes(array))

    return types.intp(array), generate


@_intrinsic
def add_product(_: Any, out: Any, at: Any, factor: Any, x: Any, begin: Any) -> Any:
    """out[at + p] += factor * x[begin + p] for p below `lanes_of`."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        values = _load(context, builder, x, given[3], given[4])
        _add(builder, _several(context, builder, out, given[0], given[1]), given[2], values)
        return context.get_dummy_value()

    return _signature(out, at, factor, x, begin), generate


@_intrinsic
def add_outer(
    _: Any, out: Any, at: Any, stride: Any, factors: Any, count: Any, x: Any, begin: Any
) -> Any:  # fmt: skip
    """out[at + r stride + p] += factors[r] * x[begin + p] for p below `lanes_of` and all r below ``count``, a positive
    multiple of four."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        values = _load(context, builder, x, given[5], given[6])
        number = context.get_value_type(types.intp)

        def term(r: Any, places: Sequence[Any]) -> list[Any]:
            (place,) = places
            for k in range(_ROWS):
                factor = _number(context, builder, factors, given[3], builder.add(r, number(k)))
                _add(builder, _several(context, builder, out, given[0], place), factor, values)
                place = builder.add(place, given[2])
            return [place]

        _loop(builder, number(0), given[4], _ROWS, [given[1]], term)
        return context.get_dummy_value()

    return _signature(out, at, stride, factors, count, x, begin), generate


@_intrinsic
def add_slopes(
    _: Any, out: Any, x: Any, at: Any, stride: Any, rows: Any, row_slopes: Any, count: Any, columns: Any,
    column_slopes: Any, begin: Any,
) -> Any:  # fmt: skip
    """Add to out[0] the sum of x[at + r stride + p] * rows[r] * column_slopes[begin + p], and to out[1] that of x[at +
    r stride + p] * row_slopes[r] * columns[begin + p], over p below `lanes_of` and r below ``count``, a positive
    multiple of two: the adjoint of `add_outer` and the slopes of its factors."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        number = context.get_value_type(types.intp)

        def term(r: Any, before: Sequence[Any]) -> list[Any]:
            place, *sums = before
            for k in range(2):
                values = _load(context, builder, x, given[1], place)
                for j, kind, array in ((0, rows, given[4]), (1, row_slopes, given[5])):
                    factor = _number(context, builder, kind, array, builder.add(r, number(k)))
                    product = builder.fmul(_broadcast(builder, factor, values.type.count), values, flags=_FUSED)
                    sums[2 * k + j] = builder.fadd(sums[2 * k + j], product, flags=_FUSED)
                place = builder.add(place, given[3])
            return [place, *sums]

        nothing = ir.Constant(ir.VectorType(context.get_value_type(x.dtype), _lanes(x)), None)
        _, *sums = _loop(builder, number(0), given[6], 2, [given[2], *[nothing] * 4], term)
        for j, kind, array in ((0, column_slopes, given[8]), (1, columns, given[7])):
            along = builder.fmul(builder.fadd(sums[j], sums[2 + j]), _load(context, builder, kind, array, given[9]))
            place = builder.gep(context.make_array(out)(context, builder, given[0]).data, [number(j)])
            builder.store(builder.fadd(builder.load(place), _sum(builder, along)), place)
        return context.get_dummy_value()

    arguments = (out, x, at, stride, rows, row_slopes, count, columns, column_slopes, begin)
    return _signature(*arguments), generate


@_intrinsic
def sum_cubic_slope(_: Any, x: Any, at: Any, d: Any, table: Any, begin: Any, stride: Any) -> Any:
    """Sum of x[at + p] * (c1 + d (2 c2 + 3 d c3)) over p below `lanes_of`, with ck as in `add_cubic`."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        slope = _cubic_slope(context, builder, given[2], table, *given[3:])
        return _sum(builder, builder.fmul(_load(context, builder, x, given[0], given[1]), slope))

    return _signature(x, at, d, table, begin, stride, gives=x.dtype), generate


@_intrinsic
def put_cubic_slope(_: Any, out: Any, at: Any, factor: Any, d: Any, table: Any, begin: Any, stride: Any) -> Any:
    """out[at + p] = factor * (c1 + d (2 c2 + 3 d c3)) for p below `lanes_of`, with ck as in `add_cubic`."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        values = _cubic_slope(context, builder, given[3], table, *given[4:])
        _put(builder, _several(context, builder, out, given[0], given[1]), given[2], values)
        return context.get_dummy_value()

    return _signature(out, at, factor, d, table, begin, stride), generate


@_intrinsic
def put_sums(
    _: Any, out: Any, at: Any, start: Any, factors: Any, first: Any, stride: Any, x: Any, begin: Any, width: Any,
    count: Any,
) -> Any:  # fmt: skip
    """out[at + p] = start + sum over i below ``count``, at least 1, of factors[first + i stride] * x[begin + i width +
    p] for p below `sums_of`."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        number, lanes = context.get_value_type(types.intp), _lanes(out)

        def term(i: Any, before: Sequence[Any]) -> list[Any]:
            of_factor, of_x, *sums = before
            factor = _broadcast(builder, _number(context, builder, factors, given[3], of_factor), lanes)
            for k, each in enumerate(sums):
                values = _load(context, builder, x, given[6], builder.add(of_x, number(k * lanes)))
                sums[k] = builder.fadd(each, builder.fmul(factor, values, flags=_FUSED), flags=_FUSED)
            return [builder.add(of_factor, given[5]), builder.add(of_x, given[8]), *sums]

        initial = [given[4], given[7], *[_broadcast(builder, given[2], lanes)] * _VECTORS]
        _, _, *sums = _loop(builder, number(0), given[9], 1, initial, term)
        for k, each in enumerate(sums):
            place = _several(context, builder, out, given[0], builder.add(given[1], number(k * lanes)))
            builder.store(each, place, align=_alignment(each.type))
        return context.get_dummy_value()

    return _signature(out, at, start, factors, first, stride, x, begin, width, count), generate


@_intrinsic
def add_cubic(_: Any, out: Any, at: Any, factor: Any, d: Any, table: Any, begin: Any, stride: Any) -> Any:
    """out[at + p] += factor * (c0 + d (c1 + d (c2 + d c3))) for p below `lanes_of`, with ck = table[begin + k stride +
    p]."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        value = _cubic(context, builder, given[3], table, *given[4:])
        _add(builder, _several(context, builder, out, given[0], given[1]), given[2], value)
        return context.get_dummy_value()

    return _signature(out, at, factor, d, table, begin, stride), generate


@_intrinsic
def put_cubic(_: Any, out: Any, at: Any, factor: Any, d: Any, table: Any, begin: Any, stride: Any) -> Any:
    """As `add_cubic`, in place of what was there."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        values = _cubic(context, builder, given[3], table, *given[4:])
        _put(builder, _several(context, builder, out, given[0], given[1]), given[2], values)
        return context.get_dummy_value()

    return _signature(out, at, factor, d, table, begin, stride), generate


def _signature(*arguments: Any, gives: Any = types.void) -> Any:
    """The signature of a function of these types.

    Raises TypingError for an array that is not contiguous, of another type than the others, or neither of float64 nor
    of float32: its memory would be taken for another's.
    """
    arrays = [kind for kind in arguments if isinstance(kind, types.Array)]
    number = arrays[0].dtype
    for kind in arrays:
        if kind.layout != "C" or kind.dtype != number or number not in (types.float64, types.float32):
            raise TypingError(f"several numbers at a time need contiguous arrays of one type of float, not {kind}")
    return gives(*[number if isinstance(kind, types.Float) else kind for kind in arguments])


def _lanes(kind: Any) -> int:
    return BYTES * 8 // int(kind.dtype.bitwidth)


def _alignment(vector: Any) -> int:
    """Bytes of one number of a vector: nothing more is known of where an array's part begins."""
    return BYTES // int(vector.count)


def _number(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """One number of an array."""
    return builder.load(builder.gep(context.make_array(kind)(context, builder, array).data, [index]))


def _several(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to several numbers of an array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), ir.VectorType(data.type.pointee, _lanes(kind)).as_pointer())


def _load(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Several numbers of an array."""
    place = _several(context, builder, kind, array, index)
    return builder.load(place, align=_alignment(place.type.pointee))


def _broadcast(builder: Any, number: Any, count: int) -> Any:
    """The same number several times."""
    nothing = ir.Constant(ir.VectorType(number.type, count), ir.Undefined)
    first = builder.insert_element(nothing, number, ir.IntType(32)(0))
    return builder.shuffle_vector(first, nothing, ir.VectorType(ir.IntType(32), count)([0] * count))


def _cubic(context: Any, builder: Any, d: Any, kind: Any, table: Any, index: Any, stride: Any) -> Any:
    """Cubic polynomials of d, with coefficients from a table, by Horner's rule."""
    coefficients, distance = [], _broadcast(builder, d, _lanes(kind))
    for _ in range(4):
        coefficients.append(_load(context, builder, kind, table, index))
        index = builder.add(index, stride)
    value = coefficients.pop()
    for each in reversed(coefficients):
        value = builder.fadd(each, builder.fmul(distance, value, flags=_FUSED), flags=_FUSED)
    return value


def _cubic_slope(context: Any, builder: Any, d: Any, kind: Any, table: Any, index: Any, stride: Any) -> Any:
    """Derivatives by d of the polynomials of `_cubic`."""
    distance, coefficients = _broadcast(builder, d, _lanes(kind)), []
    for k in (1, 2, 3):
        index = builder.add(index, stride)
        value = _load(context, builder, kind, table, index)
        factor = ir.Constant(value.type.element, float(k))
        coefficients.append(builder.fmul(value, _broadcast(builder, factor, _lanes(kind))))
    value = coefficients.pop()
    for each in reversed(coefficients):
        value = builder.fadd(each, builder.fmul(distance, value, flags=_FUSED), flags=_FUSED)
    return value


def _sum(builder: Any, values: Any) -> Any:
    """Sum of the numbers of a vector, by halves."""
    while values.type.count > 1:
        half = values.type.count // 2
        places = [ir.Constant(ir.VectorType(ir.IntType(32), half), list(range(k, k + half))) for k in (0, half)]
        low, high = (builder.shuffle_vector(values, values, each) for each in places)
        values = builder.fadd(low, high)
    return builder.extract_element(values, ir.IntType(32)(0))


def _put(builder: Any, place: Any, factor: Any, values: Any) -> None:
    """Products stored where a pointer points to."""
    product = builder.fmul(_broadcast(builder, factor, values.type.count), values)
    builder.store(product, place, align=_alignment(values.type))


def _add(builder: Any, place: Any, factor: Any, values: Any) -> None:
    """Products added to what a pointer points to."""
    product = builder.fmul(_broadcast(builder, factor, values.type.count), values, flags=_FUSED)
    before = builder.load(place, align=_alignment(values.type))
    builder.store(builder.fadd(before, product, flags=_FUSED), place, align=_alignment(values.type))


def _loop(
    builder: Any, begin: Any, end: Any, step: int, initial: Sequence[Any],
    body: Callable[[Any, Sequence[Any]], Sequence[Any]],
) -> list[Any]:  # fmt: skip
    """Values after a loop that runs at least once: ``body`` gets a counter and the values before a pass, and gives
    those after it."""
    before, inside = builder.basic_block, builder.append_basic_block("loop")
    builder.branch(inside)
    builder.position_at_end(inside)
    counter, *values = (builder.phi(each.type) for each in (begin, *initial))
    after = [builder.add(counter, counter.type(step)), *body(counter, values)]
    for variable, first, new in zip((counter, *values), (begin, *initial), after, strict=True):
        variable.add_incoming(first, before)
        variable.add_incoming(new, inside)
    outside = builder.append_basic_block("after")
    builder.cbranch(builder.icmp_signed("<", after[0], end), inside, outside)
    builder.position_at_end(outside)
    return after[1:]
