"""A Gaussian for each axis, and what an update made of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


MOST_COVARIANCES = 32
"""Measurements of which an estimate has the whole innovation covariance; of more it has the diagonal."""


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A Gaussian for each axis."""

    mean: FloatArray
    """(axes, n)"""
    covariance: FloatArray
    """(axes, n, n)"""


@dataclass(frozen=True, eq=False)
class Update:
    """What a measurement made of a prior."""

    posterior: Gaussian
    innovation: FloatArray
    """(axes, n_measurements)"""
    innovation_covariance: FloatArray
    """(axes, n_measurements, n_measurements), or its diagonal, (axes, n_measurements)."""
    nis: FloatArray
    """(axes,)"""
