"""Small matrices, many at once, the batch axis first.

What comes out for one of them does not depend on how many are beside it, nor on the number of threads,
bit for bit: sizes up to four are written out in elementwise operations, larger ones are one product each.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_WRITTEN_OUT = 4


def tile(matrix: FloatArray, axes: int) -> FloatArray:
    """``axes`` copies of an array, (axes, ...); the batch is contiguous in memory, so that long batches are fast."""
    copies = np.empty((*matrix.shape, axes))
    copies[...] = matrix[..., None]
    return np.asarray(np.moveaxis(copies, -1, 0))


def transpose(a: FloatArray) -> FloatArray:
    """(..., n, m) -> (..., m, n)"""
    return a.swapaxes(-1, -2)


def matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """(..., n, k) @ (..., k, m)"""
    if a.shape[-1] > _WRITTEN_OUT:
        return np.asarray(np.matmul(np.ascontiguousarray(a), np.ascontiguousarray(b)))
    out: FloatArray = a[..., :, 0, None] * b[..., None, 0, :]
    for j in range(1, a.shape[-1]):
        out += a[..., :, j, None] * b[..., None, j, :]
    return out


def matvec(a: FloatArray, x: FloatArray) -> FloatArray:
    """(..., n, k) @ (..., k)"""
    if a.shape[-1] > _WRITTEN_OUT:
        return matmul(a, x[..., None])[..., 0]
    out: FloatArray = a[..., 0] * x[..., 0, None]
    for j in range(1, a.shape[-1]):
        out += a[..., j] * x[..., j, None]
    return out


def dot(x: FloatArray, y: FloatArray) -> FloatArray:
    """(..., k) . (..., k)"""
    out: FloatArray = x[..., 0] * y[..., 0]
    for j in range(1, x.shape[-1]):
        out += x[..., j] * y[..., j]
    return out


def mean_over_path(values: FloatArray) -> FloatArray:
    """Mean over the fast steps, (..., n_steps) -> (...)."""
    return np.asarray(np.add.reduce(np.ascontiguousarray(values), axis=-1) / values.shape[-1])


def symmetric(a: FloatArray) -> FloatArray:
    """Half of a matrix plus its transpose: rounding makes no covariance lopsided."""
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


def congruence(a: FloatArray, p: FloatArray) -> FloatArray:
    """A P A', (..., n, n)."""
    return matmul(matmul(a, p), transpose(a))
