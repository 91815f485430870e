"""The pixels of spots on a plane: expected light, its derivatives, and likelihood.

As `compiled.line`: a Gaussian spot's light in a row of pixels, and in a column, comes from a short table of Taylor
series, and a pixel's light is the product of the two; where the kernel lies aslant, the sum of a few such products.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.line import log_likelihood_of, place
from aolink.estimation.compiled.small import compiled, compiled_sums, inlined
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
    side, across, down = seen.y.shape[2], seen.across.shape[3], seen.down.shape[3]
    path = np.empty((2, len(seen.weights)))
    # Padded by what a spot outside the window still lights in it.
    f = np.empty((side + 2 * down, side + 2 * across))
    columns, rows = np.empty(across), np.empty(down)
    for k in range(begin, end):
        out[k] = 0.0
        for spot in range(seen.y.shape[1]):
            _path_of(seen, row, spot, t[:, k], path)
            f[:] = 0.0
            for j in range(len(seen.terms)):
                _add_spots(
                    path, seen.weights, seen.terms[j], seen.low, seen.per_unit, side, seen.across[j], seen.down[j],
                    columns, rows, f,
                )  # fmt: skip
            light, usable = seen.y[row, spot], seen.usable[row, spot]
            if seen.gain:
                own = f[down : down + side, across : across + side].copy()
                out[k] += log_likelihood_of(light.ravel(), usable.ravel(), own.ravel(), seen.read_noise, seen.gain)
            else:
                out[k] -= 0.5 * _squares(light, usable, f, down, across) / seen.read_noise


@compiled
def linearised_light_of_spots(seen: Plane, t: FloatArray, light: FloatArray, slopes: FloatArray) -> None:
    """Densities (rows, points, spots, side, side) of points t (rows, points, n); their derivatives by t, (..., n)."""
    n, side, across, down = t.shape[2], seen.y.shape[2], seen.across.shape[3], seen.down.shape[3]
    path = np.empty((2, len(seen.weights)))
    f = np.empty((side + 2 * down, side + 2 * across))
    J = np.empty((n, side + 2 * down, side + 2 * across))
    columns, more_columns, rows, more_rows = np.empty(across), np.empty(across), np.empty(down), np.empty(down)
    for row in range(t.shape[0]):
        for k in range(t.shape[1]):
            for spot in range(seen.y.shape[1]):
                _path_of(seen, row, spot, t[row, k], path)
                f[:] = 0.0
                J[:] = 0.0
                for node in range(len(seen.weights)):
                    left, column, dx = place(path[0, node], seen.low, seen.per_unit, side, seen.across.shape[1], across)
                    top, line, dy = place(path[1, node], seen.low, seen.per_unit, side, seen.down.shape[1], down)
                    if left < 0 or top < 0:
                        continue
                    for j in range(len(seen.terms)):
                        weight = seen.terms[j] * seen.weights[node]
                        _taylor(seen.across[j, column], dx, weight, columns)
                        _taylor(seen.down[j, line], dy, 1.0, rows)
                        _taylor_slope(seen.across[j, column], dx, weight * seen.per_unit, more_columns)
                        _taylor_slope(seen.down[j, line], dy, seen.per_unit, more_rows)
                        _add_product(f, top, left, rows, columns)
                        for i in range(n):
                            along, aside = seen.basis[2 * spot, i, node], seen.basis[2 * spot + 1, i, node]
                            for r in range(down):
                                lit, a, b = J[i, top + r, left : left + across], along * rows[r], aside * more_rows[r]
                                for c in range(across):
                                    lit[c] += a * more_columns[c] + b * columns[c]
                for r in range(side):
                    for c in range(side):
                        light[row, k, spot, r, c] = f[down + r, across + c]
                        for i in range(n):
                            slopes[row, k, spot, r, c, i] = J[i, down + r, across + c]


@inlined
def _path_of(seen: Plane, row: int, spot: int, t: FloatArray, path: FloatArray) -> None:
    """The path of one spot at the nodes, (2, nodes), of coefficients t (n,)."""
    for d in range(2):
        output = 2 * spot + d
        path[d] = seen.inputs[row, output]
        for i in range(len(t)):
            value = t[i]
            for node in range(path.shape[1]):
                path[d, node] += value * seen.basis[output, i, node]


@compiled
def _add_spots(
    path: FloatArray, weights: FloatArray, term: float, low: float, per_unit: float, side: int, across: FloatArray,
    down: FloatArray, columns: FloatArray, rows: FloatArray, f: FloatArray,
) -> None:  # fmt: skip
    """The light of a spot at each node, rows times columns, added to padded densities f.

    Indices are unsigned and arrays flat: signed indices might count from the end, and slices would have their
    references counted; either makes the loop over the pixels of a row twice as slow.
    """
    A, D, lit, width = across.ravel(), down.ravel(), f.ravel(), np.uintp(f.shape[1])
    wide, high = np.uintp(len(columns)), np.uintp(len(rows))
    for node in range(path.shape[1]):
        left, column, dx = place(path[0, node], low, per_unit, side, across.shape[0], len(columns))
        top, line, dy = place(path[1, node], low, per_unit, side, down.shape[0], len(rows))
        if left < 0 or top < 0:
            continue
        weight, at = term * weights[node], np.uintp(4 * column) * wide
        for p in range(len(columns)):
            q = at + np.uintp(p)
            light = A[q] + dx * (A[q + wide] + dx * (A[q + wide + wide] + dx * A[q + wide + wide + wide]))
            columns[np.uintp(p)] = weight * light
        at = np.uintp(4 * line) * high
        for p in range(len(rows)):
            q = at + np.uintp(p)
            rows[np.uintp(p)] = D[q] + dy * (D[q + high] + dy * (D[q + high + high] + dy * D[q + high + high + high]))
        first = np.uintp(top) * width + np.uintp(left)
        for r in range(len(rows)):
            light = rows[np.uintp(r)]
            for c in range(len(columns)):
                lit[first + np.uintp(c)] += light * columns[np.uintp(c)]
            first += width


@inlined
def _add_product(f: FloatArray, top: int, left: int, rows: FloatArray, columns: FloatArray) -> None:
    for r in range(len(rows)):
        # A slice of one row, so that the compiler knows that its pixels are side by side: four times as fast.
        lit, light = f[top + r, left : left + len(columns)], rows[r]
        for c in range(len(columns)):
            lit[c] += light * columns[c]


@compiled
def _taylor(series: FloatArray, d: float, factor: float, out: FloatArray) -> None:
    for p in range(len(out)):
        out[p] = factor * (series[0, p] + d * (series[1, p] + d * (series[2, p] + d * series[3, p])))


@compiled
def _taylor_slope(series: FloatArray, d: float, factor: float, out: FloatArray) -> None:
    for p in range(len(out)):
        out[p] = factor * (series[1, p] + d * (2.0 * series[2, p] + 3.0 * d * series[3, p]))


@compiled_sums
def _squares(y: FloatArray, usable: BoolArray, padded: FloatArray, down: int, across: int) -> float:
    """Sum of the usable pixels' squared deviations from padded expected densities."""
    total = 0.0
    for r in range(len(y)):
        # Slices of one row, as in `_add_product`.
        seen, counts, f = y[r], usable[r], padded[down + r, across : across + y.shape[1]]
        of_row = 0.0
        for c in range(len(seen)):
            e = seen[c] - f[c]
            of_row += e * e if counts[c] else 0.0
        total += of_row
    return total
