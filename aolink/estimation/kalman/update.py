"""The update of a Kalman filter, in the forms in which it is computed. They agree to rounding.

Joseph's is for few measurements, the one in blocks for many; the row `update_forms` of tools/bench times both.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from aolink.estimation.kalman.gaussian import MOST_COVARIANCES, Gaussian, Update
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.numerics.batched import symmetric
from aolink.numerics.single_thread import by_one_thread, gram, root_of_covariance, root_of_information


def joseph_update(
    prior: Gaussian, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None = None
) -> Update:
    """The update of a Kalman filter in Joseph form: Mishra & Wen (18) to (20), with the innovation y - h(x), (axes, m).

    H, the Jacobian of h, is (axes or 1, m, n), also (m, n), the same for all axes; R, the covariance of the
    measurement, (axes or 1, m, m). ``gain``, (n, m), is one to use instead of the optimal one: the covariance is the
    true one with it.
    """
    R = batched.batch_last(R)
    PH = batched.matmul(prior.covariance, batched.transpose(H))
    S = batched.matmul(H, PH) + R
    S_inverse = batched.inverse(S)
    K = batched.matmul(PH, S_inverse) if gain is None else gain
    mean = prior.mean + batched.matvec(K, innovation)
    keep = np.eye(prior.mean.shape[1]) - batched.matmul(K, H)
    covariance = batched.symmetric(batched.congruence(keep, prior.covariance) + batched.congruence(K, R))
    nis = batched.dot(innovation, batched.matvec(S_inverse, innovation))
    return Update(Gaussian(mean, covariance), innovation, S, nis)


@by_one_thread
def blocked_update(
    prior: Gaussian, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None = None
) -> Update:
    """`joseph_update` for many measurements, whose noise is shared within blocks only, axis by axis.

    R is (axes, blocks, size, size). Where S is large, only its diagonal is computed.
    """
    axes, n = prior.mean.shape
    gains = [None] * axes if gain is None else np.broadcast_to(gain, (axes, n, innovation.shape[1]))
    every = map(_in_blocks, prior.covariance, innovation, H, R, gains)
    moved, covariance, S, nis = (np.stack(each) for each in zip(*every, strict=True))
    return Update(Gaussian(prior.mean + moved, covariance), innovation, S, nis)


def _in_blocks(
    P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Change of the mean, covariance, innovation covariance or its diagonal, and NIS; R is (blocks, size, size).

    With P = L L' and G = R^(-1/2) H L the covariance is L (I + G' G)^-1 L': nothing that is factored has more rows than
    there are states, and P may be singular.
    """
    blocks, size, _ = R.shape
    L = root_of_covariance(P)
    HL = H @ L
    white = np.linalg.solve(
        np.linalg.cholesky(R), np.concatenate([HL, y[:, None]], axis=1).reshape(blocks, size, -1)
    ).reshape(len(y), -1)
    G, y_white = white[:, :-1], white[:, -1]
    score = G.T @ y_white
    W = root_of_information(np.eye(L.shape[1]) + gram(G)) @ np.column_stack([L.T, score])
    nis = np.asarray(y_white @ y_white - W[:, -1] @ W[:, -1])
    if len(y) > MOST_COVARIANCES:
        S = (HL * HL).sum(axis=1) + np.einsum("bss->bs", R).ravel()
    else:
        S = gram(HL.T) + linalg.block_diag(*R)
    if gain is None:
        return W[:, :-1].T @ W[:, -1], gram(W[:, :-1]), S, nis
    kept, K = L - gain @ HL, gain.reshape(len(P), blocks, size).swapaxes(0, 1)
    return gain @ y, gram(kept.T) + symmetric((K @ R @ K.swapaxes(1, 2)).sum(axis=0)), S, nis
