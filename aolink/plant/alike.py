"""Plants that consist of many small equal systems side by side, such as the actuators of a mirror."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from aolink.numerics.arrays import FloatArray, Indices
from aolink.numerics.block_diagonal import alike
from aolink.rig import Plant

MANY_STATES = 64
"""With more states than this a plant's matrices are large, and a mirror is treated actuator by actuator."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AlikeSystems:
    """A plant of many inputs, each of which moves a small system of its own, all equal; the plant's outputs are sums of
    theirs.

    A = I (x) A_1, B and B_w likewise, and C = gains (x) C_1, with (x) the Kronecker product.
    """

    one: Plant
    """One of the systems, with unit noise; the plant's outputs are sums of its output over the systems."""
    gains: FloatArray
    """Weights of the systems in the plant's outputs, (n_outputs, systems)."""
    noise_sd: FloatArray
    """Standard deviation of the noise of each, (systems,)."""
    order: Indices
    """States of each, (systems, n)."""


@lru_cache(maxsize=16)
def alike_systems(plant: Plant) -> AlikeSystems | None:
    """The systems that a large plant consists of; None where it is not large, does not consist of equal systems, or its
    outputs have delays.

    A plant is large with more than `MANY_STATES` states, and also with more outputs than states where each output has
    a coefficient of its own (`UnmodelledSlopes`): for 48 spots `moments` takes 4 s with dense matrices, and a fiftieth
    of that with these.
    """
    W = plant.process_noise
    large = plant.n_states > MANY_STATES or (plant.unmodelled is not None and plant.n_outputs > plant.n_states)
    if plant.delays or not large or np.count_nonzero(W - np.diag(np.diag(W))):
        return None
    order = alike(plant.A, plant.B, plant.B_w)
    if order is None:
        return None
    seen = np.flatnonzero(np.abs(plant.C).max(axis=0)[order].max(axis=0))
    if len(seen) != 1:
        return None
    first, n = order[0], order.shape[1]
    one = Plant(
        A=plant.A[np.ix_(first, first)], B=plant.B[first, :1], B_w=plant.B_w[first, :1], C=np.eye(n)[seen],
        process_noise=np.eye(1), initial_mean=np.zeros(n), initial_covariance=np.eye(n), axes=1,
    )  # fmt: skip
    return AlikeSystems(
        one=one, gains=np.ascontiguousarray(plant.C[:, order[:, seen[0]]]), noise_sd=np.sqrt(np.diag(W)), order=order
    )
