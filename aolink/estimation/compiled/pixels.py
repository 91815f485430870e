"""The pixels of spots: expected light, its derivatives, likelihood and Fisher information. A line sensor is a window of
one row.

The share of a Gaussian spot's light that a row of pixels gets, or a column, depends only on where the spot is within
its own pixel: a short table of Taylor series, right to 2e-7 of the brightest pixel, replaces the error function. A
pixel's light is the product of the two; where the kernel lies aslant, the sum of a few such products.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.small import compiled, inlined
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray

LARGE = 1e200
"""A product of variance ratios is replaced by its logarithm when it exceeds this."""


class Pixels(NamedTuple):
    """Frames and the data needed to predict them, one row for each axis of the plant."""

    y: FloatArray
    """Densities, (rows, spots, height, width), the last one along x; the height of a line is one."""
    usable: BoolArray
    """Mask of the usable pixels, of the same shape."""
    inputs: FloatArray
    """Response of the path to the inputs at its nodes, (rows, outputs, nodes): x and y of each spot in turn; x of a
    line."""
    basis: FloatArray
    """The exposure basis at the nodes, (outputs, n, nodes)."""
    weights: FloatArray
    """Each node's share of the exposure, (nodes,)."""
    across: FloatArray
    """Taylor coefficients of the densities of columns of pixels about points of a pixel, (terms, points, 4, reach)."""
    down: FloatArray
    """The same coefficients for rows of pixels; of a line, the one row that has all the light, (1, 1, 4, 1)."""
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
def places_of(
    path: FloatArray, low: float, per_unit: float, pixels: int, points: int, reach: int, firsts: IntArray,
    nearest: IntArray, away: FloatArray,
) -> None:  # fmt: skip
    """First pixel in a padded row that a spot lights, or -1; nearest point of the table; distance from it in pixels.

    Of each node of a path (nodes,). Where the first pixel is -1 the others mean nothing.
    """
    for node in range(len(path)):
        v = (path[node] - low) * per_unit
        lit = v > -0.5 * reach and v < pixels + 0.5 * reach
        v = v if lit else 0.0
        cell = math.floor(v)
        u = v - cell
        point = min(int(u * points), points - 1)
        firsts[node] = int(cell) + reach // 2 if lit else -1
        nearest[node] = point
        away[node] = u - (point + 0.5) / points


@inlined
def path_of(offset: FloatArray, basis: FloatArray, t: FloatArray, path: FloatArray) -> None:
    """The path at the nodes, (nodes,), of coefficients t (n,) of a basis (n, nodes)."""
    for k in range(len(path)):
        path[k] = offset[k]
    for i in range(len(t)):
        x = t[i]
        for k in range(len(path)):
            path[k] += x * basis[i, k]


@inlined
def _padding(seen: Pixels) -> tuple[int, int]:
    """Rows and columns about a window that hold the light of a spot outside of it."""
    return 0 if seen.y.shape[2] == 1 else seen.down.shape[3], seen.across.shape[3]


@inlined
def _add_product(f: FloatArray, top: int, left: int, rows: FloatArray, columns: FloatArray) -> None:
    for k in range(rows.shape[1]):
        r, light = np.uintp(top) + np.uintp(k), rows[0, k]
        for m in range(columns.shape[1]):
            f[r, np.uintp(left) + np.uintp(m)] += light * columns[0, m]


@inlined
def _taylor(table: FloatArray, term: int, point: int, d: float, factor: float, out: FloatArray) -> None:
    """The light of a spot at a distance d from a point of the table, out[0]."""
    row = np.uintp(point)  # without a sign: nothing asks if it counts from the end
    for k in range(out.shape[1]):
        p = np.uintp(k)
        slope = table[term, row, 1, p] + d * (table[term, row, 2, p] + d * table[term, row, 3, p])
        out[0, p] = factor * (table[term, row, 0, p] + d * slope)


@inlined
def _taylor_slope(table: FloatArray, term: int, point: int, d: float, factor: float, out: FloatArray) -> None:
    """The derivative of `_taylor` by d, out[1]."""
    row = np.uintp(point)
    for k in range(out.shape[1]):
        p = np.uintp(k)
        steeper = 2.0 * table[term, row, 2, p] + 3.0 * d * table[term, row, 3, p]
        out[1, p] = factor * (table[term, row, 1, p] + d * steeper)


