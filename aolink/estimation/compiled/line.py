"""The pixels of a line sensor: expected light, likelihood, modes, windowed moments.

The share of a Gaussian spot's light that a pixel gets depends on where the spot is in its own pixel only: a short table
of Taylor's series, right to 2e-7 of the brightest pixel, does for the error function.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.compiled.small import cholesky, compiled, lower_inverse, solve, times

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Squared distance from a mode, in its standard deviations, at which a search ends there.
_NEXT_TO = 0.05
_ORDERS = 4  # of `WindowedMoments` as `broad` uses them: u^0 to u^3


class Line(NamedTuple):
    """What frames of line sensors show, one row for each hypothesis."""

    y: FloatArray
    """Densities, (rows, pixels)."""
    usable: BoolArray
    """(rows, pixels)"""
    inputs: FloatArray
    """What inputs add to the path at its nodes, (rows, nodes)."""
    basis: FloatArray
    """(nodes, n)"""
    weights: FloatArray
    """(nodes,)"""
    table: FloatArray
    """Taylor coefficients of the light about points of a pixel, (points, 4, reach)."""
    low: float
    """Where the first pixel begins."""
    high: float
    pixel: float
    """Width."""
    read_noise: float
    """Variance of a pixel's density."""
    gain: float
    """Of that variance by the density."""
    kernel_variance: float
    """Of the sensor's kernel, without what the nodes leave out."""


@compiled
def _place(line: Line, theta: float) -> tuple[int, int, float]:
    """First pixel that a spot gives light to, in padded rows; point of the table; distance from it. -1: no light."""
    points, _, reach = line.table.shape
    v = (theta - line.low) / line.pixel
    if not (v > -0.5 * reach and v < line.y.shape[1] + 0.5 * reach):
        return -1, 0, 0.0
    cell = math.floor(v)
    u = v - cell
    point = min(int(u * points), points - 1)
    return int(cell) + reach // 2, point, (u - (point + 0.5) / points) * line.pixel


@compiled
def _expected(line: Line, path: FloatArray, f: FloatArray) -> None:
    """Densities without noise, padded on both sides by the table's reach."""
    f[:] = 0.0
    reach = line.table.shape[2]
    for k in range(len(path)):
        first, point, d = _place(line, path[k])
        if first < 0:
            continue
        w = line.weights[k]
        row = line.table[point]
        for p in range(reach):
            f[first + p] += w * (row[0, p] + d * (row[1, p] + d * (row[2, p] + d * row[3, p])))


@compiled
def _linearised(line: Line, path: FloatArray, basis: FloatArray, f: FloatArray, J: FloatArray) -> None:
    """The same and its slope by the columns of a basis (nodes, n): J is (n, padded pixels)."""
    f[:] = 0.0
    J[:] = 0.0
    reach = line.table.shape[2]
    slope = np.empty(reach)
    for k in range(len(path)):
        first, point, d = _place(line, path[k])
        if first < 0:
            continue
        w = line.weights[k]
        row = line.table[point]
        for p in range(reach):
            f[first + p] += w * (row[0, p] + d * (row[1, p] + d * (row[2, p] + d * row[3, p])))
        for p in range(reach):
            slope[p] = w * (row[1, p] + d * (2.0 * row[2, p] + 3.0 * d * row[3, p]))
        for i in range(basis.shape[1]):
            b, rates = basis[k, i], J[i, first : first + reach]
            for p in range(reach):
                rates[p] += b * slope[p]


@compiled
def _log_likelihood(line: Line, row: int, f: FloatArray) -> float:
    pad = line.table.shape[2]
    total, quiet = 0.0, 1.0 / line.read_noise
    for p in range(line.y.shape[1]):
        if line.usable[row, p]:
            e = line.y[row, p] - f[pad + p]
            if line.gain and f[pad + p] > 0.0:
                R = line.read_noise + line.gain * f[pad + p]
                total += e * e / R + math.log(R * quiet)
            else:
                total += e * e * quiet
    return -0.5 * total


@compiled
def _path(line: Line, row: int, basis: FloatArray, t: FloatArray, path: FloatArray) -> None:
    for k in range(len(path)):
        total = line.inputs[row, k]
        for i in range(len(t)):
            total += basis[k, i] * t[i]
        path[k] = total


