"""The image kernel as pixels see it: integrated over them, averaged over an exposure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from aolink.optics.sensor import Kernel

FloatArray = NDArray[np.float64]


def pixel_mass(kernel: Kernel, edges: FloatArray, positions: FloatArray) -> FloatArray:
    """Share of a resting spot's light that each pixel gets.

    Parameters
    ----------
    edges:
        Pixel edges, slope units, (pixels + 1,).
    positions:
        Positions of the spot, slope units, (...).

    Returns
    -------
    Integral of Psi(w - position) over each pixel, (..., pixels); the sum is one where all light meets the sensor.

    References
    ----------
    Psi is the kernel of Mishra & Wen, section VI, with its constant corrected to 1/(sigma sqrt(pi)) for unit mass.
    """
    below = erf((edges - np.asarray(positions)[..., None]) / kernel.sigma) / 2
    return np.diff(below, axis=-1)


def pixel_mass_slope(kernel: Kernel, edges: FloatArray, positions: FloatArray) -> FloatArray:
    """Derivative of `pixel_mass` by the position, one over slope units, (..., pixels)."""
    distance = (edges - np.asarray(positions)[..., None]) / kernel.sigma
    return -np.diff(np.exp(-(distance**2)), axis=-1) / (kernel.sigma * math.sqrt(math.pi))


def exposure_density(kernel: Kernel, edges: FloatArray, path: FloatArray) -> FloatArray:
    """Mean density in each pixel after an exposure, without noise.

    Parameters
    ----------
    edges:
        Edges of equal pixels, slope units, (pixels + 1,).
    path:
        Spot position at each fast step, slope units, (..., n_steps).

    Returns
    -------
    (1/N) sum_i of the kernel integrated over each pixel, divided by the pixel's width: one over slope
    units, (..., pixels). Mishra & Wen (3) with the 1/T_e that (5) needs.
    """
    return np.asarray(pixel_mass(kernel, edges, path).mean(axis=-2) / np.diff(edges))


def kernel_moments(kernel: Kernel, pixel_width: float, highest: int) -> FloatArray:
    """Moments of a resting spot about its position, as sums over pixel centres find them, (highest + 1,).

    The kernel and a pixel's width add like independent variables, so the second one is
    var(Psi) + D^2/12; what is left out is the aliasing of a kernel much narrower than a pixel.
    """
    orders = np.arange(highest + 1)
    even = orders % 2 == 0
    gaussian = np.where(even, [kernel.variance ** (p / 2) * math.prod(range(p - 1, 0, -2)) for p in orders], 0.0)
    uniform = np.where(even, (pixel_width / 2) ** orders / (orders + 1.0), 0.0)
    return np.array([sum(math.comb(p, k) * gaussian[k] * uniform[p - k] for k in range(p + 1)) for p in orders])
