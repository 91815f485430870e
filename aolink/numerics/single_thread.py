"""Linear algebra of large matrices by one thread of BLAS.

So no bit depends on the number of cores, and nothing waits for a second core that is busy elsewhere: on a loaded
machine OpenBLAS's threads take a second over what takes 10 ms alone (row `membrane_in_real_time` of tools/bench).
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
from aolink.numerics.covariance import JITTER

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
def matmul_one_thread(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, k) @ (k, m), or @ (k,)"""
    return np.asarray(a @ b)


@by_one_thread
def gram(a: FloatArray) -> FloatArray:
    """a' a, (n, m) -> (m, m), symmetric to the last bit."""
    return np.asarray(a.T @ a)


@by_one_thread
def congruence_one_thread(a: FloatArray, p: FloatArray) -> FloatArray:
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
def inverse_by_cholesky(a: FloatArray) -> FloatArray:
    """Inverse of a symmetric positive definite matrix, symmetric to the last bit.

    Raises `numpy.linalg.LinAlgError` where the matrix is not positive definite.
    """
    lower, _ = scipy.linalg.lapack.dpotri(_cholesky_factor(a), lower=1, overwrite_c=1)
    whole = lower + lower.T
    np.fill_diagonal(whole, np.diagonal(lower))
    return np.asarray(whole)


def information_matrix(covariance: FloatArray) -> FloatArray:
    """Inverse of a covariance that may be singular, (n, n)."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    sd = np.where(sd > 0, sd, 1.0)
    scaled = covariance / sd / sd[:, None]
    np.fill_diagonal(scaled, np.diagonal(scaled) + JITTER)
    return np.asarray(inverse_by_cholesky(scaled) / sd / sd[:, None])


@by_one_thread
def root_of_covariance(covariance: FloatArray) -> FloatArray:
    """L with L L' a covariance that may be singular, (n, rank), by Cholesky's method with pivots."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale = np.where(sd > 0, sd, 1.0)
    L, order, rank, _ = scipy.linalg.lapack.dpstrf(covariance / scale / scale[:, None], lower=1)
    root = np.empty((len(L), rank))
    root[order - 1] = np.tril(L[:, :rank])
    return np.asarray(root * scale[:, None])


def covariance_of_information(precision: FloatArray) -> FloatArray:
    """Inverse of an information matrix, (n, n), which is scaled to a diagonal of one before."""
    scaled, scale = _scaled(precision)
    return np.asarray(inverse_by_cholesky(scaled) * scale * scale[:, None])


@by_one_thread
def root_of_information(precision: FloatArray) -> FloatArray:
    """W with W' W the covariance of an information matrix, (n, n); scaled and raises as `covariance_of_information`."""
    scaled, scale = _scaled(precision)
    W, _ = scipy.linalg.lapack.dtrtri(_cholesky_factor(scaled), lower=1, overwrite_c=1)
    return np.asarray(W * scale)


@by_one_thread
def solve_information(precision: FloatArray, score: FloatArray) -> FloatArray:
    """precision^-1 score, (n,), scaled and raises as `covariance_of_information`."""
    scaled, scale = _scaled(precision)
    found, _ = scipy.linalg.lapack.dpotrs(_cholesky_factor(scaled), score * scale, lower=1)
    return np.asarray(found * scale)


def _scaled(precision: FloatArray) -> tuple[FloatArray, FloatArray]:
    scale = 1 / np.sqrt(np.diagonal(precision))
    return precision * scale * scale[:, None], scale


def _cholesky_factor(a: FloatArray) -> FloatArray:
    """L with a = L L', zero above its diagonal, in Fortran's order."""
    # LAPACK works by blocks, which hundreds of rows need. Compiled loops over matrices of a dozen rows, for which a
    # call of LAPACK takes longer than the arithmetic, have `aolink.estimation.compiled.small` (its rows say so).
    L, flaw = scipy.linalg.lapack.dpotrf(a.T, lower=1, clean=1)
    if flaw:
        raise np.linalg.LinAlgError(f"not positive definite: the leading {flaw} rows have no root")
    return np.asarray(L)
