"""Moments of spots in windows about them: measured, and their regression on a path's coefficients under a Gaussian.

A line sensor is a window of one row. A moment is sum_rc a(c) b(r) Y_rc D, a monomial a of the columns times one b of
the rows, in a window about the spot in both directions. Kernel and Gaussian together displace the spot by a Gaussian
(X, Y) from where the path's mean has it, and E[a(X) b(Y)] is, by Mehler's series, the sum over j of
c^j / j! E[a^(j)(X)] E[b^(j)(Y)], c their covariance. So are the covariances between two nodes in time and two spots: of
first order they are the regression, and of second and third what it leaves out. Each factor is in closed form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.small import compiled, compiled_sums, decay
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray

POWERS = 4
"""Monomials along a direction: orders 0 to 3."""
LINE = np.array([(0, 0), (1, 0), (2, 0), (3, 0)])
PLANE = np.array([(0, 0), (1, 0), (2, 0), (3, 0), (0, 1), (0, 2), (0, 3), (1, 1)])
"""Orders of the moments of a spot along columns and rows. y_11 distinguishes motion along one diagonal from that along
the other."""
_TERMS = 5
"""Terms of Mehler's series: what the next adds is in the rounding unless the two directions are one."""
_LEAST_OF_A_ROW = 0.5
"""A row of pixels of which more are missing is left out; so is, of the rest, a column with any missing."""
_PATH_REACH, _KERNEL_REACH = 3.0, 2.0
"""Half width of the window beyond the path's mean, in standard deviations of the path, and of the kernel beyond."""


class Windows(NamedTuple):
    """The pixels about each spot of each axis, (axes, spots, rows, columns)."""

    density: FloatArray
    """Zero where a pixel cannot be used."""
    usable: BoolArray
    light: FloatArray
    """The share of a whole spot's light that the densities were divided by, (axes, spots)."""


class Optics(NamedTuple):
    """What a spot looks like, and the camera's noise."""

    low: float
    """Edge at which the first pixel begins, in both directions, slope units."""
    pixel: float
    """Width of a pixel, slope units."""
    size: float
    """Its length on a line, its area on a plane."""
    read_noise: float
    """Variance of a dark pixel's light, which is its density times its size."""
    shot_noise: float
    """Increase of that variance with the density."""
    kernel: FloatArray
    """Covariance of the kernel, slope units squared, (2, 2)."""
    widening: float
    """Variance of the path about its nodes that no coefficient covers, slope units squared."""


class Path(NamedTuple):
    """The path at nodes in time; outputs are x and y of each spot in turn, or x of a line."""

    basis: FloatArray
    """(outputs, n, nodes)"""
    inputs: FloatArray
    """Its response to the inputs, (axes, outputs, nodes)."""
    weights: FloatArray
    """Each node's share of the exposure, (nodes,)."""


class Regression(NamedTuple):
    """The moments of each axis, m of them, and their linear regression on n coefficients."""

    value: FloatArray
    """y, (axes, m)."""
    noise: FloatArray
    """R, (axes, m, m)."""
    expected: FloatArray
    """E[y], (axes, m)."""
    slope: FloatArray
    """H, (axes, m, n)."""
    remainder: FloatArray
    """Omega, covariance of what is not linear, (axes, m, m)."""


