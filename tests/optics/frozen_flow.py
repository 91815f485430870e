"""Turbulence's wavefront itself, of which the simulated rig needs the slopes only."""

import numpy as np

from aolink.numerics.arrays import FloatArray
from aolink.optics.turbulence import FrozenFlow


def wavefront(flow: FrozenFlow, points_m: FloatArray, time_s: float = 0.0) -> FloatArray:
    """Path difference at points (..., 2), m, (...)."""
    moved = points_m - time_s * np.asarray(flow.layer.wind_m_s)
    return np.asarray((np.exp(1j * moved @ flow.wave_numbers.T) @ flow.amplitudes).real)
