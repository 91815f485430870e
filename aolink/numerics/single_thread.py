"""Linear algebra of large matrices by one thread of BLAS.

So no bit depends on the number of cores, and nothing waits for a second core that is busy elsewhere: on a loaded
machine OpenBLAS's threads take a second over what takes 10 ms alone.
"""

from __future__ import annotations

from contextlib import ContextDecorator
from functools import lru_cache
from threading import RLock
from typing import Any

import numpy as np
import scipy
from threadpoolctl import ThreadpoolController

from aolink.numerics.arrays import FloatArray

# A matrix with a smaller share of nonzero entries than this is multiplied as a sparse one.
_SPARSE = 0.05


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


class _ByOneThread(ContextDecorator):
    """A context in which BLAS has one thread. One thread at a time may be inside, because that number is the
    process's."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._depth = 0
        self._limit: Any = None

    def __enter__(self) -> None:
        self._lock.acquire()
        self._depth += 1
        if self._depth == 1:
            self._limit = _libraries().limit(limits=1, user_api="blas")
            self._limit.__enter__()

    def __exit__(self, *raised: object) -> None:
        try:
            if self._depth == 1:
                self._limit.__exit__(*raised)
        finally:
            self._depth -= 1
            self._lock.release()


by_one_thread = _ByOneThread()


@by_one_thread
def matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, k) @ (k, m), or @ (k,)"""
    return np.asarray(a @ b)


@by_one_thread
def gram(a: FloatArray) -> FloatArray:
    """a' a, (n, m) -> (m, m), symmetric to the last bit."""
    return np.asarray(a.T @ a)


@by_one_thread
def congruence(a: FloatArray, p: FloatArray) -> FloatArray:
    """a p a' for a symmetric p, (m, n) and (n, n) -> (m, m); ``a`` is treated as sparse where few entries are not zero.

    Rows of ``p`` at its end that are those of the identity cost next to nothing.
    """
    if np.count_nonzero(a) <= _SPARSE * a.size:
        entries = scipy.sparse.csr_array(a)
        return np.asarray(entries @ np.ascontiguousarray((entries @ p).T))
    touched = np.flatnonzero((p != np.eye(len(p))).any(axis=1))
    k = int(touched[-1]) + 1 if len(touched) else 0
    own, rest = a[:, :k], a[:, k:]
    few = np.count_nonzero(own, axis=0) <= _SPARSE * len(own)
    entries, full = scipy.sparse.csr_array(own[:, few]), own[:, ~few]
    half = entries @ p[:k, :k][few] + full @ p[:k, :k][~few]
    return np.asarray((entries @ half[:, few].T).T + half[:, ~few] @ full.T + rest @ rest.T)


@by_one_thread
def inverse_root(a: FloatArray) -> FloatArray:
    """L^-1 of a symmetric positive definite a = L L', so that a^-1 = L^-1' L^-1, (n, n), lower triangular.

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.
    """
    W, _ = scipy.linalg.lapack.dtrtri(_root(a), lower=1, overwrite_c=1)
    return np.asarray(W)


@by_one_thread
def inverse(a: FloatArray) -> FloatArray:
    """Inverse of a symmetric positive definite matrix, symmetric to the last bit; raises as `inverse_root`."""
    lower, _ = scipy.linalg.lapack.dpotri(_root(a), lower=1, overwrite_c=1)
    whole = lower + lower.T
    np.fill_diagonal(whole, np.diagonal(lower))
    return np.asarray(whole)


@by_one_thread
def solve(a: FloatArray, x: FloatArray) -> FloatArray:
    """a^-1 x of a symmetric positive definite matrix, (n,); raises as `inverse_root`."""
    found, _ = scipy.linalg.lapack.dpotrs(_root(a), x, lower=1)
    return np.asarray(found)


def _root(a: FloatArray) -> FloatArray:
    """L, zero above its diagonal, in Fortran's order."""
    L, flaw = scipy.linalg.lapack.dpotrf(a.T, lower=1, clean=1)
    if flaw:
        raise np.linalg.LinAlgError(f"not positive definite: the leading {flaw} rows have no root")
    return np.asarray(L)