@compiled
def linearise(
    windows: Windows, optics: Optics, path: Path, orders: IntArray, mean: FloatArray, covariance: FloatArray,
    out: Regression,
) -> None:  # fmt: skip
    """Fill in the regression under Gaussians of the coefficients, (axes, n) and (axes, n, n)."""
    (axes, spots, height, width), (outputs, n, nodes) = windows.density.shape, path.basis.shape
    weights, directions, sums = path.weights, outputs // spots, len(orders)
    highest = 4 if directions == 1 else 4 + _TERMS - 1
    place, spread = np.empty((outputs, nodes)), np.empty((outputs, n, nodes))
    variance, beside = np.zeros((2, nodes)), np.zeros(nodes)
    A, B = np.zeros((POWERS, width)), np.ones((POWERS, height))
    share = np.zeros((2, highest, POWERS, nodes))
    share[1, 0] = 1.0
    # Derivatives of each spot's moments by its position: of orders 0 to 3, by y 0 to as many times.
    g = np.zeros((spots, 10, sums, nodes))
    for axis in range(axes):
        out.noise[axis] = 0.0
        for o in range(outputs):
            for k in range(nodes):
                place[o, k] = path.inputs[axis, o, k]
            for i in range(n):
                for k in range(nodes):
                    place[o, k] += mean[axis, i] * path.basis[o, i, k]
                    spread[o, i, k] = 0.0
                for j in range(n):
                    x = covariance[axis, i, j]
                    for k in range(nodes):
                        spread[o, i, k] += x * path.basis[o, j, k]
        for spot in range(spots):
            first = directions * spot
            for d in range(directions):
                _products(path.basis[first + d], spread[first + d], variance[d])
            if directions == 2:
                _products(path.basis[first], spread[first + 1], beside)
            _window(axis, spot, windows.usable, optics, place[first : first + directions], variance, A, B)
            _measure(axis, spot, windows, optics, orders, A, B, out.value, out.noise)
            for d in range(directions):
                _responses(
                    A if d == 0 else B, optics.low, optics.pixel, optics.kernel[d, d] + optics.widening,
                    place[first + d], variance[d], highest, share[d],
                )  # fmt: skip
            _derivatives(orders, share, beside, optics.kernel[0, 1], weights, directions, g[spot])
            for a in range(sums):
                row = spot * sums + a
                out.expected[axis, row] = g[spot, 0, a].sum()
                for i in range(n):
                    total = 0.0
                    for d in range(directions):
                        for k in range(nodes):
                            total += g[spot, 1 + d, a, k] * path.basis[first + d, i, k]
                    out.slope[axis, row, i] = total
        for s in range(spots):
            for t in range(s + 1):
                block = out.remainder[axis, s * sums : (s + 1) * sums, t * sums : (t + 1) * sums]
                if directions == 1:
                    _remainder_of_line(path.basis[s], spread[t], g[s], g[t], block)
                else:
                    x, y = slice(2 * s, 2 * s + 2), slice(2 * t, 2 * t + 2)
                    _remainder_of_plane(path.basis[x], spread[y], g[s], g[t], block)
                for a in range(sums):
                    for b in range(sums):
                        out.remainder[axis, t * sums + b, s * sums + a] = block[a, b]
        symmetric = out.remainder[axis]
        for a in range(len(symmetric)):
            for b in range(a):
                symmetric[a, b] = symmetric[b, a] = 0.5 * (symmetric[a, b] + symmetric[b, a])


