"""Four numbers at a time, against the same sums one by one."""

import numba
import numpy as np
import pytest

from aolink.estimation.compiled.small import compiled
from aolink.estimation.compiled.vectors import LANES, add_cubic, add_product, put_cubic


@numba.njit
def product_added(out, at, factor, x, begin):
    add_product(out, at, factor, x, begin)


@numba.njit
def cubic_added(out, at, factor, d, table, begin, stride):
    add_cubic(out, at, factor, d, table, begin, stride)


@numba.njit
def cubic_put(out, at, factor, d, table, begin, stride):
    put_cubic(out, at, factor, d, table, begin, stride)


@compiled
def in_a_loop(out, at, factor, d, table, begin, stride):
    out, c = out.ravel(), table.ravel()
    for p in range(LANES):
        q = begin + p
        light = c[q] + d * (c[q + stride] + d * (c[q + 2 * stride] + d * c[q + 3 * stride]))
        out[at + p] += factor * light


def cubic(table, begin, stride, d):
    c = [table.ravel()[begin + k * stride : begin + k * stride + LANES] for k in range(4)]
    return c[0] + d * (c[1] + d * (c[2] + d * c[3]))


@pytest.mark.parametrize("at", [0, 3, 8])
def test_a_product_is_added_to_four_numbers_and_to_no_other(at):
    rng = np.random.default_rng(at)
    out, x = rng.standard_normal((3, 4)), rng.standard_normal(9)
    expected = out.copy()
    expected.ravel()[at : at + LANES] += -1.5 * x[5:]
    product_added(out, at, -1.5, x, 5)
    assert np.allclose(out, expected, rtol=1e-15, atol=0)
    untouched = np.delete(np.arange(12), np.arange(at, at + LANES))
    assert np.array_equal(out.ravel()[untouched], expected.ravel()[untouched])


@pytest.mark.parametrize("at", [0, 3, 8])
def test_a_cubic_is_added_to_four_numbers_or_takes_their_place(at):
    rng = np.random.default_rng(at)
    out, table = rng.standard_normal((3, 4)), rng.standard_normal((2, 4, 8))
    begin, d = 32 + 4, 0.3
    added, placed = out.copy(), out.copy()
    added.ravel()[at : at + LANES] += 0.7 * cubic(table, begin, 8, d)
    placed.ravel()[at : at + LANES] = 0.7 * cubic(table, begin, 8, d)
    for function, expected in ((cubic_added, added), (cubic_put, placed)):
        found = out.copy()
        function(found, at, 0.7, d, table, begin, 8)
        assert np.allclose(found, expected, rtol=1e-14, atol=0)
        untouched = np.delete(np.arange(12), np.arange(at, at + LANES))
        assert np.array_equal(found.ravel()[untouched], out.ravel()[untouched])


def test_the_bits_are_those_of_a_loop():
    rng = np.random.default_rng(5)
    for _ in range(200):
        out, table, numbers = rng.standard_normal(8), rng.standard_normal((4, 8)), rng.standard_normal(2)
        looped = out.copy()
        cubic_added(out, 3, *numbers, table, 2, 8)
        in_a_loop(looped, 3, *numbers, table, 2, 8)
        assert out.tobytes() == looped.tobytes()


@pytest.mark.parametrize("wrong", [np.zeros(12, np.float32), np.zeros(24)[::2], np.zeros((4, 3)).T])
def test_arrays_of_other_layouts_are_refused(wrong):
    with pytest.raises(numba.TypingError, match="contiguous array of float64"):
        product_added(wrong, 0, 1.0, np.ones(4), 0)
    with pytest.raises(numba.TypingError, match="contiguous array of float64"):
        product_added(np.ones(4), 0, 1.0, wrong, 0)
