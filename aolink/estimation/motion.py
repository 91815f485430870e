"""Sums of an estimate's outputs at each fast step, with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from aolink.numerics.covariance import psd_root

if TYPE_CHECKING:
    from aolink.estimation.estimate import Estimate

FloatArray = NDArray[np.float64]


def coefficient_roots(estimate: Estimate) -> list[FloatArray]:
    """Roots of the covariance of each axis's coefficients."""
    return [psd_root(each) for each in estimate.coefficient_covariance]


def motion(
    estimate: Estimate, mix: FloatArray, roots: Sequence[FloatArray], *, after: bool = False
) -> tuple[FloatArray, FloatArray]:
    """A sum of an estimate's outputs at each fast step, and a root of its covariance.

    Parameters
    ----------
    mix:
        Weights of the outputs, (k, n_outputs).
    roots:
        The estimate's `coefficient_roots`.
    after:
        With the step after the last.

    Returns
    -------
    (k, n_steps), and R of the covariance R R', (k n_steps, n), slope units; the covariance without the path's share
    that the exposure's basis leaves out. With ``after`` n_steps is one more.
    """
    model, path = estimate.model, estimate.path
    if after:
        last = (model.plant.C @ estimate.end_state[..., None]).reshape(-1, 1)
        path = np.concatenate([path, last], axis=1)
    axes, count = estimate.coefficient_covariance.shape[:2]
    weights = mix.reshape(len(mix), axes, -1)
    outputs, paths = model.factors
    each = [np.zeros((len(mix) * path.shape[1], 0))]
    for axis in range(axes):
        if weights[:, axis].any():
            mixed = weights[:, axis] if outputs is None else weights[:, axis] @ outputs
            if paths.ndim == 2:  # courses of the coefficients, the outputs their patterns
                rows = mixed[:, None, :count] * paths[:, :count]
            else:
                rows = np.tensordot(mixed, paths[:, :, :count], axes=1)
            if after:
                end = weights[:, axis] @ model.plant.C @ model.end_rows[:, :count]
                rows = np.concatenate([rows, end[:, None]], axis=1)
            each.append(rows.reshape(-1, count) @ roots[axis])
    return mix @ path, np.concatenate(each, axis=1)
