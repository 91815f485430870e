"""The image kernel integrated over pixels, and averaged over an exposure.

All integrals of a Gaussian up to an edge or over a pixel come from here; the compiled loops have a copy of their own.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import Kernel

Integrals = list[FloatArray]


def gaussian_below(
    variance: FloatArray | float, edges: FloatArray, positions: FloatArray, highest: int = 0
) -> Integrals:
    """Share of a Gaussian spot that lies below each edge, less one half, and its derivatives by the position.

    Parameters
    ----------
    variance:
        Variance of each spot, slope units squared, (...) or of a shape that is broadcast to it.
    edges:
        Slope units, (edges,).
    positions:
        Means of the spots, slope units, (...).
    highest:
        Highest derivative.

    Returns
    -------
    Derivatives 0 to ``highest``, (..., edges) each: erf(u) / 2 and -H_(n-1)(u) exp(-u^2) / (sqrt(pi) width^n) with
    u = (edge - position) / width, width^2 = 2 variance and H_n Hermite's polynomials.
    """
    width = np.sqrt(2 * np.asarray(variance))[..., None]
    u = (edges - np.asarray(positions)[..., None]) / width
    out = [scipy.special.erf(u) / 2]
    if highest:
        bell = np.exp(-u * u) / (math.sqrt(math.pi) * width)
        out.append(-bell)
        # H_n = 2u H_(n-1) - 2(n-1) H_(n-2), here over width^n.
        before, last = np.zeros_like(u), np.ones_like(u)
        for n in range(1, highest):
            before, last = last, 2 * u / width * last - 2 * (n - 1) / width**2 * before
            out.append(-last * bell)
    return out


def pixel_masses(variance: FloatArray | float, edges: FloatArray, positions: FloatArray, highest: int) -> Integrals:
    """Share of a Gaussian spot's light that each pixel gets, and its derivatives by the position.

    Parameters as of `gaussian_below`; gives derivatives 0 to ``highest``, (..., pixels) each.
    """
    return [np.diff(each, axis=-1) for each in gaussian_below(variance, edges, positions, highest)]


def pixel_mass(kernel: Kernel, edges: FloatArray, positions: FloatArray) -> FloatArray:
    """Share of a resting spot's light that each pixel gets: the integral of Psi(w - position) over it, (..., pixels).

    The sum is one where all light meets the sensor. Edges are (pixels + 1,), positions (...), slope units. Psi is the
    kernel of Mishra & Wen, section VI, with its constant corrected to 1/(sigma sqrt(pi)) for unit mass.
    """
    return pixel_masses(kernel.variance, edges, positions, 0)[0]


def exposure_density(kernel: Kernel, edges: FloatArray, path: FloatArray) -> FloatArray:
    """Mean density in each pixel after an exposure, without noise, one over slope units, (..., pixels).

    (1/N) sum_i of the kernel integrated over each pixel, divided by the pixel's width: Mishra & Wen (3) with the 1/T_e
    that (5) needs. Edges of equal pixels are (pixels + 1,), the spot's positions at each fast step (..., n_steps),
    slope units.
    """
    return np.asarray(pixel_mass(kernel, edges, path).mean(axis=-2) / np.diff(edges))


def kernel_moments(kernel: Kernel, pixel_width: float, highest: int) -> FloatArray:
    """Moments of a resting spot about its position, as sums over pixel centres give them, (highest + 1,).

    The kernel and a pixel's width add like independent variables, so the second one is
    var(Psi) + D^2/12; the aliasing of a kernel much narrower than a pixel is left out.
    """
    orders = np.arange(highest + 1)
    even = orders % 2 == 0
    gaussian = np.where(even, [kernel.variance ** (p / 2) * math.prod(range(p - 1, 0, -2)) for p in orders], 0.0)
    uniform = np.where(even, (pixel_width / 2) ** orders / (orders + 1.0), 0.0)
    return np.array([sum(math.comb(p, k) * gaussian[k] * uniform[p - k] for k in range(p + 1)) for p in orders])
