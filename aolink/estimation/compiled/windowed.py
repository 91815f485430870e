"""Iterated statistical linearisation of line sensors' windowed moments, axis by axis (row `moments_of_many_axes`).

The plain twin is `tests/estimation/moments/plain.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.small import (
    cholesky_solve,
    compiled,
    compiled_sums,
    decay,
    lower_solve,
    times,
)
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray

# Sums whose remainders are computed together; nodes whose products are, so that all are in the processor's vectors.
_SUMS = 4
_VECTOR = 16


class Lines(NamedTuple):
    """Frames of a line sensor, one row for each axis, and the data needed to predict their moments."""

    density: FloatArray
    """Zero where a pixel cannot be used, (rows, pixels)."""
    usable: BoolArray
    """(rows, pixels)"""
    light: FloatArray
    """The share of a whole spot's light that the densities were divided by, (rows,)."""
    inputs: FloatArray
    """Response of the path to the inputs at its nodes, (rows, nodes)."""
    basis: FloatArray
    """The exposure basis at the nodes, transposed, (n, nodes)."""
    weights: FloatArray
    """Each node's share of the exposure, (nodes,)."""
    shared: FloatArray
    """`noise_spread` of the basis."""
    end_rows: FloatArray
    """End states of the coefficients, (n_states, n)."""
    low: float
    """Edge at which the first pixel begins, slope units."""
    high: float
    pixel: float
    """Width of a pixel, slope units."""
    read_noise: float
    """Variance of a dark pixel's light, which is its density times its width."""
    shot_noise: float
    """Increase of that variance with the density."""
    kernel_variance: float
    widening: float
    """Variance of the path about its nodes that no coefficient covers, slope units squared."""
    orders: IntArray
    """Orders of the basis functions, (sums,)."""
    functions: int
    """Which they are: 0 monomials, 1 Legendre's polynomials, 2 sines and cosines."""
    ratios: bool
    """Whether the sums are divided by the first one, the light in the window."""


class Fits(NamedTuple):
    """The results of a pass, one row for each axis; a sum that the others are divided by is not in them."""

    mean: FloatArray
    """The posterior, (rows, n); before the pass the Gaussian about which the sums are linearised."""
    covariance: FloatArray
    """Filled in the last pass, (rows, n, n)."""
    known: FloatArray
    """V: the pass has made the prior's covariance less by V V', (rows, n, m); zero before the first."""
    innovation: FloatArray
    """(rows, m)"""
    innovation_covariance: FloatArray
    """Without the remainder's memory, (rows, m, m)."""
    nis: FloatArray
    """(rows,)"""
    significance: FloatArray
    """The light in the window over its standard deviation, (rows,)."""
    closed_loop: FloatArray
    """How an error of the start state goes on to the next exposure's, A (I - K H), (rows, n_states, n_states)."""


@compiled
def linearise(
    lines: Lines, prior_mean: FloatArray, prior_covariance: FloatArray, memory: FloatArray, path_reach: float,
    kernel_reach: float, last: bool, fits: Fits,
) -> None:  # fmt: skip
    """Priors (rows, n) and (rows, n, n) updated with the sums, linearised about the previous pass.

    The coefficients after the start state have the prior N(0, I).
    """
    n, nodes = lines.basis.shape
    sums, pixels, states = len(lines.orders), lines.density.shape[1], len(lines.end_rows)
    first = 1 if lines.ratios else 0
    m, width = sums - first, lines.shared.shape[1]
    path, variance = np.empty(nodes), np.empty(nodes)
    left, right = np.zeros((states + m, width)), np.zeros((states + m, width))
    W, change, places = np.empty((sums, pixels)), np.empty((pixels + 1, sums)), np.empty(pixels + 1)
    g = np.zeros((3, _padded(sums, _SUMS), width))
    y, expected, slope = np.empty(sums), np.empty(sums), np.empty((sums, n))
    noise, remainder = np.empty((sums, sums)), np.empty((sums, sums))
    for row in range(len(prior_mean)):
        _spread(
            row, lines.basis, lines.inputs, fits.mean, prior_covariance, fits.known, lines.shared, path, variance,
            left, right,
        )  # fmt: skip
        _window(
            row, lines.usable, lines.low, lines.high, lines.pixel, lines.orders, lines.functions, path, variance,
            path_reach, kernel_reach * math.sqrt(lines.kernel_variance + lines.pixel * lines.pixel / 12.0), W,
        )  # fmt: skip
        light = lines.light[row]
        _weighted_sums(
            row, lines.density, lines.pixel, lines.read_noise / (light * light), lines.shot_noise / light, W, y, noise
        )
        edges = _edges(lines.low, lines.pixel, W, places, change)
        kernel_variance = lines.kernel_variance + lines.widening
        _responses(edges, path, variance, lines.weights, kernel_variance, places, change, expected, g)
        _slopes(lines.basis, g, slope)
        _remainder(lines.shared, left, right, g, remainder)
        if lines.ratios:
            fits.significance[row] = y[0] / math.sqrt(noise[0, 0])
            _divide_slopes(expected, slope)
            _divide(y, noise)
            _divide(expected, remainder)
        _update(
            row, first, y, expected, slope, noise, remainder, memory[row], prior_mean, prior_covariance, last,
            lines.end_rows, fits,
        )  # fmt: skip