@compiled
def log_likelihoods(line: Line, t: FloatArray, out: FloatArray) -> None:
    """Of points (rows, points, n), (rows, points)."""
    path = np.empty(len(line.weights))
    f = np.empty(line.y.shape[1] + 2 * line.table.shape[2])
    for row in range(t.shape[0]):
        for j in range(t.shape[1]):
            _path(line, row, line.basis, t[row, j], path)
            _expected(line, path, f)
            out[row, j] = _log_likelihood(line, row, f)


@compiled
def _information(
    line: Line, row: int, f: FloatArray, J: FloatArray, H: FloatArray, pull: FloatArray
) -> tuple[float, float]:
    """H = J' I J, its lower half, pull = J' score; returns the log-likelihood and the sum of score^2 / I."""
    n, pad = len(J), line.table.shape[2]
    H[:] = 0.0
    pull[:] = 0.0
    column = np.empty(n)
    total = square = 0.0
    quiet = 1.0 / line.read_noise
    for p in range(line.y.shape[1]):
        if not line.usable[row, p]:
            continue
        value = f[pad + p]
        e = line.y[row, p] - value
        score, information = e * quiet, quiet
        total += e * score
        if line.gain and value > 0.0:
            R = line.read_noise + line.gain * value
            score, information = e / R, 1.0 / R
            total += e * score - e * e * quiet + math.log(R * quiet)
            score += line.gain * (e * score - 1.0) / (2.0 * R)
            information += line.gain * line.gain / (2.0 * R * R)
            square += score * score / information
        else:
            square += e * score
        for i in range(n):
            column[i] = J[i, pad + p]
        for i in range(n):
            x = column[i] * information
            pull[i] += column[i] * score
            for j in range(i + 1):
                H[i, j] += x * column[j]
    return -0.5 * total, square


@compiled
def linear_fits(
    line: Line, mean: FloatArray, roots: FloatArray, s: FloatArray, H: FloatArray, pull: FloatArray, square: FloatArray
) -> None:
    """In coordinates t = mean + root s, at s (rows, n): J' I J, J' score, and the sum of score^2 / I."""
    nodes, n = line.basis.shape
    width = line.y.shape[1] + 2 * line.table.shape[2]
    path, rest, B = np.empty(nodes), np.empty(nodes), np.empty((nodes, n))
    f, J = np.empty(width), np.empty((n, width))
    for row in range(len(s)):
        times(line.basis, roots[row], B)
        _path(line, row, line.basis, mean[row], rest)
        for k in range(nodes):
            path[k] = rest[k]
            for i in range(n):
                path[k] += B[k, i] * s[row, i]
        _linearised(line, path, B, f, J)
        _, square[row] = _information(line, row, f, J, H[row], pull[row])
        for i in range(n):
            for j in range(i):
                H[row, j, i] = H[row, i, j]


