"""Sums of a line sensor's pixels over a window: measured, and what they are under a Gaussian path (row
`moments_of_many_axes`).

The plain twin is `tests/estimation/moments/plain.py`.
"""

from __future__ import annotations

import math

import numpy as np

from aolink.estimation.compiled.small import compiled, compiled_sums, decay
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray

SUMS = 4
"""Sums whose remainders are computed together, ..."""
VECTOR = 16
"""... and nodes whose products are, so that all are in the processor's vectors."""


@compiled
def padded(count: int, group: int) -> int:
    return -(-count // group) * group


@compiled
def window_weights(
    row: int, usable: BoolArray, first: float, end: float, pixel: float, orders: IntArray,
    path: FloatArray, variance: FloatArray, path_reach: float, margin: float, W: FloatArray,
) -> None:  # fmt: skip
    """Weights of the pixels in a window about the path: as `Windowed.window`, monomials."""
    room = max(margin, 2.0 * pixel)
    low, high = math.inf, -math.inf
    for k in range(len(path)):
        reach = path_reach * math.sqrt(variance[k])
        low, high = min(low, path[k] - reach), max(high, path[k] + reach)
    low, high = max(min(low - margin, end - room), first), min(max(high + margin, first + room), end)
    for p in range(W.shape[1]):
        left = first + p * pixel
        inside = left + pixel > low and left < high and usable[row, p]
        u = (left + pixel / 2.0 - (low + high) / 2.0) / ((high - low) / 2.0)
        for a in range(len(W)):
            W[a, p] = u ** orders[a] if inside else 0.0


@compiled
def sums_of_row(
    row: int, density: FloatArray, pixel: float, read_noise: float, shot_noise: float, W: FloatArray, y: FloatArray,
    noise: FloatArray,
) -> None:  # fmt: skip
    """Sums of the pixels and their noise: as `moments.windowed.weighted_sums`."""
    sums, pixels = W.shape
    largest = -math.inf
    for a in range(sums):
        y[a] = 0.0
        for p in range(pixels):
            y[a] += W[a, p] * (density[row, p] * pixel)
        for b in range(a + 1):
            total = 0.0
            for p in range(pixels):
                total += W[a, p] * (read_noise + shot_noise * max(density[row, p], 0.0)) * W[b, p]
            noise[a, b] = noise[b, a] = total
            largest = max(largest, total)
    for a in range(sums):
        noise[a, a] += 1e-12 * largest if largest > 0.0 else 1.0


@compiled
def edges_of(low: float, pixel: float, W: FloatArray, places: FloatArray, change: FloatArray) -> int:
    """Edges at which the weights change, (edges,), and by how much, (edges, sums); the number of them."""
    edges, pixels = 0, W.shape[1]
    for edge in range(pixels + 1):
        changes = False
        for a in range(len(W)):
            left = W[a, edge - 1] if edge else 0.0
            right = W[a, edge] if edge < pixels else 0.0
            change[edges, a] = left - right
            changes = changes or left != right
        if changes:
            places[edges] = low + edge * pixel
            edges += 1
    return edges


@compiled_sums
def responses_at_nodes(
    edges: int, path: FloatArray, variance: FloatArray, weights: FloatArray, kernel_variance: float,
    places: FloatArray, change: FloatArray, expected: FloatArray, g: FloatArray,
) -> None:  # fmt: skip
    """Expected sums, (sums,), and the nodes' shares in their first to third derivatives by the spot's position.

    As `expected_response`, times the nodes' weights, the derivatives by themselves: (3, sums, nodes).
    """
    nodes, sums = len(path), len(expected)
    per_width, peak = np.empty(nodes), np.empty(nodes)
    d1, d2, d3 = np.empty(nodes), np.empty(nodes), np.empty(nodes)
    for k in range(nodes):
        per_width[k] = 1.0 / math.sqrt(2.0 * (kernel_variance + variance[k]))
        peak[k] = weights[k] * per_width[k] * (-1.0 / math.sqrt(math.pi))
    for a in range(sums):
        expected[a] = 0.0
        for k in range(nodes):
            g[0, a, k] = g[1, a, k] = g[2, a, k] = 0.0
    for edge in range(edges):
        place, below = places[edge], 0.0
        for k in range(nodes):
            u = (place - path[k]) * per_width[k]
            bell = decay(-u * u)
            slope = bell * peak[k]
            steeper = 2.0 * per_width[k] * slope
            below += weights[k] * half_erf(u, bell)
            d1[k], d2[k], d3[k] = slope, u * steeper, (2.0 * u * u - 1.0) * per_width[k] * steeper
        for a in range(sums):
            x = change[edge, a]
            expected[a] += x * below
            for k in range(nodes):
                g[0, a, k] += x * d1[k]
                g[1, a, k] += x * d2[k]
                g[2, a, k] += x * d3[k]


@compiled
def half_erf(u: float, bell: float) -> float:
    """erf(u) / 2 where ``bell`` is exp(-u^2), to 3e-12: a polynomial of 1 / (1 + 0.4 |u|) that is fitted to
    erfc(u) exp(u^2), least in the largest error of erfc."""
    s = 1.0 / (1.0 + 0.4 * abs(u))
    rest = -1.2473220484186118 + s * (0.3650534662902695 + s * -0.04335733682328623)
    rest = 1.4824788745739745 + s * (-1.9060080068574905 + s * (2.120774146285217 + s * rest))
    rest = 0.20054531181849033 + s * (0.38114800108703084 + s * (-0.35512369890259454 + s * rest))
    half = 0.5 - 0.5 * (0.00181129094700061 + s * rest) * bell
    return half if u > 0.0 else -half


@compiled_sums
def slopes_of(basis: FloatArray, g: FloatArray, slope: FloatArray) -> None:
    """H, the sums' derivatives by the coefficients, (sums, n)."""
    n, nodes = basis.shape
    for a in range(len(slope)):
        for i in range(n):
            total = 0.0
            for k in range(nodes):
                total += g[0, a, k] * basis[i, k]
            slope[a, i] = total


@compiled
def remainder_of(shared: FloatArray, left: FloatArray, right: FloatArray, g: FloatArray, remainder: FloatArray) -> None:
    """Omega, (sums, sums), by Mehler's series: as `PlainMoments.regression` of the twin.

    The path's covariance is ``shared`` + left' right.
    """
    nodes, width = shared.shape
    sums, groups = len(remainder), g.shape[1]
    c, second, third = np.empty(width), np.empty(groups), np.empty(groups)
    for a in range(sums):
        for b in range(sums):
            remainder[a, b] = 0.0
    for k in range(nodes):
        # Each pair of nodes is met once: what is missing is added when the matrix is made symmetric.
        end = padded(k + 1, VECTOR)
        for j in range(end):
            c[j] = shared[k, j]
        for r in range(len(left)):
            x = left[r, k]
            for j in range(end):
                c[j] += x * right[r, j]
        own = c[k]
        for j in range(k, end):
            c[j] = 0.0
        for a in range(0, groups, SUMS):
            _four_sums(c, g, a, end, second, third)
        for a in range(sums):
            second[a] += 0.5 * own * own * g[1, a, k]
            third[a] += 0.5 * own * own * own * g[2, a, k]
        for a in range(sums):
            for b in range(sums):
                remainder[a, b] += g[1, a, k] * second[b] + g[2, a, k] * (third[b] * (1.0 / 3.0))
    for a in range(sums):
        for b in range(a + 1):
            remainder[a, b] = remainder[b, a] = 0.5 * (remainder[a, b] + remainder[b, a])


@compiled_sums
def _four_sums(c: FloatArray, g: FloatArray, a: int, end: int, second: FloatArray, third: FloatArray) -> None:
    """Sums of c^2 g[1] and of c^3 g[2] over the nodes for four of the moments: c is loaded once for all of them."""
    s0 = s1 = s2 = s3 = t0 = t1 = t2 = t3 = 0.0
    for j in range(end):
        square = c[j] * c[j]
        cube = square * c[j]
        s0 += square * g[1, a, j]
        s1 += square * g[1, a + 1, j]
        s2 += square * g[1, a + 2, j]
        s3 += square * g[1, a + 3, j]
        t0 += cube * g[2, a, j]
        t1 += cube * g[2, a + 1, j]
        t2 += cube * g[2, a + 2, j]
        t3 += cube * g[2, a + 3, j]
    second[a], second[a + 1], second[a + 2], second[a + 3] = s0, s1, s2, s3
    third[a], third[a + 1], third[a + 2], third[a + 3] = t0, t1, t2, t3
