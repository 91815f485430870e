"""The update of a Kalman filter, in the forms in which it is computed. They agree to rounding.

`aolink.estimation.kalman.path_moments` chooses between them by the sizes: in blocks, or in information form
(`aolink.estimation.kalman.information_form`). The row `update_forms` of tools/bench times each beside Joseph's.
"""

from __future__ import annotations

import numpy as np

from aolink.estimation.kalman.gaussian import MOST_COVARIANCES, Gaussian, Update
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray


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


def blocked_update(
    prior: Gaussian, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None = None
) -> Update:
    """`joseph_update` for few states and many measurements, whose noise is shared within blocks only.

    With G = H' R^-1 H and M = (I + P G)^-1 P, the optimal gain is M H' R^-1 and S^-1 y = R^-1 (y - H K y): nothing has
    more rows than there are states, and P may be singular. Where S is large, only its diagonal is computed. R is
    (axes, blocks, size, size).
    """
    axes, blocks, size, _ = R.shape
    n = prior.mean.shape[1]
    H, y = H.reshape(axes, blocks, size, n), innovation.reshape(axes, blocks, size, 1)
    P, transposed = prior.covariance, batched.transpose(H)
    weighted = np.linalg.solve(R, np.concatenate([H, y], axis=3))
    # Sums over blocks of products as small as these do not depend on threads.
    G = batched.symmetric((transposed @ weighted[..., :n]).sum(axis=1))
    M = batched.symmetric(np.asarray(np.linalg.solve(np.eye(n) + P @ G, P)))
    optimal = (M @ (transposed @ weighted[..., n:]).sum(axis=1))[..., 0]
    if gain is None:
        moved, keep, from_noise = optimal, np.eye(n) - M @ G, batched.congruence(M, G)
    else:
        K = np.moveaxis(gain.reshape(-1, n, blocks, size), 2, 1)  # (1 or axes, blocks, n, size)
        moved = (K @ y).sum(axis=1)[..., 0]
        keep = np.eye(n) - (K @ H).sum(axis=1)
        from_noise = (K @ R @ batched.transpose(K)).sum(axis=1)
    covariance = batched.symmetric(batched.congruence(keep, P) + from_noise)
    left = y - H @ optimal[:, None, :, None]
    nis = (weighted[..., n:] * left).sum(axis=(1, 2, 3))
    m = blocks * size
    flat = H.reshape(axes, m, n)
    if m > MOST_COVARIANCES:
        S = (flat @ P * flat).sum(axis=2) + np.einsum("abss->abs", R).reshape(axes, m)
    else:
        S = flat @ P @ batched.transpose(flat)
        for k in range(blocks):
            some = slice(k * size, (k + 1) * size)
            S[:, some, some] += R[:, k]
    return Update(Gaussian(prior.mean + moved, covariance), innovation, S, nis)
