"""Windowed moments of a line sensor, and priors updated with them: as `aolink.estimation.moments.windowed`."""

from __future__ import annotations

import math

import numpy as np

from aolink.estimation.compiled.line import Line, path_of
from aolink.estimation.compiled.small import cholesky_into, cholesky_solve, compiled, times
from aolink.estimation.compiled.window_sums import edges_of
from aolink.numerics.arrays import FloatArray

_ORDERS = 4  # of `WindowedMoments` as `broad` uses them: u^0 to u^3


@compiled
def broad_of_lines(
    line: Line, mean: FloatArray, covariance: FloatArray, memory: FloatArray, passes: int, no_noise: float,
    path_reach: float, kernel_reach: float, out_mean: FloatArray, out_covariance: FloatArray,
) -> None:  # fmt: skip
    """Priors (rows, n) and (rows, n, n) updated with windowed moments, linearised about the previous pass.

    As `aolink.estimation.pixels.modes.broad` with `WindowedMoments` of orders 0 to 3.
    """
    n, nodes = line.basis.shape
    path, spread, CB = np.empty(nodes), np.empty((nodes, nodes)), np.empty((n, nodes))
    W, g = np.empty((_ORDERS, line.y.shape[1])), np.empty((4, nodes, _ORDERS))
    y, expected, slope = np.empty(_ORDERS), np.empty(_ORDERS), np.empty((_ORDERS, n))
    R = np.empty((_ORDERS, _ORDERS))
    about, its_covariance = np.empty(n), np.empty((n, n))
    for row in range(len(mean)):
        about[:] = mean[row]
        its_covariance[:] = covariance[row]
        for _ in range(passes):
            path_of(line.inputs[row], line.basis, about, path)
            times(its_covariance, line.basis, CB)
            times(CB.T, line.basis, spread)
            _window(line, row, path, spread, path_reach, kernel_reach, W)
            _weighted_sums(line, row, W, y, R)
            _responses(line, W, path, spread, g)
            _add_remainder(line, spread, g, memory[row], R)
            for a in range(_ORDERS):
                expected[a] = 0.0
                for i in range(n):
                    slope[a, i] = 0.0
                for k in range(nodes):
                    expected[a] += line.weights[k] * g[0, k, a]
                    for i in range(n):
                        slope[a, i] += line.weights[k] * g[1, k, a] * line.basis[i, k]
                R[a, a] += no_noise
                y[a] -= expected[a]
                for i in range(n):
                    y[a] -= slope[a, i] * (mean[row, i] - about[i])
            _corrected(mean[row], covariance[row], y, slope, R, about, its_covariance)
        out_mean[row] = about
        out_covariance[row] = its_covariance


@compiled
def _window(
    line: Line, row: int, path: FloatArray, spread: FloatArray, path_reach: float, kernel_reach: float, W: FloatArray
) -> None:
    """Powers of u in [-1, 1] across a window about the path: as `Windowed.window`."""
    margin = kernel_reach * math.sqrt(line.kernel_variance + line.pixel**2 / 12)
    room = max(margin, 2 * line.pixel)
    low, high = math.inf, -math.inf
    for k in range(len(path)):
        sd = math.sqrt(max(spread[k, k], 0.0))
        low = min(low, path[k] - path_reach * sd)
        high = max(high, path[k] + path_reach * sd)
    low, high = max(min(low - margin, line.high - room), line.low), min(max(high + margin, line.low + room), line.high)
    for p in range(W.shape[1]):
        left = line.low + p * line.pixel
        inside = left + line.pixel > low and left < high and line.usable[row, p]
        u = (left + line.pixel / 2 - (low + high) / 2) / ((high - low) / 2)
        power = 1.0 if inside else 0.0
        for a in range(_ORDERS):
            W[a, p] = power
            power *= u


@compiled
def _weighted_sums(line: Line, row: int, W: FloatArray, y: FloatArray, R: FloatArray) -> None:
    """Sums of the pixels, and their noise: as `weighted_sums`."""
    y[:] = 0.0
    R[:] = 0.0
    square = line.pixel * line.pixel
    for p in range(W.shape[1]):
        if W[0, p] == 0.0:
            continue
        density = line.y[row, p]
        variance = square * (line.read_noise + line.gain * max(density, 0.0))
        for a in range(_ORDERS):
            y[a] += W[a, p] * density * line.pixel
            x = W[a, p] * variance
            for b in range(_ORDERS):
                R[a, b] += x * W[b, p]
    largest = 0.0
    for a in range(_ORDERS):
        for b in range(_ORDERS):
            largest = max(largest, R[a, b])
    for a in range(_ORDERS):
        R[a, a] += 1e-12 * largest


