"""Covariances and their roots."""

from __future__ import annotations

import numpy as np

from aolink.numerics.arrays import FloatArray


def psd_root(covariance: FloatArray) -> FloatArray:
    """A root R of a covariance that may be singular, R R' = covariance, (n, n)."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
