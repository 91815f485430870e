"""Operations on many matrices of one or two rows at once, entry by entry, with the arithmetic written out.

An entry is an array with a value for each axis, or one number for all axes; with a single axis all are numbers, since
NumPy would take ten times as long. Every operation is then one pass over arrays that lie in the processor's cache, and
only half of a symmetric matrix is computed; for larger matrices the calls would cost more than the arithmetic
(`aolink.numerics.batched`). The row `o3_step` of tools/bench needs it. The result for one axis does not depend on how
many there are, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from aolink.numerics.arrays import FloatArray

Entry = FloatArray | float
Matrix = list[list[Entry]]

MOST_ROWS = 2
"""Most rows or columns of a matrix that is computed entry by entry."""


def unpack(a: FloatArray) -> Matrix:
    """Entries of (axes, n, m), or of one (n, m) for all axes."""
    if a.ndim == 2:
        return list(a.tolist())
    # One matrix that is broadcast (stride zero) counts as one, too.
    if a.strides[0] == 0 or len(a) == 1:
        return list(a[0].tolist())
    return [[a[:, i, j] for j in range(a.shape[2])] for i in range(a.shape[1])]


def columns(x: FloatArray) -> list[Entry]:
    """Entries of vectors (axes, n)."""
    return list(x[0].tolist()) if len(x) == 1 else [x[:, i] for i in range(x.shape[1])]


def pack(matrix: Matrix, axes: int) -> FloatArray:
    """(axes, n, m), contiguous in memory along the axes."""
    out = np.empty((len(matrix), len(matrix[0]), axes))
    for i, row in enumerate(matrix):
        for j, entry in enumerate(row):
            out[i, j] = entry
    return out.transpose(2, 0, 1)


def pack_vector(x: Sequence[Entry], axes: int) -> FloatArray:
    """(axes, n), contiguous in memory along the axes."""
    out = np.empty((len(x), axes))
    for i, entry in enumerate(x):
        out[i] = entry
    return out.T


def pack_one(x: Entry, axes: int) -> FloatArray:
    """(axes,)"""
    return x if isinstance(x, np.ndarray) else np.full(axes, x)


def dot_of_entries(x: Sequence[Entry], y: Sequence[Entry]) -> Entry:
    """x[0] * y[0] + x[1] * y[1] + ..., in this order."""
    total = x[0] * y[0]
    if len(x) > 1:
        total += x[1] * y[1]
    for k in range(2, len(x)):
        total += x[k] * y[k]
    return total


def times_vector(a: Matrix, x: Sequence[Entry]) -> list[Entry]:
    """A x"""
    return [dot_of_entries(row, x) for row in a]


def add(x: Sequence[Entry], y: Sequence[Entry]) -> list[Entry]:
    """x + y"""
    return [x[k] + y[k] for k in range(len(x))]


def transpose_of_entries(a: Matrix) -> Matrix:
    """A'"""
    return [[row[j] for row in a] for j in range(len(a[0]))]


def times_transposed(a: Matrix, b: Matrix) -> Matrix:
    """A B'"""
    return [[dot_of_entries(row, other) for other in b] for row in a]


def symmetric_times_transposed(a: Matrix, b: Matrix, plus: Matrix | None = None) -> Matrix:
    """A B' + plus where that is symmetric: one half of it is the other."""
    out: Matrix = []
    for i, row in enumerate(a):
        upper = [dot_of_entries(row, other) for other in b[i:]]
        out.append([*(above[i] for above in out), *(add(upper, plus[i][i:]) if plus else upper)])
    return out


def congruence_by_numbers(a: Sequence[Sequence[float]], p: Matrix, plus: Matrix) -> Matrix:
    """A P A' + plus, P and plus symmetric, A of numbers for all axes: the products of its entries are numbers, too."""
    n = len(p)
    upper = [p[k][m] for k in range(n) for m in range(k, n)]
    out: Matrix = [[0.0] * len(a) for _ in a]
    for i, row in enumerate(a):
        for j, other in enumerate(a[: i + 1]):
            share = [row[k] * other[m] + (row[m] * other[k] if m > k else 0.0) for k in range(n) for m in range(k, n)]
            out[i][j] = out[j][i] = dot_of_entries(share, upper) + plus[i][j]
    return out


def one_minus(a: Matrix) -> Matrix:
    """I - A"""
    return [[1.0 - x if i == j else -x for j, x in enumerate(row)] for i, row in enumerate(a)]


def reciprocal(x: Entry) -> Entry:
    """1 / x, infinite for zero, as it is for arrays."""
    return 1.0 / x if not isinstance(x, float) or x else math.inf


def inverse_of_entries(a: Matrix) -> Matrix:
    """Inverse of symmetric positive definite matrices."""
    if len(a) == 1:
        return [[reciprocal(a[0][0])]]
    (p, q), (_, r) = a
    scale = reciprocal(p * r - q * q)
    off = -q * scale
    return [[r * scale, off], [off, p * scale]]