@compiled
def _responses(line: Line, W: FloatArray, path: FloatArray, spread: FloatArray, g: FloatArray) -> None:
    """Expectations of the sums and of their derivatives by the spot's position at each node: as `expected_response`."""
    change, places = np.empty((W.shape[1] + 1, _ORDERS)), np.empty(W.shape[1] + 1)
    edges = edges_of(line.low, line.pixel, W, places, change)
    g[:] = 0.0
    for k in range(len(path)):
        per_width = 1.0 / math.sqrt(2 * line.kernel_variance + 2 * max(spread[k, k], 0.0))
        peak = per_width / math.sqrt(math.pi)
        for edge in range(edges):
            u = (places[edge] - path[k]) * per_width
            bell = math.exp(-u * u)
            d0, d1 = rough_half_erf(u, bell), -bell * peak
            d2 = 2 * u * per_width * d1
            d3 = (4 * u * u - 2) * per_width * per_width * d1
            for a in range(_ORDERS):
                g[0, k, a] += change[edge, a] * d0
                g[1, k, a] += change[edge, a] * d1
                g[2, k, a] += change[edge, a] * d2
                g[3, k, a] += change[edge, a] * d3


@compiled
def rough_half_erf(u: float, bell: float) -> float:
    """erf(u) / 2 where ``bell`` is exp(-u^2), to 8e-8: Abramowitz and Stegun, 7.1.26."""
    s = 1.0 / (1.0 + 0.3275911 * abs(u))
    rest = s * (0.254829592 + s * (-0.284496736 + s * (1.421413741 + s * (-1.453152027 + s * 1.061405429))))
    half = 0.5 - 0.5 * rest * bell
    return half if u > 0.0 else -half


@compiled
def _add_remainder(line: Line, spread: FloatArray, g: FloatArray, memory: float, R: FloatArray) -> None:
    """Mehler's series: Cov(g(a), g(b)) is the sum over j of C^j / j! times the means of the j-th derivatives.

    It is multiplied by ``memory``.
    """
    nodes = len(spread)
    second, third = np.empty(_ORDERS), np.empty(_ORDERS)
    for k in range(nodes):
        second[:] = 0.0
        third[:] = 0.0
        for m in range(nodes):
            c = spread[k, m]
            w = line.weights[m]
            half, sixth = w * c * c / 2, w * c * c * c / 6
            for a in range(_ORDERS):
                second[a] += half * g[2, m, a]
                third[a] += sixth * g[3, m, a]
        w = memory * line.weights[k]
        for a in range(_ORDERS):
            for b in range(_ORDERS):
                R[a, b] += w * (g[2, k, a] * second[b] + g[3, k, a] * third[b])


@compiled
def _corrected(
    mean: FloatArray, covariance: FloatArray, innovation: FloatArray, H: FloatArray, R: FloatArray,
    out_mean: FloatArray, out_covariance: FloatArray,
) -> None:  # fmt: skip
    """A Kalman update in Joseph's form: as `aolink.estimation.kalman.update.joseph_update`."""
    m, n = H.shape
    PH, S, root = np.empty((n, m)), np.empty((m, m)), np.empty((m, m))
    for i in range(n):
        for a in range(m):
            total = 0.0
            for j in range(n):
                total += covariance[i, j] * H[a, j]
            PH[i, a] = total
    for a in range(m):
        for b in range(m):
            total = (R[a, b] + R[b, a]) / 2
            for i in range(n):
                total += H[a, i] * PH[i, b]
            S[a, b] = total
    cholesky_into(S, root)
    K, keep, kept = np.empty((n, m)), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        out_mean[i] = mean[i]
        for a in range(m):
            K[i, a] = PH[i, a]
        cholesky_solve(root, K[i])
        for a in range(m):
            out_mean[i] += K[i, a] * innovation[a]
    for i in range(n):
        for j in range(n):
            keep[i, j] = 1.0 if i == j else 0.0
            for a in range(m):
                keep[i, j] -= K[i, a] * H[a, j]
    times(keep, covariance, kept)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += kept[i, k] * keep[j, k]
            for a in range(m):
                for b in range(m):
                    total += K[i, a] * R[a, b] * K[j, b]
            out_covariance[i, j] = out_covariance[j, i] = total