@compiled
def information_of_row(
    seen: Pixels, row: int, path: FloatArray, basis: FloatArray, H: FloatArray, pull: FloatArray
) -> tuple[float, float]:
    """Fisher information of the pixels of one row about their path (outputs, nodes), by coefficients of a basis
    (outputs, n, nodes): its lower half is added to H, and the score to ``pull``.

    Returns the log-likelihood and the sum of score^2 / information over the pixels.
    """
    (_, spots, height, width), (high, wide), n = seen.y.shape, _padding(seen), len(pull)
    f, J = np.empty((height + 2 * high, width + 2 * wide)), np.empty((n, height + 2 * high, width + 2 * wide))
    scores = np.empty((2, height, width))
    log_likelihood = square = 0.0
    for spot in range(spots):
        _linearise(seen, spot, path, basis, f, J)
        own, squares = _fisher_information(
            seen.y[row, spot], seen.usable[row, spot], f, J, high, wide, seen.read_noise, seen.gain, scores, H, pull
        )
        log_likelihood += own
        square += squares
    return log_likelihood, square


@inlined
def _linearise(seen: Pixels, spot: int, path: FloatArray, basis: FloatArray, f: FloatArray, J: FloatArray) -> None:
    """Padded densities f of one spot, and their Jacobian J, (n, ...), by coefficients of a basis (outputs, n,
    nodes)."""
    (_, spots, height, width), nodes = seen.y.shape, path.shape[1]
    across, down, directions = seen.across, seen.down, len(basis) // spots
    columns, rows = np.empty((2, across.shape[3])), np.empty((2, down.shape[3]))
    firsts, nearest = np.zeros((2, nodes), np.int64), np.zeros((2, nodes), np.int64)
    away = np.zeros((2, nodes))
    x = directions * spot
    for d in range(directions):
        table, size = (down if d else across), (height if d else width)
        places_of(
            path[x + d], seen.low, seen.per_unit, size, table.shape[1], table.shape[3], firsts[d], nearest[d], away[d]
        )  # fmt: skip
    f[:] = 0.0
    J[:] = 0.0
    for node in range(nodes):
        left, top = firsts[0, node], firsts[1, node]
        if left < 0 or top < 0:
            continue
        for j in range(len(seen.terms)):
            weight = seen.terms[j] * seen.weights[node]
            _taylor(across, j, nearest[0, node], away[0, node], weight, columns)
            _taylor(down, j, nearest[1, node], away[1, node], 1.0, rows)
            _taylor_slope(across, j, nearest[0, node], away[0, node], weight * seen.per_unit, columns)
            _taylor_slope(down, j, nearest[1, node], away[1, node], seen.per_unit, rows)
            _add_product(f, top, left, rows, columns)
            for d in range(directions):
                for i in range(len(J)):
                    for k in range(rows.shape[1]):
                        slope, r = basis[x + d, i, node] * rows[d, k], np.uintp(top) + np.uintp(k)
                        for m in range(columns.shape[1]):
                            J[i, r, np.uintp(left) + np.uintp(m)] += slope * columns[1 - d, m]


@inlined
def _fisher_information(
    y: FloatArray, usable: BoolArray, f: FloatArray, J: FloatArray, down: int, across: int, read_noise: float,
    gain: float, scores: FloatArray, H: FloatArray, pull: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Lower half of J' I J, I each pixel's Fisher information, added to H, and J' score to ``pull``.

    f and J (n, ...) are padded expected densities and their Jacobian; ``scores`` is room for (2, height, width).
    Returns as `information_of_row`.
    """
    height, width = y.shape
    total = square = 0.0
    product, quiet = 1.0, 1.0 / read_noise
    for r in range(height):
        for c in range(width):
            expected, seen = f[down + r, across + c], 1.0 if usable[r, c] else 0.0
            light = max(expected, 0.0)
            information = 1.0 / (read_noise + gain * light)
            relative = 0.5 * gain * information if expected > 0.0 else 0.0
            e = seen * (y[r, c] - expected)
            score = e * information
            total += e * score
            score += relative * (e * score - seen)
            information = seen * (information + 2.0 * relative * relative)
            square += score * score / (information if usable[r, c] else 1.0)
            scores[0, r, c], scores[1, r, c] = score, information
        if gain:
            for c in range(width):
                product *= 1.0 + gain * quiet * (max(f[down + r, across + c], 0.0) if usable[r, c] else 0.0)
                if product > LARGE:
                    total += math.log(product)
                    product = 1.0
    first = np.uintp(across)
    for i in range(len(J)):
        summed = 0.0
        for r in range(height):
            line, padded = np.uintp(r), np.uintp(down + r)
            for k in range(width):
                p = np.uintp(k)
                summed += J[i, padded, first + p] * scores[0, line, p]
                f[padded, first + p] = J[i, padded, first + p] * scores[1, line, p]
        pull[i] += summed
        for j in range(i + 1):
            summed = 0.0
            for r in range(height):
                padded = np.uintp(down + r)
                for k in range(width):
                    summed += J[j, padded, first + np.uintp(k)] * f[padded, first + np.uintp(k)]
            H[i, j] += summed
    return -0.5 * (total + math.log(product)), square
