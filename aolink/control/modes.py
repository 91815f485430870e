"""The mirror modes: patterns of inputs and the slopes that they make, by the plant's response at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aolink.numerics.arrays import FloatArray, Indices
from aolink.rig import Plant

_SINGULAR = 1e12
"""With a condition number beyond this, I - A counts as singular: the plant does not come to rest."""


def reached(plant: Plant) -> tuple[Indices, Indices]:
    """States that the inputs reach, and those that they do not, by the zeros of A and B."""
    linked = plant.A != 0
    found = (plant.B != 0).any(axis=1)
    while not np.array_equal(more := found | linked[:, found].any(axis=1), found):
        found = more
    return np.flatnonzero(found), np.flatnonzero(~found)


def response_at_rest(plant: Plant, n_steps: int) -> FloatArray:
    """Outputs of one copy when each of its inputs is held at one, (n_outputs, n_inputs).

    For a plant that does not come to rest, it is the mean of its outputs over the first ``n_steps`` fast steps.
    """
    moved, _ = reached(plant)
    A, B, C = plant.A[np.ix_(moved, moved)], plant.B[moved], plant.C[:, moved]
    left = np.eye(len(A)) - A
    if np.linalg.cond(left) < _SINGULAR:
        return np.asarray(C @ np.linalg.solve(left, B))
    state, total = np.zeros_like(B), np.zeros((len(C), B.shape[1]))
    for _ in range(n_steps):
        total += C @ state
        state = A @ state + B
    return total / n_steps


@dataclass(frozen=True, kw_only=True, eq=False)
class MirrorModes:
    """Singular value decomposition of a plant's response at rest, U diag(gains) V'."""

    slopes: FloatArray
    """U, slopes of each mode, (n_outputs, modes)."""
    gains: FloatArray
    """Slopes for an input of one, the strongest first, (modes,)."""
    inputs: FloatArray
    """V, inputs of each mode, (n_inputs, modes)."""

    @classmethod
    def of(cls, response: FloatArray) -> MirrorModes:
        """Mirror modes of a response (n_outputs, n_inputs), that of a plant or one measured by `aolink calibrate
        --measure interaction`."""
        U, gains, V = np.linalg.svd(response, full_matrices=False)
        return cls(slopes=U, gains=gains, inputs=V.T)

    def reconstructor(self, least: float) -> FloatArray:
        """Matrix that gives the inputs for given slopes, by the mirror modes whose gain is at least this share of the
        strongest one's, (n_inputs, n_outputs)."""
        kept = self.gains >= least * self.gains[0]
        return np.asarray(self.inputs[:, kept] / self.gains[kept] @ self.slopes[:, kept].T)