@compiled_sums
def _products(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Sums of products of columns, (n, nodes) and (n, nodes) -> (nodes,)."""
    for k in range(len(out)):
        out[k] = 0.0
    for i in range(len(a)):
        for k in range(len(out)):
            out[k] += a[i, k] * b[i, k]


@compiled
def _window(
    axis: int, spot: int, usable: BoolArray, optics: Optics, place: FloatArray, variance: FloatArray, A: FloatArray,
    B: FloatArray,
) -> None:  # fmt: skip
    """Monomials of the columns and of the rows, (powers, pixels), zero outside of the window and where pixels are
    missing. The window reaches beyond wherever the path may be."""
    height, width = usable.shape[2:]
    rows, columns = np.zeros(height, np.bool_), np.ones(width, np.bool_)
    for r in range(height):
        count = 0
        for c in range(width):
            count += usable[axis, spot, r, c]
        rows[r] = count >= _LEAST_OF_A_ROW * width and count > 0
        if rows[r]:
            for c in range(width):
                columns[c] = columns[c] and usable[axis, spot, r, c]
    _monomials(columns, optics.low, optics.pixel, optics.kernel[0, 0], place[0], variance[0], A)
    if len(place) > 1:
        _monomials(rows, optics.low, optics.pixel, optics.kernel[1, 1], place[1], variance[1], B)
    elif not rows[0]:
        A[:] = 0.0


@compiled
def _monomials(
    good: BoolArray, begin: float, pixel: float, kernel: float, place: FloatArray, variance: FloatArray, out: FloatArray
) -> None:
    end = begin + len(good) * pixel
    margin = _KERNEL_REACH * math.sqrt(kernel + pixel * pixel / 12.0)
    # A window needs room on the sensor, wherever the path is expected.
    room = max(margin, 2.0 * pixel)
    low, high = math.inf, -math.inf
    for k in range(len(place)):
        reach = _PATH_REACH * math.sqrt(max(variance[k], 0.0))
        low, high = min(low, place[k] - reach), max(high, place[k] + reach)
    low, high = max(min(low - margin, end - room), begin), min(max(high + margin, begin + room), end)
    for p in range(len(good)):
        left = begin + p * pixel
        inside = left + pixel > low and left < high and good[p]
        u = (left + pixel / 2.0 - (low + high) / 2.0) / ((high - low) / 2.0)
        power = 1.0 if inside else 0.0
        for a in range(len(out)):
            out[a, p] = power
            power *= u


@compiled
def _measure(
    axis: int, spot: int, windows: Windows, optics: Optics, orders: IntArray, A: FloatArray, B: FloatArray,
    value: FloatArray, noise: FloatArray,
) -> None:  # fmt: skip
    """The moments of a spot, and their noise."""
    sums, light, base = len(orders), windows.light[axis, spot], spot * len(orders)
    read, shot = optics.read_noise / (light * light), optics.shot_noise / light
    W = np.empty(sums)
    for a in range(sums):
        value[axis, base + a] = 0.0
    for r in range(B.shape[1]):
        if B[0, r] == 0.0:
            continue
        for c in range(A.shape[1]):
            if A[0, c] == 0.0:
                continue
            Y = windows.density[axis, spot, r, c]
            variance = read + shot * max(Y, 0.0)
            for a in range(sums):
                W[a] = A[orders[a, 0], c] * B[orders[a, 1], r]
                value[axis, base + a] += W[a] * Y * optics.size
                for b in range(a + 1):
                    noise[axis, base + a, base + b] += W[a] * W[b] * variance
    largest = 0.0
    for a in range(sums):
        largest = max(largest, noise[axis, base + a, base + a])
        for b in range(a):
            noise[axis, base + b, base + a] = noise[axis, base + a, base + b]
    # Where a window has fewer pixels than monomials, their sums are linearly dependent; where it has none, all are
    # zero, and say nothing whatever their noise is.
    for a in range(sums):
        noise[axis, base + a, base + a] += 1e-12 * largest if largest > 0.0 else 1.0


@compiled_sums
def _responses(
    W: FloatArray, low: float, pixel: float, kernel: float, place: FloatArray, variance: FloatArray, highest: int,
    out: FloatArray,
) -> None:  # fmt: skip
    """Expectations of the weighted sums along one direction and of their derivatives by the spot's position, of orders
    below ``highest``, at each node: (highest, powers, nodes)."""
    nodes, pixels = len(place), W.shape[1]
    per_sd, z, bell = np.empty(nodes), np.empty(nodes), np.empty(nodes)
    here, before, older = np.empty(nodes), np.empty(nodes), np.empty(nodes)
    change = np.empty(len(W))
    out[:highest] = 0.0
    for k in range(nodes):
        per_sd[k] = 1.0 / math.sqrt(kernel + max(variance[k], 0.0))
    for edge in range(pixels + 1):
        changes = False
        for a in range(len(W)):
            change[a] = (W[a, edge - 1] if edge else 0.0) - (W[a, edge] if edge < pixels else 0.0)
            changes = changes or change[a] != 0.0
        if not changes:
            continue
        for k in range(nodes):
            z[k] = (low + edge * pixel - place[k]) * per_sd[k]
            bell[k] = decay(-0.5 * z[k] * z[k])
            here[k] = half_erf(z[k] * math.sqrt(0.5), bell[k])
            before[k] = 0.0
        for order in range(highest):
            for a in range(len(W)):
                for k in range(nodes):
                    out[order, a, k] += change[a] * here[k]
            # The n-th derivative by the position is -He_(n-1)(z) phi(z) / sd^n (Hermite's polynomials).
            for k in range(nodes):
                older[k] = before[k]
                before[k] = here[k] if order else 0.0
                if order == 0:
                    here[k] = -bell[k] * per_sd[k] / math.sqrt(2.0 * math.pi)
                else:
                    here[k] = per_sd[k] * (z[k] * here[k] - (order - 1) * per_sd[k] * older[k])


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
def _derivatives(
    orders: IntArray, share: FloatArray, beside: FloatArray, kernel: float, weights: FloatArray, directions: int,
    g: FloatArray,
) -> None:  # fmt: skip
    """Expectations of the moments' derivatives by the spot's position, times the nodes' weights: (10, sums, nodes),
    those of order n, by y i times, in row n (n + 1) / 2 + i."""
    highest, nodes = share.shape[1], len(weights)
    factor = np.empty(nodes)
    for n in range(4):
        for i in range(n + 1 if directions == 2 else 1):
            row = n * (n + 1) // 2 + i
            for a in range(len(orders)):
                p, q = orders[a, 0], orders[a, 1]
                for k in range(nodes):
                    g[row, a, k], factor[k] = 0.0, weights[k]
                if directions == 1:
                    for k in range(nodes):
                        g[row, a, k] = weights[k] * share[0, n, p, k]
                    continue
                for j in range(min(_TERMS, highest - max(n - i, i))):
                    for k in range(nodes):
                        g[row, a, k] += factor[k] * share[0, n - i + j, p, k] * share[1, i + j, q, k]
                        factor[k] *= (beside[k] + kernel) / (j + 1)


@compiled_sums
def _remainder_of_line(basis: FloatArray, spread: FloatArray, f: FloatArray, g: FloatArray, out: FloatArray) -> None:
    """Covariance of what the regressions of two lines leave out: the sum over nodes of c^2/2 times second derivatives,
    and of c^3/6 times third ones."""
    (n, nodes), sums = basis.shape, len(out)
    c, two, three = np.empty(nodes), np.empty(sums), np.empty(sums)
    out[:] = 0.0
    for k in range(nodes):
        for j in range(nodes):
            c[j] = 0.0
        for i in range(n):
            x = basis[i, k]
            for j in range(nodes):
                c[j] += x * spread[i, j]
        for b in range(sums):
            second = third = 0.0
            for j in range(nodes):
                square = c[j] * c[j]
                second += square * g[3, b, j]
                third += square * c[j] * g[6, b, j]
            two[b], three[b] = second, third
        for a in range(sums):
            for b in range(sums):
                out[a, b] += 0.5 * f[3, a, k] * two[b] + f[6, a, k] * three[b] * (1.0 / 6.0)


@compiled_sums
def _remainder_of_plane(basis: FloatArray, spread: FloatArray, f: FloatArray, g: FloatArray, out: FloatArray) -> None:
    """As `_remainder_of_line`, of two spots on a plane: for each order n, the sum over all ways to pair n derivatives
    of f by x or y with n of g, of the product of the pairs' covariances, over n!."""
    (_, n, nodes), sums = basis.shape, len(out)
    c, ways = np.empty((2, 2, nodes)), np.empty((3, nodes))
    met = np.empty((7, sums))
    out[:] = 0.0
    for k in range(nodes):
        for d in range(2):
            for e in range(2):
                for j in range(nodes):
                    c[d, e, j] = 0.0
                for i in range(n):
                    x = basis[d, i, k]
                    for j in range(nodes):
                        c[d, e, j] += x * spread[e, i, j]
        met[:] = 0.0
        for order in range(2, 4):
            base = order * (order + 1) // 2
            for i in range(order + 1):
                for h in range(order + 1):
                    # Of i derivatives of f by y and h of g by y, `both` are paired with each other.
                    for j in range(nodes):
                        ways[0, j] = 0.0
                    for both in range(max(0, i + h - order), min(i, h) + 1):
                        yy, yx, xy, xx = both, i - both, h - both, order - i - h + both
                        scale = 1.0 / (_FACTORIALS[yy] * _FACTORIALS[yx] * _FACTORIALS[xy] * _FACTORIALS[xx])
                        for j in range(nodes):
                            ways[1, j] = scale
                        for d, e, times in ((1, 1, yy), (1, 0, yx), (0, 1, xy), (0, 0, xx)):
                            for _ in range(times):
                                for j in range(nodes):
                                    ways[1, j] *= c[d, e, j]
                        for j in range(nodes):
                            ways[0, j] += ways[1, j]
                    for b in range(sums):
                        total = 0.0
                        for j in range(nodes):
                            total += ways[0, j] * g[base + h, b, j]
                        met[base - 3 + i, b] += total
        for row in range(7):
            for a in range(sums):
                x = f[3 + row, a, k]
                for b in range(sums):
                    out[a, b] += x * met[row, b]


_FACTORIALS = (1.0, 1.0, 2.0, 6.0)
