"""A PSF's error as additional noise of the picture, which grows with the scene's contrast.

With the scene's covariance R and an error of the PSF of covariance sum_i m_i m_i', the blurred picture has an error of
variance sum_i m_i' R m_i that no restoration with the expected PSF can explain. It is treated as white.
"""

from __future__ import annotations

import numpy as np
from scipy import fft, linalg

from aolink.numerics.arrays import FloatArray
from aolink.restoration.scanner import Scanner

_GRID = 256


def line_variance(modes: FloatArray, scanner: Scanner) -> float:
    """Added variance for lines of a scanner, the mean over pixels where each has its own PSF; PSF modes (modes, ..,
    taps)."""
    if not len(modes):
        return 0.0
    R = linalg.toeplitz(scanner.correlation(modes.shape[-1] - 1))
    return float(np.einsum("...i,ij,...j->...", modes, R, modes).reshape(len(modes), -1).mean(axis=1).sum())


def plane_variance(modes: FloatArray, difference_weight: float) -> float:
    """Added variance for a scene of white differences; PSF modes (modes, taps) or (modes, rows, columns), each of zero
    sum.

    It is the mean over all frequencies of |m|^2 / (lambda roughness).
    """
    if not len(modes):
        return 0.0
    plane = modes.reshape(len(modes), -1, modes.shape[-1])
    power = (np.abs(fft.fft2(plane, (_GRID, _GRID))) ** 2).sum(axis=0)
    one = 4 * np.sin(np.pi * np.arange(_GRID) / _GRID) ** 2
    rough = one[:, None] + one
    return float((power[rough > 0] / rough[rough > 0]).sum() / _GRID**2 / difference_weight)
