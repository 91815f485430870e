"""The gain that the centroid filter o1 settles at: the Riccati equation."""

from __future__ import annotations

import numpy as np

from aolink.estimation.model.base import ExposureModel
from aolink.numerics.arrays import FloatArray
from aolink.numerics.batched import symmetric
from aolink.numerics.single_thread import by_one_thread

# Steps that double the number of exposures: what has not settled after a million does not. Relative changes of a
# covariance below the second number are rounding.
_DOUBLINGS = 20
_SETTLED = 1e-13


@by_one_thread
def steady_gain(model: ExposureModel, Q: FloatArray, R: FloatArray) -> FloatArray | None:
    """Steady-state gain of the centroid filter on the lifted plant (A^N, C-bar), (n_states, n_outputs).

    It corrects the state at the start of the exposure with that exposure's centroid. None where the Riccati equation
    has no stabilising solution: the centroid does not observe an eigenmode that does not decay. R is the covariance of
    the centroids as blocks along its diagonal, (blocks, size, size), or whole.
    """
    H, n = model.mean_row, model.mean_row.shape[1]
    R = R if R.ndim == 3 else R[None]
    weighted = np.linalg.solve(R, H.reshape(*R.shape[:2], n)).reshape(len(H), n)
    information = symmetric(H.T @ weighted)
    try:
        P = _settled_covariance(model.transition, information, Q)
        return np.asarray(np.linalg.solve(np.eye(n) + P @ information, P @ weighted.T))
    except np.linalg.LinAlgError:
        return None


def _settled_covariance(A: FloatArray, information: FloatArray, Q: FloatArray) -> FloatArray:
    """The covariance that predictions settle at, by the structure-preserving doubling algorithm (Chu, Fan, Lin, Wang,
    Int. J. Control 77 (2004) 767): its k-th step is that of 2^k exposures.

    Raises numpy.linalg.LinAlgError where there is none.
    """
    A, G, P = A.T, information, Q
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_DOUBLINGS):
            left = np.linalg.solve(np.eye(len(A)) + G @ P, np.concatenate([A, G], axis=1))
            through, kept = left[:, : len(A)], left[:, len(A) :]
            before, P = P, symmetric(P + A.T @ P @ through)
            A, G = A @ through, symmetric(G + A @ kept @ A.T)
            if np.abs(P - before).max() <= _SETTLED * np.abs(P).max():
                return P
    raise np.linalg.LinAlgError("the covariance grows without end")
