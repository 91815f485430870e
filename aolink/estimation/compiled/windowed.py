"""Iterated statistical linearisation of line sensors' windowed moments, axis by axis (row `moments_of_many_axes`).

The plain twin is `tests/estimation/moments/plain.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.small import cholesky_solve, compiled, floored_cholesky_into, lower_solve, times
from aolink.estimation.compiled.window_sums import (
    SUMS,
    VECTOR,
    edges_of,
    padded,
    remainder_of,
    responses_at_nodes,
    slopes_of,
    sums_of_row,
    window_weights,
)
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray


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
    free: int
    """Coefficients that come first and may have any prior, as the start state; the prior of the others is N(0, I)."""
    shared: FloatArray
    """`noise_spread` of the basis."""
    end_rows: FloatArray
    """End states of the coefficients, (n_states, n); none where no closed loop is asked for."""
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
    """Orders of the moments, (sums,)."""


class Fits(NamedTuple):
    """The results of a pass, one row for each axis."""

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
    closed_loop: FloatArray
    """How an error of the start state goes on to the next exposure's, A (I - K H), (rows, n_states, n_states)."""


@compiled
def linearise(
    lines: Lines, prior_mean: FloatArray, prior_covariance: FloatArray, memory: FloatArray, path_reach: float,
    kernel_reach: float, last: bool, fits: Fits,
) -> None:  # fmt: skip
    """Priors (rows, n) and (rows, n, n) updated with the sums, linearised about the previous pass."""
    n, nodes = lines.basis.shape
    m, pixels, width = len(lines.orders), lines.density.shape[1], lines.shared.shape[1]
    path, variance = np.empty(nodes), np.empty(nodes)
    left, right = np.zeros((lines.free + m, width)), np.zeros((lines.free + m, width))
    W, change, places = np.empty((m, pixels)), np.empty((pixels + 1, m)), np.empty(pixels + 1)
    g = np.zeros((3, padded(m, SUMS), width))
    y, expected, slope = np.empty(m), np.empty(m), np.empty((m, n))
    noise, remainder = np.empty((m, m)), np.empty((m, m))
    for row in range(len(prior_mean)):
        _spread(
            row, lines.basis, lines.inputs, fits.mean, prior_covariance, fits.known, lines.shared, path, variance,
            left, right,
        )  # fmt: skip
        window_weights(
            row, lines.usable, lines.low, lines.high, lines.pixel, lines.orders, path, variance,
            path_reach, kernel_reach * math.sqrt(lines.kernel_variance + lines.pixel * lines.pixel / 12.0), W,
        )  # fmt: skip
        light = lines.light[row]
        sums_of_row(
            row, lines.density, lines.pixel, lines.read_noise / (light * light), lines.shot_noise / light, W, y, noise
        )
        edges = edges_of(lines.low, lines.pixel, W, places, change)
        kernel_variance = lines.kernel_variance + lines.widening
        responses_at_nodes(edges, path, variance, lines.weights, kernel_variance, places, change, expected, g)
        slopes_of(lines.basis, g, slope)
        remainder_of(lines.shared, left, right, g, remainder)
        _update(
            row, y, expected, slope, noise, remainder, memory[row], prior_mean, prior_covariance, last,
            lines.end_rows, fits,
        )  # fmt: skip


@compiled
def _update(
    row: int, y: FloatArray, expected: FloatArray, slope: FloatArray, noise: FloatArray,
    remainder: FloatArray, memory: float, prior_mean: FloatArray, prior_covariance: FloatArray, last: bool,
    end_rows: FloatArray, fits: Fits,
) -> None:  # fmt: skip
    """A Kalman update of one row with the sums, as `joseph_update`."""
    (m, n), states = slope.shape, len(end_rows)
    H, HP, R = np.empty((m, n)), np.empty((m, n)), np.empty((m, m))
    S, own, root = np.empty((m, m)), np.empty((m, m)), np.empty((m, m))
    new, x, K = np.empty(m), np.empty(m), np.empty((n, m))
    for a in range(m):
        new[a] = y[a] - expected[a]
        for i in range(n):
            H[a, i] = slope[a, i]
            new[a] -= H[a, i] * (prior_mean[row, i] - fits.mean[row, i])
    times(H, prior_covariance[row], HP)
    for a in range(m):
        for b in range(m):
            total = 0.0
            for i in range(n):
                total += HP[a, i] * H[b, i]
            R[a, b] = noise[a, b] + memory * remainder[a, b]
            S[a, b] = total + R[a, b]
            own[a, b] = total + (noise[a, b] + remainder[a, b])
    floored_cholesky_into(S, root)
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
    _joseph(prior_covariance[row], K, H, R, fits.covariance[row])
    floored_cholesky_into(own, root)
    for a in range(m):
        x[a] = fits.innovation[row, a] = new[a]
        for b in range(m):
            fits.innovation_covariance[row, a, b] = own[a, b]
    cholesky_solve(root, x)
    fits.nis[row] = 0.0
    for a in range(m):
        fits.nis[row] += x[a] * new[a]


@compiled
def noise_spread(basis: FloatArray, free: int) -> FloatArray:
    """Covariance of the path at the nodes from the coefficients after the ``free`` ones, which all axes share.

    The lower half, (nodes, nodes), with zeros beyond the last column for whole vectors of the processor.
    """
    n, nodes = basis.shape
    out = np.zeros((nodes, padded(nodes, VECTOR)))
    for k in range(nodes):
        for i in range(free, n):
            x = basis[i, k]
            for j in range(k + 1):
                out[k, j] += x * basis[i, j]
    return out


@compiled
def _spread(
    row: int, basis: FloatArray, inputs: FloatArray, mean: FloatArray, P: FloatArray, known: FloatArray,
    shared: FloatArray, path: FloatArray, variance: FloatArray, left: FloatArray, right: FloatArray,
) -> None:  # fmt: skip
    """Mean and variance of the path at the nodes, (nodes,).

    Its covariance is ``shared`` + left' right, both (free + m, nodes).
    """
    _, n, m = known.shape
    nodes, free = len(path), len(left) - m
    for k in range(nodes):
        path[k], variance[k] = inputs[row, k], shared[k, k]
    for i in range(n):
        x = mean[row, i]
        for k in range(nodes):
            path[k] += x * basis[i, k]
    for r in range(free):
        for k in range(nodes):
            left[r, k], right[r, k] = 0.0, basis[r, k]
        for i in range(free):
            x = P[row, r, i]
            for k in range(nodes):
                left[r, k] += x * basis[i, k]
    for a in range(m):
        r = free + a
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
def _joseph(P: FloatArray, K: FloatArray, H: FloatArray, R: FloatArray, out: FloatArray) -> None:
    """(I - K H) P (I - K H)' + K R K'."""
    n, m = K.shape
    keep, kept, KR = np.empty((n, n)), np.empty((n, n)), np.empty((n, m))
    times(K, H, keep)
    times(K, R, KR)
    for i in range(n):
        for j in range(n):
            keep[i, j] = (1.0 if i == j else 0.0) - keep[i, j]
    times(keep, P, kept)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += kept[i, k] * keep[j, k]
            for a in range(m):
                total += KR[i, a] * K[j, a]
            out[i, j] = out[j, i] = total
