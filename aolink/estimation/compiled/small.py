"""Matrices of a dozen rows, one at a time, in compiled code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def compiled(function: Callable[..., Any]) -> Any:
    """Decorator of a function that runs as machine code, which is kept for the next process if there is a place."""
    options: Any = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "arcp"}}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # neither the source's folder nor the user's cache can be written
        return numba.njit(**options)(function)


_JITTER = 1e-10


@compiled
def cholesky(a: FloatArray, root: FloatArray) -> None:
    """A lower triangular root, (n, n), of what may be singular, from its lower half.

    As `aolink.estimation.hypotheses.cholesky`.
    """
    n = len(a)
    largest = 0.0
    for i in range(n):
        largest = max(largest, a[i, i])
    for j in range(n):
        for i in range(j):
            root[i, j] = 0.0
        total = a[j, j] * (1.0 + _JITTER) + 1e-14 * largest + 1e-300
        for k in range(j):
            total -= root[j, k] * root[j, k]
        pivot = math.sqrt(total) if total > 0.0 else math.nan
        root[j, j] = pivot
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total / pivot


@compiled
def lower_inverse(root: FloatArray, out: FloatArray) -> None:
    """Inverse of a lower triangular matrix."""
    n = len(root)
    for j in range(n):
        for i in range(j):
            out[i, j] = 0.0
        out[j, j] = 1.0 / root[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= root[i, k] * out[k, j]
            out[i, j] = total / root[i, i]


@compiled
def solve(root: FloatArray, x: FloatArray) -> None:
    """(R R')^-1 x in the place of x, (n,)."""
    n = len(root)
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= root[i, k] * x[k]
        x[i] = total / root[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= root[k, i] * x[k]
        x[i] = total / root[i, i]


@compiled
def times(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """A B; columns of ``out`` beyond those of B are left alone."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
        for k in range(a.shape[1]):
            x = a[i, k]
            for j in range(b.shape[1]):
                out[i, j] += x * b[k, j]


@compiled
def log_sum(values: FloatArray) -> float:
    """log sum exp of (n,); minus infinity where all are."""
    top = -math.inf
    for x in values:
        top = max(top, x)
    if top == -math.inf or top != top:
        return top
    total = 0.0
    for x in values:
        if x > -math.inf:
            total += math.exp(x - top)
    return top + math.log(total)