@compiled
def find_modes(
    line: Line, mean: FloatArray, roots: FloatArray, starts: FloatArray, passes: int, first_damping: float,
    largest_damping: float, free_damping: float, converged: float, out_mean: FloatArray, out_covariance: FloatArray,
    out_evidence: FloatArray, out_distance: FloatArray, out_objective: FloatArray,
) -> None:  # fmt: skip
    """Where starts (rows, starts, n), whitened, lead by Levenberg and Marquardt's method.

    As `aolink.estimation.profile.find_modes`; ``mean`` and ``roots`` are the prior's, (rows, n) and (rows, n, n).
    """
    nodes, n = line.basis.shape
    width = line.y.shape[1] + 2 * line.table.shape[2]
    path, rest, B = np.empty(nodes), np.empty(nodes), np.empty((nodes, n))
    f, J = np.empty(width), np.empty((n, width))
    s, there, step = np.empty(n), np.empty(n), np.empty(n)
    H, pull, other, its_pull = np.empty((n, n)), np.empty(n), np.empty((n, n)), np.empty(n)
    damped, root, inverse = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    ends, their_H = np.empty(starts.shape[1:]), np.empty((starts.shape[1], n, n))
    for row in range(starts.shape[0]):
        times(line.basis, roots[row], B)
        _path(line, row, line.basis, mean[row], rest)
        for start in range(starts.shape[1]):
            s[:] = starts[row, start]
            now = _at(line, row, rest, B, s, path, f, J, H, pull)
            damping, twin = first_damping, -1
            for _ in range(passes):
                for i in range(n):
                    for j in range(i + 1):
                        damped[i, j] = H[i, j]
                    damped[i, i] += damping * H[i, i]
                    step[i] = pull[i]
                cholesky(damped, root)
                solve(root, step)
                decrement = 0.0
                for i in range(n):
                    there[i] = s[i] + step[i]
                    decrement += step[i] * pull[i]
                objective = _at(line, row, rest, B, there, path, f, J, other, its_pull)
                gain, before = now - objective, damping
                better = gain > 0
                if better:
                    now = objective
                    s[:] = there
                    H[:] = other
                    pull[:] = its_pull
                    damping = damping / 8
                    twin = _near(s, ends[:start], their_H[:start])
                    if twin >= 0:
                        break
                else:
                    damping = max(damping, 1e-3) * 8
                if before <= free_damping and ((better and gain < converged) or decrement < converged):
                    break
                if damping > largest_damping:
                    break
            ends[start] = s
            their_H[start] = H
            if twin >= 0:
                ends[start], their_H[start] = ends[twin], their_H[twin]
                out_mean[row, start], out_covariance[row, start] = out_mean[row, twin], out_covariance[row, twin]
                out_evidence[row, start], out_distance[row, start] = out_evidence[row, twin], out_distance[row, twin]
                out_objective[row, start] = out_objective[row, twin]
                continue
            cholesky(H, root)
            log_H = 0.0
            for i in range(n):
                log_H += 2 * math.log(root[i, i])
            lower_inverse(root, inverse)
            # Covariance L H^-1 L' = W W' with W = L R^-T.
            distance = 0.0
            for i in range(n):
                distance += s[i] * s[i]
                out_mean[row, start, i] = mean[row, i]
                for j in range(n):
                    total = 0.0
                    for k in range(n):
                        total += roots[row, i, k] * inverse[j, k]
                    damped[i, j] = total
                    out_mean[row, start, i] += roots[row, i, j] * s[j]
            for i in range(n):
                for j in range(i + 1):
                    total = 0.0
                    for k in range(n):
                        total += damped[i, k] * damped[j, k]
                    out_covariance[row, start, i, j] = out_covariance[row, start, j, i] = total
            out_evidence[row, start] = -now - 0.5 * log_H
            out_distance[row, start] = distance
            out_objective[row, start] = now


@compiled
def _near(s: FloatArray, ends: FloatArray, H: FloatArray) -> int:
    """A mode that s is on its way to, next to it already, or -1; their informations' lower halves, (modes, n, n)."""
    n = len(s)
    away = np.empty(n)
    for m in range(len(ends)):
        distance = 0.0
        for i in range(n):
            away[i] = s[i] - ends[m, i]
            for j in range(i):
                distance += 2.0 * away[i] * H[m, i, j] * away[j]
            distance += away[i] * H[m, i, i] * away[i]
        if distance < _NEXT_TO:
            return m
    return -1


@compiled
def _at(
    line: Line, row: int, rest: FloatArray, B: FloatArray, s: FloatArray, path: FloatArray, f: FloatArray,
    J: FloatArray, H: FloatArray, pull: FloatArray,
) -> float:  # fmt: skip
    """Information, downward pull and objective at whitened coordinates s."""
    n = len(s)
    for k in range(len(path)):
        path[k] = rest[k]
        for i in range(n):
            path[k] += B[k, i] * s[i]
    _linearised(line, path, B, f, J)
    log_likelihood, _ = _information(line, row, f, J, H, pull)
    square = 0.0
    for i in range(n):
        H[i, i] += 1.0
        pull[i] -= s[i]
        square += s[i] * s[i]
    return float(0.5 * square - log_likelihood)


@compiled
def mark_repeats(mean: FloatArray, covariance: FloatArray, apart: float, evidence: FloatArray) -> None:
    """Log-evidence (rows, modes) becomes minus infinity for modes that an earlier one is, too."""
    rows, count, n = mean.shape
    root, inverse = np.empty((n, n)), np.empty((n, n))
    for row in range(rows):
        for j in range(1, count):
            if evidence[row, j] == -math.inf:
                continue
            cholesky(covariance[row, j], root)
            lower_inverse(root, inverse)
            for other in range(j):
                if evidence[row, other] == -math.inf:
                    continue
                distance = 0.0
                for i in range(n):
                    white = 0.0
                    for k in range(i + 1):
                        white += inverse[i, k] * (mean[row, other, k] - mean[row, j, k])
                    distance += white * white
                if distance < apart * apart:
                    evidence[row, j] = -math.inf
                    break


