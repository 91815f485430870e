"""Covariances and their roots, (..., n, n)."""

from __future__ import annotations

import numpy as np

from aolink.numerics.arrays import FloatArray
from aolink.numerics.batched import symmetric

JITTER = 1e-10
"""Added to a covariance's diagonal, relative to each variance: what is known for certain stays certain to this."""
CORRELATION_STEP = 2.0**-20
"""Correlations that are rounded are multiples of this."""
_SCALE = CORRELATION_STEP**-0.5
"""A power of two, so that it rounds nothing."""


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


def in_correlation_steps(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariances as standard deviations (..., n) in single precision and multiples of `CORRELATION_STEP` between them:
    whole numbers of steps (..., n, n), of which the upper triangle mirrors the lower.

    Rounding changes each correlation by half a step at most, and so an eigenvalue of n of them by n / 2 steps at most
    (Gershgorin). Variances are larger by that share of themselves: what is positive semidefinite remains so. A variance
    below zero is rounding, and becomes zero.
    """
    n = covariance.shape[-1]
    # One step more than those of n - 1 correlations, which is more than single precision's rounding.
    larger = np.einsum("...ii->...i", covariance) / (1 - (n + 1) * CORRELATION_STEP / 2)
    sd = np.sqrt(np.maximum(larger, 0.0)).astype(np.float32).astype(np.float64)
    return sd, correlation_steps(covariance, sd)


def correlation_steps(covariance: FloatArray, sd: FloatArray) -> FloatArray:
    """The whole numbers of steps, (..., n, n), between these standard deviations, (..., n)."""
    inverse = np.divide(_SCALE, sd, out=np.zeros_like(sd), where=sd > 0)
    steps: FloatArray = inverse[..., :, None] * inverse[..., None, :]
    steps *= covariance
    np.rint(steps, out=steps)
    steps += 0.0  # a zero has no sign then
    np.einsum("...ii->...i", steps)[...] = 1 / CORRELATION_STEP
    return np.where(np.tri(covariance.shape[-1], dtype=bool), steps, steps.swapaxes(-1, -2))


def from_correlation_steps(sd: FloatArray, steps: FloatArray) -> FloatArray:
    """Inverse of `correlation_steps`, with the same bits on every machine."""
    scaled = sd / _SCALE
    return np.asarray(steps * (scaled[..., :, None] * scaled[..., None, :]))
