"""Products of large matrices in pieces so small that no library shares them among threads.

So no bit depends on the number of threads, and nothing waits for a second core that is busy elsewhere: on a loaded
machine OpenBLAS's threads take a second over what takes 10 ms alone. In pieces it takes as long as by one
thread in one piece.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

FloatArray = NDArray[np.float64]

# OpenBLAS shares products of more than 262144 multiplications.
_MOST = 131_072
_ROWS = 24
_SIDE = 48
_STRIP = 192
# A matrix with fewer entries than this share is multiplied by its entries.
_SPARSE = 0.05


def matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, k) @ (k, m)"""
    (n, k), m = a.shape, b.shape[1]
    if min(n, m) == 1:  # BLAS has functions of their own for vectors, which it shares among threads sooner
        return np.asarray(np.einsum("nk,km->nm", a, b))
    out = np.zeros((n, m)) if not k else np.empty((n, m))
    if not out.size or not k:
        return out
    # Pieces are views: nothing is copied.
    columns = max(8, _MOST // (_ROWS * k) // 8 * 8)
    for some, height in _strips(n, _ROWS):
        left = a[some].reshape(-1, 1, height, k)
        for others, width in _strips(m, columns):
            right = b[:, others].reshape(k, -1, width).swapaxes(0, 1)
            np.matmul(left, right, out=out[some, others].reshape(len(left), height, -1, width).swapaxes(1, 2))
    return out


def _strips(length: int, side: int) -> list[tuple[slice, int]]:
    """Whole pieces of a length, and what is left of it, which is more than one; each with its pieces' side."""
    whole = length // side * side
    if length - whole == 1 and whole:
        whole -= side
    return [(some, step) for some, step in ((slice(0, whole), side), (slice(whole, length), length - whole))
            if some.stop > some.start]  # fmt: skip


def gram(a: FloatArray) -> FloatArray:
    """a' a, (n, m) -> (m, m): half of it, and the other half by symmetry."""
    m = a.shape[1]
    out = np.empty((m, m))
    transposed = np.ascontiguousarray(a.T)
    for first in range(0, m, _STRIP):
        last = min(first + _STRIP, m)
        out[first:last, :last] = matmul(transposed[first:last], a[:, :last])
        out[:first, first:last] = out[first:last, :first].T
        own = np.tril(out[first:last, first:last])
        out[first:last, first:last] = own + np.tril(own, -1).T
    return out


def matvec(a: FloatArray, x: FloatArray) -> FloatArray:
    """(n, k) @ (k,)"""
    return np.asarray(np.einsum("nk,k->n", a, x))


def congruences(a: FloatArray, p: FloatArray) -> FloatArray:
    """`congruence` of many, p (axes, n, n)."""
    return np.stack([congruence(a, each) for each in p])


def congruence(a: FloatArray, p: FloatArray) -> FloatArray:
    """a p a' of a symmetric p, by the entries of ``a`` where they are few."""
    if np.count_nonzero(a) <= _SPARSE * a.size:
        entries = csr_array(a)
        return np.asarray(entries @ np.ascontiguousarray((entries @ p).T))
    return matmul(a, matmul(p, np.ascontiguousarray(a.T)))


def inverse_root(a: FloatArray) -> FloatArray:
    """L^-1 of a symmetric positive definite a = L L', so that a^-1 = L^-1' L^-1, (n, n), lower triangular.

    Raises
    ------
    numpy.linalg.LinAlgError
        It is not positive definite.
    """
    n = len(a)
    L, own = _cholesky(a)
    count = len(L)
    W = np.zeros_like(L)
    for i in range(count):
        W[i, i] = own[i]
        row = np.zeros((i, _SIDE, _SIDE))
        for k in range(i):
            row[: k + 1] += L[i, k] @ W[k, : k + 1]
        W[i, :i] = -own[i] @ row
    return np.ascontiguousarray(W.swapaxes(1, 2).reshape(count * _SIDE, -1)[:n, :n])


def solve(a: FloatArray, x: FloatArray) -> FloatArray:
    """a^-1 x of a symmetric positive definite matrix, (n,); raises as `inverse_root`."""
    L, own = _cholesky(a)
    y = np.zeros((len(L), _SIDE))
    y.reshape(-1)[: len(x)] = x
    for i in range(len(L)):
        y[i] = np.einsum("rc,c->r", own[i], y[i] - np.einsum("krc,kc->r", L[i, :i], y[:i]))
    for i in reversed(range(len(L))):
        y[i] = np.einsum("cr,c->r", own[i], y[i] - np.einsum("kcr,kc->r", L[i + 1 :, i], y[i + 1 :]))
    return y.reshape(-1)[: len(x)]


def _cholesky(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """L in square blocks, (k, k, side, side), those above the diagonal not zeroed; the inverses of its diagonal's."""
    n = len(a)
    count = -(-n // _SIDE)
    whole = np.eye(count * _SIDE)
    whole[:n, :n] = a
    L = np.ascontiguousarray(whole.reshape(count, _SIDE, count, _SIDE).swapaxes(1, 2))
    own = np.empty((count, _SIDE, _SIDE))
    for j in range(count):
        own[j] = np.tril(np.linalg.inv(np.linalg.cholesky(L[j, j])))
        L[j + 1 :, j] = L[j + 1 :, j] @ own[j].T
        for i in range(j + 1, count):
            L[i, j + 1 : i + 1] -= L[i, j] @ L[j + 1 : i + 1, j].swapaxes(1, 2)
    return L, own


def inverse(a: FloatArray) -> FloatArray:
    """Inverse of a symmetric positive definite matrix; raises as `inverse_root`."""
    return gram(inverse_root(a))
