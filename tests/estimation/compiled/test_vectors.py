"""Several numbers at a time, against the same sums one by one."""

import numba
import numpy as np
import pytest

from aolink.estimation.compiled.small import compiled
from aolink.estimation.compiled.vectors import (
    add_cubic,
    add_outer,
    add_product,
    lanes_of,
    put_cubic,
    put_sums,
    sums_of,
)

KINDS = pytest.mark.parametrize("kind", [np.float64, np.float32])
LANES = {np.float64: 4, np.float32: 8}


@numba.njit
def lanes(array):
    return lanes_of(array), sums_of(array)


@numba.njit
def product_added(out, at, factor, x, begin):
    add_product(out, at, factor, x, begin)


@numba.njit
def cubic_added(out, at, factor, d, table, begin, stride):
    add_cubic(out, at, factor, d, table, begin, stride)


@numba.njit
def cubic_put(out, at, factor, d, table, begin, stride):
    put_cubic(out, at, factor, d, table, begin, stride)


@numba.njit
def outer_added(out, at, stride, factors, count, x, begin):
    add_outer(out, at, stride, factors, count, x, begin)


@numba.njit
def sums_put(out, at, start, factors, first, stride, x, begin, width, count):
    put_sums(out, at, start, factors, first, stride, x, begin, width, count)


@compiled
def cubic_in_a_loop(out, at, factor, d, table, begin, stride):
    out, c = out.ravel(), table.ravel()
    for p in range(lanes_of(out)):
        q = begin + p
        light = c[q] + d * (c[q + stride] + d * (c[q + 2 * stride] + d * c[q + 3 * stride]))
        out[at + p] += factor * light


@compiled
def sums_in_a_loop(out, at, start, factors, first, stride, x, begin, width, count):
    f, values = factors.ravel(), x.ravel()
    for p in range(sums_of(out)):
        value = start
        for i in range(count):
            value += f[first + i * stride] * values[begin + i * width + p]
        out[at + p] = value


def near(kind):
    """Relative and absolute difference that rounding makes."""
    return {"rtol": 20 * np.finfo(kind).eps, "atol": 20 * np.finfo(kind).eps}


def drawn(kind, seed, *shapes):
    rng = np.random.default_rng(seed)
    return [rng.standard_normal(shape).astype(kind) for shape in shapes]


def only(found, out, changed):
    """Whether numbers elsewhere have kept their bits."""
    others = np.delete(np.arange(out.size), changed)
    return np.array_equal(found.ravel()[others], out.ravel()[others])


@KINDS
def test_so_many_are_taken_at_a_time(kind):
    assert lanes(np.zeros(1, kind)) == (LANES[kind], 4 * LANES[kind])


@KINDS
@pytest.mark.parametrize("at", [0, 3, 8])
def test_a_product_is_added_to_several_numbers_and_to_no_other(kind, at):
    out, x = drawn(kind, at, (4, 5), 14)
    found, changed = out.copy(), at + np.arange(LANES[kind])
    product_added(found, at, -1.5, x, 5)
    assert np.allclose(found.ravel()[changed], out.ravel()[changed] - 1.5 * x[5 : 5 + LANES[kind]], **near(kind))
    assert only(found, out, changed)


@KINDS
@pytest.mark.parametrize("at", [0, 3, 8])
def test_a_cubic_is_added_to_several_numbers_or_takes_their_place(kind, at):
    out, table = drawn(kind, at, (4, 5), (2, 4, 16))
    begin, d, changed = 64 + 4, 0.3, at + np.arange(LANES[kind])
    c = [table.ravel()[begin + 16 * k :][: LANES[kind]] for k in range(4)]
    light = 0.7 * (c[0] + d * (c[1] + d * (c[2] + d * c[3])))
    for function, before in ((cubic_added, out.ravel()[changed]), (cubic_put, 0)):
        found = out.copy()
        function(found, at, 0.7, d, table, begin, 16)
        assert np.allclose(found.ravel()[changed], before + light, **near(kind))
        assert only(found, out, changed)


@KINDS
@pytest.mark.parametrize("count", [4, 8, 12])
def test_an_outer_product_is_added_to_these_rows_and_no_others(kind, count):
    out, factors, x = drawn(kind, count, (14, 11), 16, 20)
    found = out.copy()
    outer_added(found, 13, 11, factors, count, x, 7)
    changed = (np.arange(count)[:, None] * 11 + 13 + np.arange(LANES[kind])).ravel()
    added = np.outer(factors[:count], x[7 : 7 + LANES[kind]]).ravel()
    assert np.allclose(found.ravel()[changed], out.ravel()[changed] + added, **near(kind))
    assert only(found, out, changed)


@KINDS
@pytest.mark.parametrize("count", [1, 2, 7])
def test_sums_of_products_take_the_place_of_what_was_there(kind, count):
    sums = 4 * LANES[kind]
    out, factors, x = drawn(kind, count, sums + 9, (count, 5), (count + 1, sums + 6))
    found, changed = out.copy(), 4 + np.arange(sums)
    sums_put(found, 4, 0.25, factors, 3, 5, x, 2, sums + 6, count)
    assert np.allclose(found[changed], 0.25 + factors[:, 3] @ x[:count, 2 : 2 + sums], **near(kind))
    assert only(found, out, changed)


@pytest.mark.slow
@KINDS
def test_the_bits_are_those_of_a_loop(kind):
    for seed in range(100):
        out, table, (factor, d), factors, x = drawn(kind, seed, 40, (4, 16), 2, (6, 3), (6, 40))
        for own, loop, arguments in (
            (cubic_added, cubic_in_a_loop, (3, factor, d, table, 2, 16)),
            (sums_put, sums_in_a_loop, (3, factor, factors, 1, 3, x, 5, 40, 5)),
        ):
            found, looped = out.copy(), out.copy()
            own(found, *arguments)
            loop(looped, *arguments)
            assert found.tobytes() == looped.tobytes()


@pytest.mark.parametrize("wrong", [np.zeros(12, np.float32), np.zeros(24)[::2], np.zeros((4, 3)).T])
def test_arrays_of_other_layouts_or_of_two_types_are_refused(wrong):
    with pytest.raises(numba.TypingError, match="contiguous arrays of one type of float"):
        product_added(wrong, 0, 1.0, np.ones(4), 0)
    with pytest.raises(numba.TypingError, match="contiguous arrays of one type of float"):
        product_added(np.ones(4), 0, 1.0, wrong, 0)


def test_whole_numbers_are_refused():
    with pytest.raises(numba.TypingError, match="contiguous arrays of one type of float"):
        product_added(np.zeros(8, np.int64), 0, 1.0, np.ones(4, np.int64), 0)