@compiled
def _update(
    row: int, first: int, y: FloatArray, expected: FloatArray, slope: FloatArray, noise: FloatArray,
    remainder: FloatArray, memory: float, prior_mean: FloatArray, prior_covariance: FloatArray, last: bool,
    end_rows: FloatArray, fits: Fits,
) -> None:  # fmt: skip
    """A Kalman update of one row with the sums from ``first`` on, as `joseph_update`."""
    sums, n = slope.shape
    m, states = sums - first, len(end_rows)
    H, HP, R = np.empty((m, n)), np.empty((m, n)), np.empty((m, m))
    S, own, root = np.empty((m, m)), np.empty((m, m)), np.empty((m, m))
    new, x, K = np.empty(m), np.empty(m), np.empty((n, m))
    for a in range(m):
        new[a] = y[first + a] - expected[first + a]
        for i in range(n):
            H[a, i] = slope[first + a, i]
            new[a] -= H[a, i] * (prior_mean[row, i] - fits.mean[row, i])
        for i in range(n):
            HP[a, i] = 0.0
        for j in range(n):
            for i in range(n):
                HP[a, i] += H[a, j] * prior_covariance[row, j, i]
    for a in range(m):
        for b in range(m):
            total = 0.0
            for i in range(n):
                total += HP[a, i] * H[b, i]
            R[a, b] = noise[first + a, first + b] + memory * remainder[first + a, first + b]
            S[a, b] = total + R[a, b]
            own[a, b] = total + (noise[first + a, first + b] + remainder[first + a, first + b])
    _root_into(S, root)
    for i in range(n):
        for a in range(m):
            x[a] = HP[a, i]
        lower_solve(root, x)
        for a in range(m):
            fits.known[row, i, a] = x[a]
            x[a] = HP[a, i]
        cholesky_solve(root, x)
        moved = 0.0
        for a in range(m):
            K[i, a] = x[a]
            moved += x[a] * new[a]
        fits.mean[row, i] = prior_mean[row, i] + moved
    if not last:
        for i in range(states):
            for j in range(states):
                kept = end_rows[i, j]
                for k in range(n):
                    for a in range(m):
                        kept -= end_rows[i, k] * (K[k, a] * H[a, j])
                fits.closed_loop[row, i, j] = kept
        return
    _joseph(row, prior_covariance, K, H, R, fits.covariance)
    _root_into(own, root)
    for a in range(m):
        x[a] = fits.innovation[row, a] = new[a]
        for b in range(m):
            fits.innovation_covariance[row, a, b] = own[a, b]
    cholesky_solve(root, x)
    fits.nis[row] = 0.0
    for a in range(m):
        fits.nis[row] += x[a] * new[a]


@compiled
def noise_spread(basis: FloatArray, states: int) -> FloatArray:
    """Covariance of the path at the nodes from the coefficients after the start state, which all axes share.

    The lower half, (nodes, nodes), with zeros beyond the last column for whole vectors of the processor.
    """
    n, nodes = basis.shape
    out = np.zeros((nodes, _padded(nodes, _VECTOR)))
    for k in range(nodes):
        for i in range(states, n):
            x = basis[i, k]
            for j in range(k + 1):
                out[k, j] += x * basis[i, j]
    return out


