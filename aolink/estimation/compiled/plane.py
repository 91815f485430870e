"""The pixels of spots on a plane: expected light and likelihood.

As `compiled.line`: a Gaussian spot's light in a row of pixels, and in a column, comes from a short table of Taylor
series, and a pixel's light is the product of the two; where the kernel lies aslant, the sum of a few such products.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.line import log_likelihood_of, place
from aolink.estimation.compiled.small import compiled
from aolink.numerics.arrays import BoolArray, FloatArray


class Plane(NamedTuple):
    """Frames of spots and the data needed to predict them, one row for each axis of the plant."""

    y: FloatArray
    """Densities, (rows, spots, side, side), the last one along x."""
    usable: BoolArray
    """Mask of the usable pixels, of the same shape."""
    inputs: FloatArray
    """Response of the path to the inputs at its nodes, (rows, outputs, nodes): x and y of each spot in turn."""
    basis: FloatArray
    """The exposure basis at the nodes, (outputs, n, nodes)."""
    weights: FloatArray
    """Each node's share of the exposure, (nodes,)."""
    across: FloatArray
    """Taylor coefficients of the densities of columns of pixels about points of a pixel, (terms, points, 4, reach)."""
    down: FloatArray
    """The same coefficients for rows of pixels."""
    terms: FloatArray
    """Factors of the products, (terms,)."""
    low: float
    """Edge at which the first pixel begins, in both directions, slope units."""
    per_unit: float
    """Pixels in a slope unit."""
    read_noise: float
    """Variance of a pixel's density."""
    gain: float
    """Shot noise: increase of that variance with the density."""


@compiled
def log_likelihoods_of_spots(seen: Plane, row: int, t: FloatArray, begin: int, end: int, out: FloatArray) -> None:
    """Log-likelihoods of the points ``begin`` to ``end`` of t (n, points) in one row."""
    n, nodes, side = len(t), len(seen.weights), seen.y.shape[2]
    x, y, f = np.empty(nodes), np.empty(nodes), np.empty((side, side))
    columns, rows = np.empty(seen.across.shape[3]), np.empty(seen.down.shape[3])
    for k in range(begin, end):
        out[k] = 0.0
        for spot in range(seen.y.shape[1]):
            x[:], y[:] = seen.inputs[row, 2 * spot], seen.inputs[row, 2 * spot + 1]
            for i in range(n):
                value = t[i, k]
                for node in range(nodes):
                    x[node] += value * seen.basis[2 * spot, i, node]
                    y[node] += value * seen.basis[2 * spot + 1, i, node]
            f[:] = 0.0
            for node in range(nodes):
                left, column, dx = place(x[node], seen.low, seen.per_unit, side, seen.across.shape[1], len(columns))
                top, line, dy = place(y[node], seen.low, seen.per_unit, side, seen.down.shape[1], len(rows))
                if left < 0 or top < 0:
                    continue
                left, top = left - len(columns), top - len(rows)
                for j in range(len(seen.terms)):
                    _taylor(seen.across[j, column], dx, seen.terms[j] * seen.weights[node], columns)
                    _taylor(seen.down[j, line], dy, 1.0, rows)
                    for r in range(max(0, -top), min(len(rows), side - top)):
                        for c in range(max(0, -left), min(len(columns), side - left)):
                            f[top + r, left + c] += rows[r] * columns[c]
            light, usable = seen.y[row, spot].ravel(), seen.usable[row, spot].ravel()
            out[k] += log_likelihood_of(light, usable, f.ravel(), seen.read_noise, seen.gain)


@compiled
def _taylor(series: FloatArray, d: float, factor: float, out: FloatArray) -> None:
    for p in range(len(out)):
        out[p] = factor * (series[0, p] + d * (series[1, p] + d * (series[2, p] + d * series[3, p])))
