"""Information matrices, the inverses of covariances, which may be singular. BLAS uses one thread."""

from __future__ import annotations

import numpy as np

from aolink.numerics import single_thread
from aolink.numerics.arrays import FloatArray

# Added to the diagonal, relative to each variance: a state that the prior determines exactly stays exact to this
# accuracy.
_JITTER = 1e-10


def information(covariance: FloatArray) -> FloatArray:
    """Inverse of a covariance that may be singular, (n, n)."""
    sd = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    sd = np.where(sd > 0, sd, 1.0)
    scaled = covariance / sd / sd[:, None]
    np.fill_diagonal(scaled, np.diagonal(scaled) + _JITTER)
    return np.asarray(single_thread.inverse(scaled) / sd / sd[:, None])


def inverse_root(precision: FloatArray) -> FloatArray:
    """Matrix W with W' W the covariance of an information matrix, (n, n); the information matrix is first scaled to a
    diagonal of one."""
    scale = 1 / np.sqrt(np.diagonal(precision))
    return np.asarray(single_thread.inverse_root(precision * scale * scale[:, None]) * scale)


def covariance(precision: FloatArray) -> FloatArray:
    """Inverse of an information matrix, scaled as in `inverse_root`."""
    scale = 1 / np.sqrt(np.diagonal(precision))
    return np.asarray(single_thread.inverse(precision * scale * scale[:, None]) * scale * scale[:, None])


def solve(precision: FloatArray, score: FloatArray) -> FloatArray:
    """The vector precision^-1 score, scaled as in `inverse_root`."""
    scale = 1 / np.sqrt(np.diagonal(precision))
    return single_thread.solve(precision * scale * scale[:, None], score * scale) * scale