@compiled
def broad(
    line: Line, mean: FloatArray, covariance: FloatArray, passes: int, no_noise: float, path_reach: float,
    kernel_reach: float, out_mean: FloatArray, out_covariance: FloatArray,
) -> None:  # fmt: skip
    """Priors (rows, n) and (rows, n, n) corrected with windowed moments, linearised about what came before.

    As `aolink.estimation.profile.broad` with `WindowedMoments` of orders 0 to 3.
    """
    nodes, n = line.basis.shape
    path, spread, BC = np.empty(nodes), np.empty((nodes, nodes)), np.empty((nodes, n))
    W, g = np.empty((_ORDERS, line.y.shape[1])), np.empty((4, nodes, _ORDERS))
    y, expected, slope = np.empty(_ORDERS), np.empty(_ORDERS), np.empty((_ORDERS, n))
    R = np.empty((_ORDERS, _ORDERS))
    about, its_covariance = np.empty(n), np.empty((n, n))
    for row in range(len(mean)):
        about[:] = mean[row]
        its_covariance[:] = covariance[row]
        for _ in range(passes):
            _path(line, row, line.basis, about, path)
            times(line.basis, its_covariance, BC)
            for k in range(nodes):
                for m in range(k + 1):
                    total = 0.0
                    for i in range(n):
                        total += BC[k, i] * line.basis[m, i]
                    spread[k, m] = spread[m, k] = total
            _window(line, row, path, spread, path_reach, kernel_reach, W)
            _weighted_sums(line, row, W, y, R)
            _responses(line, W, path, spread, g)
            _add_remainder(line, spread, g, R)
            for a in range(_ORDERS):
                expected[a] = 0.0
                for i in range(n):
                    slope[a, i] = 0.0
                for k in range(nodes):
                    expected[a] += line.weights[k] * g[0, k, a]
                    for i in range(n):
                        slope[a, i] += line.weights[k] * g[1, k, a] * line.basis[k, i]
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
    """Expectations of the sums and of their derivatives by the spot's place at each node: as `expected_response`."""
    count = W.shape[1]
    g[:] = 0.0
    for k in range(len(path)):
        width = math.sqrt(2 * line.kernel_variance + 2 * max(spread[k, k], 0.0))
        for edge in range(count + 1):
            changes = False
            for a in range(_ORDERS):
                left = W[a, edge - 1] if edge else 0.0
                right = W[a, edge] if edge < count else 0.0
                changes = changes or left != right
            if not changes:
                continue
            u = (line.low + edge * line.pixel - path[k]) / width
            bell = math.exp(-u * u) / (math.sqrt(math.pi) * width)
            d0, d1 = math.erf(u) / 2, -bell
            d2 = -(2 * u / width) * bell
            d3 = -(4 * u * u - 2) / width**2 * bell
            for a in range(_ORDERS):
                left = W[a, edge - 1] if edge else 0.0
                right = W[a, edge] if edge < count else 0.0
                change = left - right
                g[0, k, a] += change * d0
                g[1, k, a] += change * d1
                g[2, k, a] += change * d2
                g[3, k, a] += change * d3


@compiled
def _add_remainder(line: Line, spread: FloatArray, g: FloatArray, R: FloatArray) -> None:
    """Mehler's series: Cov(g(a), g(b)) is the sum over j of C^j / j! times the means of the j-th derivatives."""
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
        w = line.weights[k]
        for a in range(_ORDERS):
            for b in range(_ORDERS):
                R[a, b] += w * (g[2, k, a] * second[b] + g[3, k, a] * third[b])


@compiled
def _corrected(
    mean: FloatArray, covariance: FloatArray, innovation: FloatArray, H: FloatArray, R: FloatArray,
    out_mean: FloatArray, out_covariance: FloatArray,
) -> None:  # fmt: skip
    """A Kalman correction in Joseph's form: as `aolink.estimation.observation.corrected`."""
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
    cholesky(S, root)
    K, keep, kept = np.empty((n, m)), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        out_mean[i] = mean[i]
        for a in range(m):
            K[i, a] = PH[i, a]
        solve(root, K[i])
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
