"""Block-diagonal systems: a mirror's actuators are many small systems side by side, and most of them are equal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from aolink.numerics.arrays import FloatArray, Indices

_MANY = 10
"""With this many states or more, a stationary covariance is not found by linear equations for its entries."""


def components(*matrices: FloatArray) -> list[Indices]:
    """Connected components: the states that square matrices (n, n) couple, for each block of all of them."""
    linked = np.any([matrix != 0 for matrix in matrices], axis=0)
    linked |= linked.T
    parts: list[Indices] = []
    seen = np.zeros(len(linked), dtype=bool)
    for state in range(len(linked)):
        if seen[state]:
            continue
        part, front = np.zeros_like(seen), np.array([state])
        while len(front):
            part[front] = True
            front = np.flatnonzero(linked[front].any(axis=0) & ~part)
        seen |= part
        parts.append(np.flatnonzero(part))
    return parts


def blockwise(
    function: Callable[..., tuple[FloatArray, ...]], matrices: tuple[FloatArray, ...], parts: list[Indices]
) -> tuple[FloatArray, ...]:
    """Apply a function of square matrices to each component by itself, only once for equal ones."""
    if len(parts) == 1:
        return function(*matrices)
    known: dict[bytes, tuple[FloatArray, ...]] = {}
    whole: tuple[FloatArray, ...] = ()
    for part in parts:
        blocks = [np.ascontiguousarray(matrix[np.ix_(part, part)]) for matrix in matrices]
        key = b"".join(block.tobytes() for block in blocks)
        if key not in known:
            known[key] = function(*blocks)
        whole = whole or tuple(np.zeros_like(matrices[0]) for _ in known[key])
        for out, block in zip(whole, known[key], strict=True):
            out[np.ix_(part, part)] = block
    return whole


def alike(A: FloatArray, *columns: FloatArray) -> Indices | None:
    """States of block-diagonal systems that are all equal, each with one column of its own in other matrices.

    In the result, (systems, n), system a has the states ``order[a]``, and column a of each of ``columns``, (n_states,
    systems). None where A has no such blocks.
    """
    parts = components(A)
    if len({len(part) for part in parts}) > 1 or any(each.shape[1] != len(parts) for each in columns):
        return None
    order = np.stack(parts)
    blocks = A[order[:, :, None], order[:, None, :]]
    own = [np.stack([each[part, a] for a, part in enumerate(parts)]) for each in columns]
    whole = all(np.count_nonzero(each) == np.count_nonzero(mine) for each, mine in zip(columns, own, strict=True))
    return order if whole and all((each == each[0]).all() for each in (blocks, *own)) else None


def stationary_covariance(A: FloatArray, Q: FloatArray) -> FloatArray:
    """P with P = A P A' + Q (discrete Lyapunov equation) for a stable A, (n, n).

    For a few states it is solved as n^2 linear equations, (I - A (x) A) vec P = vec Q, as SciPy does it for them.
    """

    def solved(A: FloatArray, Q: FloatArray) -> tuple[FloatArray, ...]:
        n = len(A)
        if n < _MANY:
            P = np.linalg.solve(np.eye(n * n) - np.kron(A, A), Q.ravel()).reshape(n, n)
        else:
            P = scipy.linalg.solve_discrete_lyapunov(A, Q)
        return (np.asarray(P, dtype=np.float64),)

    return blockwise(solved, (A, Q), components(A, Q))[0]


def eigenvalues(A: FloatArray, parts: list[Indices]) -> NDArray[np.complex128]:
    """Eigenvalues of A, (k,), those of equal components only once."""
    blocks = {block.tobytes(): block for block in (np.ascontiguousarray(A[np.ix_(part, part)]) for part in parts)}
    return np.concatenate([np.linalg.eigvals(block) for block in blocks.values()]).astype(np.complex128)


def null_space(
    A: FloatArray, value: complex, parts: list[Indices], tolerance: float, *, left: bool = False, power: int = 1
) -> NDArray[np.complex128]:
    """Orthonormal basis of the (left) null space of (A - value I)^power, (n, k): for power 1, the eigenvectors."""
    known: dict[bytes, NDArray[np.complex128]] = {}
    columns: list[tuple[Indices, NDArray[np.complex128]]] = []
    for part in parts:
        block = np.ascontiguousarray(A[np.ix_(part, part)])
        key = block.tobytes()
        if key not in known:
            pencil = np.linalg.matrix_power(value * np.eye(len(block)) - block, min(power, len(block)))
            _, sizes, rows = np.linalg.svd(pencil.conj().T if left else pencil)
            known[key] = rows[sizes <= tolerance].conj().T
        if known[key].size:
            columns.append((part, known[key]))
    out = np.zeros((len(A), sum(vectors.shape[1] for _, vectors in columns)), dtype=np.complex128)
    first = 0
    for part, vectors in columns:
        out[part, first : first + vectors.shape[1]] = vectors
        first += vectors.shape[1]
    return out
