"""Image kernels on a plane of pixels, whose two axes the kernel may couple.

Positions are (x, y), x along the columns and y along the rows of a frame.
"""

from __future__ import annotations

import math

import numpy as np

from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import pixel_masses

_QUADRATURE = np.polynomial.legendre.leggauss(8)
# Mehler's series of a kernel that couples the two directions is truncated where its terms are below this.
_SERIES = 1e-6
_MOST_TERMS = 30


def pixel_mass_2d(
    covariance: FloatArray, x_edges: FloatArray, y_edges: FloatArray, positions: FloatArray
) -> FloatArray:
    """Share of a resting spot's light that each pixel gets, (..., rows, columns).

    It is computed along x by quadrature within each column, and along y given x by error functions. The kernel's
    covariance is (2, 2), slope units squared; edges of columns and rows, (columns + 1,) and (rows + 1,), and the spot's
    positions, (..., 2), are in slope units.
    """
    (xx, xy), (_, yy) = covariance
    nodes, weights = _QUADRATURE
    half = np.diff(x_edges) / 2
    x = x_edges[:-1, None] + half[:, None] * (nodes + 1)  # (columns, nodes)
    away = x - positions[..., 0, None, None]
    across = np.exp(-(away**2) / (2 * xx)) / math.sqrt(2 * math.pi * xx) * half[:, None] * weights
    # Given x, y is Gaussian about a regression line, with the part of its variance that x does not explain.
    line = positions[..., 1, None, None] + xy / xx * away
    (along,) = pixel_masses(yy - xy**2 / xx, y_edges, line, 0)  # (..., columns, nodes, rows)
    return np.asarray(np.einsum("...cn,...cnr->...rc", across, along))


def exposure_density_2d(
    covariance: FloatArray, x_edges: FloatArray, y_edges: FloatArray, paths: FloatArray
) -> FloatArray:
    """Mean density in the pixels about each spot after an exposure, without noise, one over slope units squared,
    (spots, rows, columns).

    Covariance and edges are as in `pixel_mass_2d`; ``paths`` are positions at each fast step, slope units, (spots,
    n_steps, 2).
    """
    # Spot by spot: the quadrature of all at once would not fit into memory.
    light = np.stack([pixel_mass_2d(covariance, x_edges, y_edges, path).mean(axis=0) for path in paths])
    return np.asarray(light / np.outer(np.diff(y_edges), np.diff(x_edges)))


def kernel_moments_2d(covariance: FloatArray, pixel: tuple[float, float], highest: int) -> FloatArray:
    """Moments E[x^p y^q] of a resting spot about its position, as sums over pixel centres give them, by p and q:
    (highest + 1, highest + 1); entries with p + q > highest are zero. ``pixel`` is its width and height, slope units.
    """
    total = np.array(covariance, dtype=np.float64)
    gaussian = np.zeros((highest + 1, highest + 1))
    gaussian[0, 0] = 1.0
    for p in range(highest + 1):
        for q in range(highest + 1 - p):
            # Stein: E[x f] = sum_j cov(x, x_j) E[df/dx_j].
            if p >= 1 and p + q >= 2:
                gaussian[p, q] = (p - 1) * total[0, 0] * (gaussian[p - 2, q] if p >= 2 else 0.0)
                gaussian[p, q] += q * total[0, 1] * (gaussian[p - 1, q - 1] if q >= 1 else 0.0)
            elif q >= 2:
                gaussian[p, q] = (q - 1) * total[1, 1] * gaussian[0, q - 2]
    square = [[(w / 2) ** k / (k + 1) if k % 2 == 0 else 0.0 for k in range(highest + 1)] for w in pixel]
    out = np.zeros_like(gaussian)
    for p in range(highest + 1):
        for q in range(highest + 1 - p):
            out[p, q] = sum(
                math.comb(p, a) * math.comb(q, b) * gaussian[a, b] * square[0][p - a] * square[1][q - b]
                for a in range(p + 1)
                for b in range(q + 1)
            )
    return out


def mehler_series(kernel: FloatArray) -> list[float]:
    """Terms c^j / j! of Mehler's series that are not negligible, with c the covariance of the two directions in
    ``kernel`` (2, 2)."""
    (xx, xy), (_, yy) = kernel
    rho = abs(xy) / math.sqrt(xx * yy)
    count = 1 if rho == 0 else min(_MOST_TERMS, math.ceil(math.log(_SERIES) / math.log(rho)))
    return [xy**j / math.factorial(j) for j in range(count)]
