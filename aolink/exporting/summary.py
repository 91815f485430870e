"""Numbers for each axis from a path, which fit into a column of a table."""

from __future__ import annotations

import numpy as np

from aolink.estimation.estimate import Estimate
from aolink.numerics.arrays import FloatArray


def rms_by_axis(values: FloatArray, axes: int) -> FloatArray:
    """Root mean square over the steps and outputs of each axis, (axes,), of values (axes * outputs, n_steps)."""
    return np.asarray(np.sqrt(np.mean(values.reshape(axes, -1) ** 2, axis=1)))


def path_rms(path: FloatArray, axes: int) -> FloatArray:
    """Motion of the spots of each axis: RMS of a path (axes * outputs, n_steps) about its own means, slope units,
    (axes,).
    """
    return rms_by_axis(path - path.mean(axis=1, keepdims=True), axes)


def estimate_scalars(estimate: Estimate) -> dict[str, FloatArray]:
    """Values for a table's columns about an estimate's path and consistency, by name, each (axes,).

    ``path_rms`` is how far the spot moved in the exposure (`path_rms`), ``path_sd_rms`` the RMS of the path's standard
    deviation, both in slope units; ``nis`` is the estimate's own, NaN for an estimator that measures nothing.
    """
    axes = len(estimate.start_state)
    measures = estimate.innovation.shape[1] > 0
    return {
        "path_rms": path_rms(estimate.path, axes),
        "path_sd_rms": rms_by_axis(estimate.path_sd, axes),
        "nis": estimate.nis if measures else np.full(axes, np.nan),
    }
