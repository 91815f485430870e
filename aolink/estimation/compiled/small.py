"""Matrices of a dozen rows, one at a time, in compiled code.

The rows `moments_of_many_axes` and `profile_of_many_axes` of tools/bench need it beside `aolink.numerics`, whose
factorisations are LAPACK's: of one matrix of hundreds of rows (`single_thread`), or of a batch at once, from Python
(`covariance`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba

from aolink.estimation.compiled.kept import folder
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import JITTER


def compiled(function: Callable[..., Any]) -> Any:
    """Decorator of a function that runs as machine code, which is kept for the next process where it can be."""
    return _compiled(function, {"contract", "arcp"})


def inlined(function: Callable[..., Any]) -> Any:
    return numba.njit(nogil=True, error_model="numpy", fastmath={"contract", "arcp"}, inline="always")(function)


def compiled_sums(function: Callable[..., Any]) -> Any:
    """Decorator as `compiled`, for a function with long sums whose order does not matter: several terms are added at a
    time."""
    return _compiled(function, {"contract", "arcp", "reassoc", "nsz"})


def _compiled(function: Callable[..., Any], freedom: set[str]) -> Any:
    options: Any = {"nogil": True, "error_model": "numpy", "fastmath": freedom}
    if (kept := folder()) is None:
        return numba.njit(**options)(function)
    settings: Any = numba.config
    before, settings.CACHE_DIR = settings.CACHE_DIR, str(kept)  # Numba reads it when a function is decorated
    try:
        return numba.njit(cache=True, **options)(function)
    finally:
        settings.CACHE_DIR = before


# Most sweeps of Jacobi's method, which ends where the squares off the diagonal are this share of those on it.
_SWEEPS = 30
_ROUNDING = 1e-28


@inlined
def cholesky_into(a: FloatArray, root: FloatArray) -> None:
    """Lower triangular root, (n, n), of a covariance that may be singular, from its lower half.

    As `aolink.numerics.covariance.cholesky`; NaN where the matrix has no root.
    """
    n = len(a)
    largest = 0.0
    for i in range(n):
        largest = max(largest, a[i, i])
    for j in range(n):
        root[j, j] = a[j, j] * (1.0 + JITTER) + 1e-14 * largest + 1e-300
    for j in range(n):
        for i in range(j):
            root[i, j] = 0.0
        total = root[j, j]
        for k in range(j):
            total -= root[j, k] * root[j, k]
        root[j, j] = pivot = math.sqrt(total) if total > 0.0 else math.nan
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total / pivot


@compiled
def lower_inverse_into(root: FloatArray, out: FloatArray) -> None:
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
def cholesky_solve(root: FloatArray, x: FloatArray) -> None:
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
def decay(x: float) -> float:
    """exp(x) for x <= 0, to a relative 3e-9; exp(-40) = 4e-18 for x < -40.

    Unlike the library's exp it is nothing but products, so that several are computed at a time.
    """
    y = (-40.0 if x < -40.0 else x) * (1.0 / 256.0)
    p = 1.0 + y * (1 + y * (1 / 2 + y * (1 / 6 + y * (1 / 24 + y * (1 / 120 + y * (1 / 720 + y * (1 / 5040)))))))
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    return p * p


@compiled
def lower_solve(root: FloatArray, x: FloatArray) -> None:
    """R^-1 x in the place of x, (n,)."""
    for i in range(len(root)):
        total = x[i]
        for k in range(i):
            total -= root[i, k] * x[k]
        x[i] = total / root[i, i]


@compiled
def eigh(a: FloatArray, values: FloatArray, vectors: FloatArray) -> None:
    """Eigenvalues of a symmetric matrix (n, n), the largest first, and its eigenvectors as rows, by Jacobi's method.

    The matrix itself is made diagonal.
    """
    n = len(a)
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        beside = whole = 0.0
        for i in range(n):
            for j in range(i):
                beside += a[i, j] * a[i, j]
            whole += a[i, i] * a[i, i]
        if not beside > _ROUNDING * whole:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                t = t if theta >= 0.0 else -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(n):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                for k in range(n):
                    x, y = vectors[p, k], vectors[q, k]
                    vectors[p, k], vectors[q, k] = c * x - s * y, s * x + c * y
    for i in range(n):
        values[i] = a[i, i]
    for i in range(n - 1):
        largest = i
        for j in range(i + 1, n):
            if values[j] > values[largest]:
                largest = j
        if largest != i:
            values[i], values[largest] = values[largest], values[i]
            for k in range(n):
                vectors[i, k], vectors[largest, k] = vectors[largest, k], vectors[i, k]
