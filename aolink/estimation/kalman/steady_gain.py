"""The gain that the centroid filter o1 settles at: the Riccati equation."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from aolink.estimation.kalman.information_form import stepped_gain
from aolink.estimation.model.base import ExposureModel
from aolink.numerics.arrays import FloatArray
from aolink.plant.alike import MANY_STATES

# The largest eigenvalue of a stable filter exceeds one by rounding at most.
_ROUNDING = 1e-6


def steady_gain(model: ExposureModel, Q: FloatArray, R: FloatArray) -> FloatArray | None:
    """Steady-state gain of the centroid filter on the lifted plant (A^N, C-bar), (n_states, n_outputs).

    It corrects the state at the start of the exposure with that exposure's centroid. None where the Riccati equation
    has no stabilising solution: the centroid does not observe an eigenmode that does not decay. R is the covariance of
    the centroids as blocks along its diagonal, (blocks, size, size), or whole.
    """
    H = model.mean_row
    if R.ndim == 3 and H.shape[1] > MANY_STATES:
        return stepped_gain(model.transition, H, Q, R)
    if R.ndim == 3 and len(H) > H.shape[1]:
        return _compressed_gain(model, Q, R)
    return _riccati_gain(model.transition, H, Q, linalg.block_diag(*R) if R.ndim == 3 else R)


def _compressed_gain(model: ExposureModel, Q: FloatArray, R: FloatArray) -> FloatArray | None:
    """The gain of `steady_gain` for more outputs than states: of the whitened outputs only as many as there are states
    carry information."""
    root = np.linalg.cholesky(R)
    blocks, size, _ = R.shape
    white = np.linalg.solve(root, model.mean_row.reshape(blocks, size, -1)).reshape(blocks * size, -1)
    rotation, H = np.linalg.qr(white)
    gain = _riccati_gain(model.transition, H, Q, np.eye(len(H)))
    rotated = np.linalg.solve(root.swapaxes(1, 2), rotation.reshape(blocks, size, -1)).reshape(blocks * size, -1)
    return None if gain is None else np.asarray(gain @ rotated.T)


def _riccati_gain(A: FloatArray, H: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray | None:
    try:
        P = linalg.solve_discrete_are(A.T, H.T, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        return None
    gain = np.asarray(P @ H.T @ np.linalg.inv(H @ P @ H.T + R))
    # A state that neither decays nor is driven by noise can make the solver return another solution than the
    # stabilising one, without an error.
    growth = np.abs(np.linalg.eigvals(A @ (np.eye(len(A)) - gain @ H))).max()
    return gain if growth <= 1 + _ROUNDING else None
