"""Updates of a plant with hundreds of states, in information form: posterior = (P^-1 + H' R^-1 H)^-1.

The information that frames add is a sum over spots, of which each knows its own noise; nothing is as large as
measurements times measurements. All products are those of `aolink.numerics.single_thread`.
"""

from __future__ import annotations

import numpy as np

from aolink.numerics import single_thread
from aolink.numerics.arrays import FloatArray
from aolink.numerics.information import information, inverse_root

# A gain settles within this many exposures, or there is none; relative changes of a covariance below this are rounding.
_MOST_EXPOSURES = 1000
_SETTLED = 1e-11


def update(
    mean: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """One step of a Kalman filter for one axis, y the innovation, with the optimal gain or another one.

    Parameters
    ----------
    R:
        Blocks along the diagonal, (blocks, size, size).

    Returns
    -------
    Mean and covariance after it, the diagonal of the innovation covariance, and the NIS.
    """
    blocks, size, _ = R.shape
    m, n = H.shape
    white = np.linalg.inv(np.linalg.cholesky(R))
    H_white = (white @ H.reshape(blocks, size, n)).reshape(m, n)
    y_white = (white @ y.reshape(blocks, size, 1)).ravel()
    W = inverse_root(information(P) + single_thread.gram(H_white))
    score = single_thread.matmul(H_white.T, y_white)
    covariance = single_thread.gram(W)
    moved = single_thread.matmul(covariance, score)
    nis = np.asarray(y_white @ y_white - score @ moved)
    S = (single_thread.matmul(H, P) * H).sum(axis=1) + np.einsum("bss->bs", R).ravel()
    if gain is not None:
        moved = single_thread.matmul(gain, y)
        keep = np.eye(n) - single_thread.matmul(gain, H)
        told = (gain.reshape(n, blocks, size).swapaxes(0, 1) @ R).swapaxes(0, 1).reshape(n, m)
        covariance = single_thread.congruence(keep, P) + single_thread.matmul(told, np.ascontiguousarray(gain.T))
        covariance = (covariance + covariance.T) / 2
    return mean + moved, covariance, S, nis


def steady_gain(A: FloatArray, H: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray | None:
    """The gain that a Kalman filter settles at, (n_states, m); None where it does not settle.

    The Riccati equation stepped from exposure to exposure: a second for 288 states of a plant that forgets its state
    within a few exposures.

    Parameters
    ----------
    R:
        Blocks along the diagonal, (blocks, size, size).
    """
    blocks, size, _ = R.shape
    weighted = np.asarray(np.linalg.solve(R, H.reshape(blocks, size, -1)), dtype=np.float64).reshape(len(H), -1)
    told = single_thread.matmul(np.ascontiguousarray(H.T), weighted)
    told, P = (told + told.T) / 2, Q
    for _ in range(_MOST_EXPOSURES):
        before, after = P, single_thread.inverse(information(P) + told)
        P = single_thread.congruence(A, after) + Q
        P = (P + P.T) / 2
        if np.abs(P - before).max() <= _SETTLED * np.abs(P).max():
            return single_thread.matmul(after, np.ascontiguousarray(weighted.T))
    return None
