"""The pixels of a line sensor: expected light, its derivatives, likelihood and Fisher information.

The share of a Gaussian spot's light that a pixel gets depends only on where the spot is within its own pixel: a short
table of Taylor series, right to 2e-7 of the brightest pixel, replaces the error function.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.small import compiled, inlined
from aolink.numerics.arrays import BoolArray, FloatArray

LARGE = 1e200
"""A product of variance ratios is replaced by its logarithm when it exceeds this."""


class Line(NamedTuple):
    """Frames of a line sensor and the data needed to predict them, one row for each axis and start."""

    y: FloatArray
    """Densities, (rows, pixels)."""
    usable: BoolArray
    """(rows, pixels)"""
    inputs: FloatArray
    """Response of the path to the inputs at its nodes, (rows, nodes)."""
    basis: FloatArray
    """The exposure basis at the nodes, transposed since the inner loops are over nodes, (n, nodes)."""
    weights: FloatArray
    """Each node's share of the exposure, (nodes,)."""
    table: FloatArray
    """Taylor coefficients of the light about points of a pixel, in pixels, (points, 4, reach)."""
    low: float
    """Edge at which the first pixel begins, slope units."""
    per_unit: float
    """One over the width of a pixel: multiplying is faster than dividing."""
    read_noise: float
    """Variance of a pixel's density."""
    gain: float
    """Shot noise: increase of that variance with the density."""


@compiled
def place(theta: float, low: float, per_unit: float, pixels: int, points: int, reach: int) -> tuple[int, int, float]:
    """First pixel in a padded row that a spot lights, or -1; nearest point of the table; distance from it in pixels.

    The arguments are numbers, not the `Line`: counting references to its arrays would take longer than all the rest.
    """
    v = (theta - low) * per_unit
    if not (v > -0.5 * reach and v < pixels + 0.5 * reach):
        return -1, 0, 0.0
    cell = math.floor(v)
    u = v - cell
    point = min(int(u * points), points - 1)
    return int(cell) + reach // 2, point, u - (point + 0.5) / points


@inlined
def expected_light(line: Line, path: FloatArray, f: FloatArray) -> None:
    """Densities without noise, padded on both sides by the table's reach."""
    f[:] = 0.0
    points, _, reach = line.table.shape
    for k in range(len(path)):
        first, point, d = place(path[k], line.low, line.per_unit, line.y.shape[1], points, reach)
        if first < 0:
            continue
        w = line.weights[k]
        row = line.table[point]
        for p in range(reach):
            f[first + p] += w * (row[0, p] + d * (row[1, p] + d * (row[2, p] + d * row[3, p])))


@inlined
def linearised_light(line: Line, path: FloatArray, basis: FloatArray, f: FloatArray, J: FloatArray) -> None:
    """The densities of `expected_light`, and their Jacobian J (n, padded pixels) by the coefficients of a basis (n,
    nodes)."""
    f[:] = 0.0
    J[:] = 0.0
    points, _, reach = line.table.shape
    slope = np.empty(reach)
    for k in range(len(path)):
        first, point, d = place(path[k], line.low, line.per_unit, line.y.shape[1], points, reach)
        if first < 0:
            continue
        w = line.weights[k]
        row = line.table[point]
        # The loop of `expected_light`: in a function of its own it would make both a seventh slower.
        for p in range(reach):
            f[first + p] += w * (row[0, p] + d * (row[1, p] + d * (row[2, p] + d * row[3, p])))
        w *= line.per_unit
        for p in range(reach):
            slope[p] = w * (row[1, p] + d * (2.0 * row[2, p] + 3.0 * d * row[3, p]))
        for i in range(len(basis)):
            b = basis[i, k]
            for p in range(reach):
                J[i, first + p] += b * slope[p]


@inlined
def log_likelihood_of(y: FloatArray, usable: BoolArray, f: FloatArray, read_noise: float, gain: float) -> float:
    """Log-likelihood of pixels with expected densities f, all (pixels,)."""
    total, product, quiet = 0.0, 1.0, 1.0 / read_noise
    for p in range(len(y)):
        if usable[p]:
            e = y[p] - f[p]
            if gain and f[p] > 0.0:
                R = read_noise + gain * f[p]
                total += e * e / R
                # One logarithm of a product is taken: one for each pixel would take longer than everything else here.
                product *= R * quiet
                if product > LARGE:
                    total += math.log(product)
                    product = 1.0
            else:
                total += e * e * quiet
    return -0.5 * (total + math.log(product))


@inlined
def path_of(offset: FloatArray, basis: FloatArray, t: FloatArray, path: FloatArray) -> None:
    """The path at the nodes, (nodes,), of coefficients t (n,) of a basis (n, nodes)."""
    path[:] = offset
    for i in range(len(t)):
        x = t[i]
        for k in range(len(path)):
            path[k] += x * basis[i, k]


@compiled
def log_likelihoods_of_lines(line: Line, row: int, t: FloatArray, begin: int, end: int, out: FloatArray) -> None:
    """Log-likelihoods of the points ``begin`` to ``end`` of t (n, points) in one row."""
    pad = line.table.shape[2]
    path = np.empty(len(line.weights))
    f = np.empty(line.y.shape[1] + 2 * pad)
    for k in range(begin, end):
        path_of(line.inputs[row], line.basis, t[:, k], path)
        expected_light(line, path, f)
        out[k] = log_likelihood_of(line.y[row], line.usable[row], f[pad:], line.read_noise, line.gain)


@inlined
def fisher_information(
    line: Line, row: int, f: FloatArray, J: FloatArray, scores: FloatArray, H: FloatArray, pull: FloatArray
) -> tuple[float, float]:
    """Lower half of H = J' I J, I each pixel's Fisher information; pull = J' score.

    Returns the log-likelihood and the sum of score^2 / I over the pixels.

    ``scores`` is room for (3, pixels).
    """
    n, pixels, pad = len(J), line.y.shape[1], line.table.shape[2]
    total = square = 0.0
    product, quiet = 1.0, 1.0 / line.read_noise
    y, usable, gain = line.y[row], line.usable[row], line.gain
    for p in range(pixels):
        light = max(f[pad + p], 0.0)
        relative = 0.5 * gain if f[pad + p] > 0.0 else 0.0
        information = 1.0 / (line.read_noise + gain * light)
        seen = 1.0 if usable[p] else 0.0
        e = seen * (y[p] - f[pad + p])
        score = e * information
        relative *= information
        total += e * score
        score += relative * (e * score - seen)
        information = seen * (information + 2.0 * relative * relative)
        square += score * score / (information if usable[p] else 1.0)
        scores[0, p], scores[1, p], scores[2, p] = score, information, light
    if gain:
        for p in range(pixels):
            product *= 1.0 + gain * quiet * (scores[2, p] if usable[p] else 0.0)
            if product > LARGE:
                total += math.log(product)
                product = 1.0
    for i in range(n):
        summed = 0.0
        for p in range(pixels):
            summed += J[i, pad + p] * scores[0, p]
            scores[2, p] = J[i, pad + p] * scores[1, p]
        pull[i] = summed
        for j in range(i + 1):
            summed = 0.0
            for p in range(pixels):
                summed += J[j, pad + p] * scores[2, p]
            H[i, j] = summed
    return -0.5 * (total + math.log(product)), square
