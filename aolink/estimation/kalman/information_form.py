"""Updates of a plant with hundreds of states, in information form: posterior = (P^-1 + H' R^-1 H)^-1.

The information that frames add is a sum over spots, of which each knows its own noise; nothing is as large as
measurements times measurements (row `membrane_in_real_time` of tools/bench).
"""

from __future__ import annotations

import numpy as np

from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.numerics.arrays import FloatArray
from aolink.numerics.batched import symmetric
from aolink.numerics.single_thread import (
    congruence_one_thread,
    gram,
    information_matrix,
    matmul_one_thread,
    root_of_information,
)


def information_update(
    prior: Gaussian, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None
) -> Update:
    """`blocked_update` for many states, axis by axis; only the innovation covariance's diagonal is computed."""
    axes = len(innovation)
    gains = [None] * axes if gain is None else np.broadcast_to(gain, (axes, *gain.shape[-2:]))
    every = map(_updated, prior.mean, prior.covariance, innovation, H, R, gains)
    mean, covariance, S, nis = (np.stack(each) for each in zip(*every, strict=True))
    return Update(Gaussian(mean, covariance), innovation, S, nis)


def _updated(
    mean: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """One axis, y its innovation, with the optimal gain or another one; R are blocks along the diagonal, (blocks, size,
    size).

    Returns mean and covariance after it, the diagonal of the innovation covariance, and the NIS.
    """
    blocks, size, _ = R.shape
    m, n = H.shape
    white = np.linalg.inv(np.linalg.cholesky(R))
    H_white = (white @ H.reshape(blocks, size, n)).reshape(m, n)
    y_white = (white @ y.reshape(blocks, size, 1)).ravel()
    W = root_of_information(information_matrix(P) + gram(H_white))
    score = matmul_one_thread(H_white.T, y_white)
    covariance = gram(W)
    moved = matmul_one_thread(covariance, score)
    nis = np.asarray(y_white @ y_white - score @ moved)
    S = (matmul_one_thread(H, P) * H).sum(axis=1) + np.einsum("bss->bs", R).ravel()
    if gain is not None:
        moved = matmul_one_thread(gain, y)
        keep = np.eye(n) - matmul_one_thread(gain, H)
        gain_R = (gain.reshape(n, blocks, size).swapaxes(0, 1) @ R).swapaxes(0, 1).reshape(n, m)
        covariance = congruence_one_thread(keep, P) + matmul_one_thread(gain_R, np.ascontiguousarray(gain.T))
        covariance = symmetric(covariance)
    return mean + moved, covariance, S, nis