@compiled
def _padded(count: int, group: int) -> int:
    return -(-count // group) * group


@compiled
def _spread(
    row: int, basis: FloatArray, inputs: FloatArray, mean: FloatArray, P: FloatArray, known: FloatArray,
    shared: FloatArray, path: FloatArray, variance: FloatArray, left: FloatArray, right: FloatArray,
) -> None:  # fmt: skip
    """Mean and variance of the path at the nodes, (nodes,).

    Its covariance is ``shared`` + left' right, both (n_states + m, nodes).
    """
    _, n, m = known.shape
    nodes, states = len(path), len(left) - m
    for k in range(nodes):
        path[k], variance[k] = inputs[row, k], shared[k, k]
    for i in range(n):
        x = mean[row, i]
        for k in range(nodes):
            path[k] += x * basis[i, k]
    for r in range(states):
        for k in range(nodes):
            left[r, k], right[r, k] = 0.0, basis[r, k]
        for i in range(states):
            x = P[row, r, i]
            for k in range(nodes):
                left[r, k] += x * basis[i, k]
    for a in range(m):
        r = states + a
        for k in range(nodes):
            right[r, k] = 0.0
        for i in range(n):
            x = known[row, i, a]
            for k in range(nodes):
                right[r, k] += x * basis[i, k]
        for k in range(nodes):
            left[r, k] = -right[r, k]
    for r in range(len(left)):
        for k in range(nodes):
            variance[k] += left[r, k] * right[r, k]
    for k in range(nodes):
        variance[k] = max(variance[k], 0.0)


@compiled
def _window(
    row: int, usable: BoolArray, first: float, end: float, pixel: float, orders: IntArray, functions: int,
    path: FloatArray, variance: FloatArray, path_reach: float, margin: float, W: FloatArray,
) -> None:  # fmt: skip
    """Weights of the pixels in a window about the path: as `Windowed.window` and `Windowed.function`."""
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
            W[a, p] = _function(functions, orders[a], u) if inside else 0.0


@compiled
def _function(functions: int, order: int, u: float) -> float:
    if functions == 2:
        turn = math.pi * ((order + 1) // 2) * u
        return math.sin(turn) if order % 2 else math.cos(turn)
    before, value = 0.0, 1.0
    for p in range(order):
        before, value = value, u * value if functions == 0 else ((2 * p + 1) * u * value - p * before) / (p + 1)
    return value


@compiled
def _weighted_sums(
    row: int, density: FloatArray, pixel: float, read_noise: float, shot_noise: float, W: FloatArray, y: FloatArray,
    noise: FloatArray,
) -> None:  # fmt: skip
    """Sums of the pixels and their noise: as `weighted_sums`."""
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
def _edges(low: float, pixel: float, W: FloatArray, places: FloatArray, change: FloatArray) -> int:
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
def _responses(
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
def _slopes(basis: FloatArray, g: FloatArray, slope: FloatArray) -> None:
    """H, the sums' derivatives by the coefficients, (sums, n)."""
    n, nodes = basis.shape
    for a in range(len(slope)):
        for i in range(n):
            total = 0.0
            for k in range(nodes):
                total += g[0, a, k] * basis[i, k]
            slope[a, i] = total


@compiled
def _remainder(
    shared: FloatArray, left: FloatArray, right: FloatArray, g: FloatArray, remainder: FloatArray
) -> None:  # fmt: skip
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
        end = _padded(k + 1, _VECTOR)
        for j in range(end):
            c[j] = shared[k, j]
        for r in range(len(left)):
            x = left[r, k]
            for j in range(end):
                c[j] += x * right[r, j]
        own = c[k]
        for j in range(k, end):
            c[j] = 0.0
        for a in range(0, groups, _SUMS):
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
def _four_sums(
    c: FloatArray, g: FloatArray, a: int, end: int, second: FloatArray, third: FloatArray
) -> None:  # fmt: skip
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


@compiled
def _light(values: FloatArray) -> float:
    """The light that the sums are divided by; without any there is no ratio, and the significance says so."""
    return 1.0 if values[0] == 0.0 else values[0]


@compiled
def _divide(values: FloatArray, covariance: FloatArray) -> None:
    """Sums after the first one divided by it, and their covariance, to first order: as `Windowed.ratios`."""
    light, sums = _light(values), len(values)
    for a in range(1, sums):
        values[a] /= light
    for a in range(1, sums):
        for b in range(1, sums):
            covariance[a, b] += (
                values[a] * values[b] * covariance[0, 0] - values[a] * covariance[0, b] - values[b] * covariance[a, 0]
            )
            covariance[a, b] /= light * light


@compiled
def _divide_slopes(values: FloatArray, slope: FloatArray) -> None:
    """The slopes of sums after the first one divided by it, before `_divide`."""
    light = _light(values)
    for a in range(1, len(values)):
        for i in range(slope.shape[1]):
            slope[a, i] = (slope[a, i] - values[a] / light * slope[0, i]) / light


@compiled
def _joseph(row: int, P: FloatArray, K: FloatArray, H: FloatArray, R: FloatArray, out: FloatArray) -> None:
    """(I - K H) P (I - K H)' + K R K'."""
    n, m = K.shape
    keep, kept, KR = np.empty((n, n)), np.zeros((n, n)), np.empty((n, m))
    times(K, H, keep)
    times(K, R, KR)
    for i in range(n):
        for j in range(n):
            keep[i, j] = (1.0 if i == j else 0.0) - keep[i, j]
        for k in range(n):
            for j in range(n):
                kept[i, j] += keep[i, k] * P[row, k, j]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += kept[i, k] * keep[j, k]
            for a in range(m):
                total += KR[i, a] * K[j, a]
            out[row, i, j] = out[row, j, i] = total


@compiled
def _root_into(a: FloatArray, root: FloatArray) -> None:
    """Lower triangular root of a covariance: as `cholesky_into`, without its change to the diagonal."""
    n = len(a)
    for j in range(n):
        total = a[j, j]
        for k in range(j):
            total -= root[j, k] * root[j, k]
        # Sums that depend on each other leave nothing but rounding.
        least = 1e-15 * a[j, j]
        pivot = math.sqrt(total if total > least else least)
        root[j, j] = pivot
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total / pivot
