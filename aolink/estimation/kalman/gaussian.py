"""A Gaussian for each axis, and the result of an update."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray, Indices

MOST_COVARIANCES = 32
"""Most measurements for which an estimate keeps the whole innovation covariance; for more it keeps the diagonal."""


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A Gaussian for each axis."""

    mean: FloatArray
    """(axes, n)"""
    covariance: FloatArray
    """(axes, n, n)"""

    def part(self, axes: slice | Indices) -> Gaussian:
        """The Gaussians of some axes."""
        return Gaussian(self.mean[axes], self.covariance[axes])

    def mapped(self, rows: FloatArray, added: FloatArray) -> Gaussian:
        """The Gaussian of M t + e: M is ``rows``, e independent of t, of covariance ``added``."""
        spread = batched.congruence(rows, self.covariance) + added
        return Gaussian(batched.matvec(rows, self.mean), batched.symmetric(spread))

    def with_noise(self, size: int) -> Gaussian:
        """The Gaussian with noise coefficients N(0, I) after its own, ``size`` in all; leading axes are kept."""
        *lead, n = self.mean.shape
        mean, covariance = np.zeros((*lead, size)), np.empty((*lead, size, size))
        mean[..., :n], covariance[...] = self.mean, np.eye(size)
        covariance[..., :n, :n] = self.covariance
        return Gaussian(mean, covariance)


@dataclass(frozen=True, eq=False)
class Update:
    """A prior updated with a measurement."""

    posterior: Gaussian
    innovation: FloatArray
    """(axes, n_measurements)"""
    innovation_covariance: FloatArray
    """(axes, n_measurements, n_measurements), or its diagonal, (axes, n_measurements)."""
    nis: FloatArray
    """(axes,)"""
    gate: FloatArray | None = None
    """What the gate compares instead of the NIS, by the covariance that the update itself has, (axes,)."""
