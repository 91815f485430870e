"""A Gaussian for each axis, and the result of an update."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


MOST_COVARIANCES = 32
"""Most measurements for which an estimate keeps the whole innovation covariance; for more it keeps the diagonal."""


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A Gaussian for each axis."""

    mean: FloatArray
    """(axes, n)"""
    covariance: FloatArray
    """(axes, n, n)"""


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
