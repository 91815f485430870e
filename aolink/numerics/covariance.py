"""Covariances and their roots, (..., n, n)."""

from __future__ import annotations

import numpy as np

from aolink.numerics.arrays import FloatArray
from aolink.numerics.batched import symmetric

JITTER = 1e-10
"""Added to a covariance's diagonal, relative to each variance: what is known for certain stays certain to this."""


def psd_root(covariance: FloatArray) -> FloatArray:
    """A root R of covariances that may be singular, R R' = covariance; eigenvalues below zero are rounding."""
    values, vectors = np.linalg.eigh(symmetric(covariance))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def cholesky(covariance: FloatArray) -> FloatArray:
    """Lower triangular root of covariances that may be singular."""
    diagonal = np.einsum("...ii->...i", covariance)
    largest = np.maximum.reduce(diagonal, axis=-1, keepdims=True)
    lifted = covariance + (JITTER * diagonal + 1e-14 * largest + 1e-300)[..., None] * np.eye(covariance.shape[-1])
    return np.asarray(np.linalg.cholesky(lifted))


def lower_inverse(root: FloatArray) -> FloatArray:
    """Inverse of lower triangular matrices."""
    return np.asarray(np.linalg.solve(root, np.broadcast_to(np.eye(root.shape[-1]), root.shape)))
