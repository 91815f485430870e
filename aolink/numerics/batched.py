"""Operations on many small matrices at once, with the batch axis first.

The result for one matrix does not depend on how many there are, nor on the number of threads, bit for bit: sizes up to
four are written out in elementwise operations, larger ones are one product each.
"""

from __future__ import annotations

import numpy as np

from aolink.numerics.arrays import FloatArray

_WRITTEN_OUT = 4
SMALL_PRODUCT = 100_000
"""No library shares a product of matrices with at most this many multiplications among threads."""


def tile(matrix: FloatArray, axes: int) -> FloatArray:
    """``axes`` copies of an array, (axes, ...); the batch is contiguous in memory, so that long batches are fast."""
    copies = np.empty((*matrix.shape, axes))
    copies[...] = matrix[..., None]
    return np.asarray(np.moveaxis(copies, -1, 0))


def batch_last(a: FloatArray) -> FloatArray:
    """The same array, (axes, ...), contiguous in memory along the batch."""
    copy = np.empty((*a.shape[1:], a.shape[0])).transpose((a.ndim - 1, *range(a.ndim - 1)))
    copy[...] = a
    return copy


def transpose(a: FloatArray) -> FloatArray:
    """(..., n, m) -> (..., m, n)"""
    return a.swapaxes(-1, -2)


def matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """(..., n, k) @ (..., k, m)"""
    if a.shape[-1] > _WRITTEN_OUT or max(a.shape[-2], b.shape[-1]) > 2 * _WRITTEN_OUT:
        return np.asarray(np.matmul(np.ascontiguousarray(a), np.ascontiguousarray(b)))
    return _sum_of_products(
        [a[..., :, j, None] for j in range(a.shape[-1])], [b[..., None, j, :] for j in range(b.shape[-2])]
    )


def matvec(a: FloatArray, x: FloatArray) -> FloatArray:
    """(..., n, k) @ (..., k)"""
    if a.shape[-1] > _WRITTEN_OUT:
        return matmul(a, x[..., None])[..., 0]
    return _sum_of_products([a[..., j] for j in range(a.shape[-1])], [x[..., j, None] for j in range(x.shape[-1])])


def dot(x: FloatArray, y: FloatArray) -> FloatArray:
    """(..., k) . (..., k)"""
    return _sum_of_products([x[..., j] for j in range(x.shape[-1])], [y[..., j] for j in range(y.shape[-1])])


def _sum_of_products(left: list[FloatArray], right: list[FloatArray]) -> FloatArray:
    """left[0] * right[0] + left[1] * right[1] + ..., in this order."""
    shape = np.broadcast(left[0], right[0]).shape
    if len(shape) == 0 or shape[0] == 1:
        out: FloatArray = left[0] * right[0]
        for a, b in zip(left[1:], right[1:], strict=True):
            out = out + a * b
        return out
    # NumPy would put the small axes innermost where it cannot decide; long batches are faster with the batch there.
    order = (len(shape) - 1, *range(len(shape) - 1))
    out = np.empty((*shape[1:], shape[0])).transpose(order)
    product = np.empty((*shape[1:], shape[0])).transpose(order)
    np.multiply(left[0], right[0], out=out)
    for a, b in zip(left[1:], right[1:], strict=True):
        np.multiply(a, b, out=product)
        out += product
    return out


def mean_over_path(values: FloatArray) -> FloatArray:
    """Mean over the fast steps: (..., n_steps) gives (...)."""
    return np.asarray(np.add.reduce(np.ascontiguousarray(values), axis=-1) / values.shape[-1])


def symmetric(a: FloatArray) -> FloatArray:
    """(a + a') / 2, (..., n, n): removes the asymmetry that rounding gives a covariance."""
    return (a + transpose(a)) / 2


def inverse(a: FloatArray) -> FloatArray:
    """Inverse of symmetric positive definite matrices, (..., m, m)."""
    if a.shape[-1] == 1:
        return 1 / a
    if a.shape[-1] > 2:
        return symmetric(np.linalg.inv(np.ascontiguousarray(a)))
    out = np.empty_like(a)
    determinant = a[..., 0, 0] * a[..., 1, 1] - a[..., 0, 1] * a[..., 0, 1]
    out[..., 0, 0] = a[..., 1, 1] / determinant
    out[..., 1, 1] = a[..., 0, 0] / determinant
    out[..., 0, 1] = out[..., 1, 0] = -a[..., 0, 1] / determinant
    return out


def solve(a: FloatArray, x: FloatArray) -> FloatArray:
    """a^-1 x, (..., n, n) and (..., n)."""
    return np.asarray(np.linalg.solve(a, x[..., None])[..., 0])


def congruence(a: FloatArray, p: FloatArray) -> FloatArray:
    """A P A', (..., m, n) and (..., n, n) -> (..., m, m)."""
    return matmul(matmul(a, p), transpose(a))


def long_matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """(..., n, k) @ (k, m) or (..., k, m) for long n, in pieces so small that no library shares them among threads."""
    n, k, m = a.shape[-2], a.shape[-1], b.shape[-1]
    rows = max(1, SMALL_PRODUCT // (k * m))
    if n <= rows:
        return matmul(a, b)
    whole = n // rows * rows
    b = np.ascontiguousarray(b)
    pieces = np.ascontiguousarray(a[..., :whole, :]).reshape(*a.shape[:-2], -1, rows, k)
    out = np.matmul(pieces, b[..., None, :, :]).reshape(*a.shape[:-2], whole, m)
    if whole == n:
        return np.asarray(out)
    return np.concatenate([out, np.matmul(np.ascontiguousarray(a[..., whole:, :]), b)], axis=-2)
