"""The pixels of a line sensor: expected light, its derivatives, likelihood and Fisher information.

The share of a Gaussian spot's light that a pixel gets depends only on where the spot is within its own pixel: a short
table of Taylor series, right to 2e-7 of the brightest pixel, replaces the error function.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.small import compiled, compiled_sums, inlined
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray

AT_ONCE = 64
"""Points whose paths are computed together."""
_IN_TURN = 4
"""Points whose light is added in turn. The light of a node falls beside that of the node before, and a processor that
goes on with one point waits until what it has just stored can be read."""
LARGE = 1e200
"""A product of variance ratios is replaced by its logarithm when it exceeds this."""


class Line(NamedTuple):
    """Frames of a line sensor and the data needed to predict them, one row for each axis and start."""

    y: FloatArray
    """Densities, (rows, pixels)."""
    usable: BoolArray
    """(rows, pixels)"""
    inputs: FloatArray
    """Response of the path to the inputs at its nodes, (rows, 1, nodes)."""
    basis: FloatArray
    """The exposure basis at the nodes, transposed since the inner loops are over nodes, (1, n, nodes)."""
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

    The arguments are numbers, not the `Line`, as `log_likelihoods_of_lines` says.
    """
    v = (theta - low) * per_unit
    if not (v > -0.5 * reach and v < pixels + 0.5 * reach):
        return -1, 0, 0.0
    cell = math.floor(v)
    u = v - cell
    point = min(int(u * points), points - 1)
    return int(cell) + reach // 2, point, u - (point + 0.5) / points


@compiled
def places_of(
    paths: FloatArray, count: int, low: float, per_unit: float, pixels: int, points: int, reach: int,
    firsts: IntArray, nearest: IntArray, away: FloatArray,
) -> None:  # fmt: skip
    """`place` of each node of ``count`` paths (nodes, points), without a branch, so that several are computed at a
    time; all results are (nodes, points). Where the first pixel is -1 the others mean nothing."""
    number = paths.dtype.type  # of constants as well: otherwise single precision would be left here
    least, most, nowhere, half = number(-0.5 * reach), number(pixels + 0.5 * reach), number(0.0), number(0.5)
    low, per_unit, density = number(low), number(per_unit), number(points)
    for node in range(len(paths)):
        for k in range(count):
            v = (paths[node, k] - low) * per_unit
            lit = v > least and v < most
            v = v if lit else nowhere
            cell = number(math.floor(v))
            u = v - cell
            point = min(int(u * density), points - 1)
            firsts[node, k] = int(cell) + reach // 2 if lit else -1
            nearest[node, k] = point
            away[node, k] = u - (number(point) + half) / density


@inlined
def add_cubic(f: FloatArray, first: int, weight: float, d: float, table: FloatArray, point: int) -> None:
    """Add the light of a spot at a distance d from a point of the table to f, from its place ``first`` on."""
    begin, row = np.uintp(first), np.uintp(point)  # without a sign: nothing asks whether they count from the end
    for k in range(table.shape[2]):
        p = np.uintp(k)
        slope = table[row, 1, p] + d * (table[row, 2, p] + d * table[row, 3, p])
        f[begin + p] += weight * (table[row, 0, p] + d * slope)


@inlined
def expected_light(
    firsts: IntArray, nearest: IntArray, away: FloatArray, point: int, count: int, weights: FloatArray,
    table: FloatArray, f: FloatArray, padded: int,
) -> None:  # fmt: skip
    """Densities without noise of ``count`` of the paths that `places_of` has placed, one behind the other in f: each
    takes ``padded`` places, with the table's reach on both sides."""
    for p in range(count * padded):
        f[p] = 0.0
    for k in range(len(weights)):
        for j in range(count):
            if firsts[k, point + j] >= 0:
                first = j * padded + firsts[k, point + j]
                add_cubic(f, first, weights[k], away[k, point + j], table, nearest[k, point + j])


@inlined
def linearised_light(
    path: FloatArray, weights: FloatArray, table: FloatArray, low: float, per_unit: float, basis: FloatArray,
    slope: FloatArray, f: FloatArray, J: FloatArray,
) -> None:  # fmt: skip
    """The densities of `expected_light`, and their Jacobian J (n, padded pixels) by the coefficients of a basis (n,
    nodes).

    ``slope`` is room for (reach,).
    """
    points, _, reach = table.shape
    for p in range(len(f)):
        f[p] = 0.0
    for i in range(len(J)):
        for p in range(len(f)):
            J[i, p] = 0.0
    for k in range(len(path)):
        first, nearest, d = place(path[k], low, per_unit, len(f) - 2 * reach, points, reach)
        if first >= 0:
            w = weights[k] * per_unit
            add_cubic(f, first, weights[k], d, table, nearest)
            for p in range(reach):
                steeper = 2.0 * table[nearest, 2, p] + 3.0 * d * table[nearest, 3, p]
                slope[p] = w * (table[nearest, 1, p] + d * steeper)
            begin = np.uintp(first)
            for i in range(len(basis)):
                for p in range(reach):
                    J[i, begin + np.uintp(p)] += basis[i, k] * slope[p]


@inlined
def log_likelihood_of(
    y: FloatArray, usable: BoolArray, f: FloatArray, pad: int, read_noise: float, gain: float
) -> float:
    """Log-likelihood of pixels (pixels,) with expected densities f, which begin after ``pad`` others."""
    total, product, quiet = 0.0, 1.0, 1.0 / read_noise
    if not gain:
        for p in range(len(y)):
            if usable[p]:
                e = y[p] - f[pad + p]
                total += e * e * quiet
        return -0.5 * total
    for p in range(len(y)):
        if usable[p]:
            light = f[pad + p]
            e = y[p] - light
            if light > 0.0:
                R = read_noise + gain * light
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
    for k in range(len(path)):
        path[k] = offset[k]
    for i in range(len(t)):
        x = t[i]
        for k in range(len(path)):
            path[k] += x * basis[i, k]


@compiled
def log_likelihoods_of_lines(line: Line, row: int, t: FloatArray, begin: int, end: int, out: FloatArray) -> None:
    """Log-likelihoods of the points ``begin`` to ``end`` of t (n, points) in one row.

    In the loop over points no part of an array and no field of the `Line` is taken: each would be counted as another
    reference, and that would take as long as all the rest.
    """
    y, usable, inputs, basis, weights = line.y[row], line.usable[row], line.inputs[row, 0], line.basis[0], line.weights
    table, low, per_unit, read_noise, gain = line.table, line.low, line.per_unit, line.read_noise, line.gain
    points, _, pad = table.shape
    number, nodes, padded = table.dtype, len(weights), len(y) + 2 * pad
    f, paths = np.empty(_IN_TURN * padded, number), np.empty((nodes, AT_ONCE), number)
    firsts, nearest = np.empty((nodes, AT_ONCE), np.int64), np.empty((nodes, AT_ONCE), np.int64)
    away = np.empty((nodes, AT_ONCE), number)
    for first in range(begin, end, AT_ONCE):
        count = min(AT_ONCE, end - first)
        paths_of(inputs, basis, t, first, count, paths)
        places_of(paths, count, low, per_unit, len(y), points, pad, firsts, nearest, away)
        for point in range(0, count, _IN_TURN):
            together = min(_IN_TURN, count - point)
            expected_light(firsts, nearest, away, point, together, weights, table, f, padded)
            for k in range(together):
                begins = k * padded + pad
                out[first + point + k] = log_likelihood_of(y, usable, f, begins, read_noise, gain)


@compiled
def gradients_of_lines(
    line: Line, row: int, t: FloatArray, begin: int, end: int, out: FloatArray, gradients: FloatArray
) -> None:
    """As `log_likelihoods_of_lines`; the log-likelihoods' gradients by t are added to ``gradients``, (n, points)."""
    y, usable, inputs, basis, weights = line.y[row], line.usable[row], line.inputs[row, 0], line.basis[0], line.weights
    table, low, per_unit, read_noise, gain = line.table, line.low, line.per_unit, line.read_noise, line.gain
    points, _, pad = table.shape
    number, nodes, padded = table.dtype, len(weights), len(y) + 2 * pad
    f, paths = np.empty(_IN_TURN * padded, number), np.empty((nodes, AT_ONCE), number)
    firsts, nearest = np.empty((nodes, AT_ONCE), np.int64), np.empty((nodes, AT_ONCE), np.int64)
    away, pulls = np.empty((nodes, AT_ONCE), number), np.empty((nodes, AT_ONCE), number)
    for first in range(begin, end, AT_ONCE):
        count = min(AT_ONCE, end - first)
        paths_of(inputs, basis, t, first, count, paths)
        places_of(paths, count, low, per_unit, len(y), points, pad, firsts, nearest, away)
        for point in range(0, count, _IN_TURN):
            together = min(_IN_TURN, count - point)
            expected_light(firsts, nearest, away, point, together, weights, table, f, padded)
            for k in range(together):
                out[first + point + k] = _scores(y, usable, f, k * padded, pad, read_noise, gain)
            for node in range(nodes):
                for k in range(together):
                    pulls[node, point + k] = 0.0
                    if firsts[node, point + k] >= 0:
                        at, d = k * padded + firsts[node, point + k], away[node, point + k]
                        pull = _cubic_slopes(f, at, d, table, nearest[node, point + k])
                        pulls[node, point + k] = pull * weights[node] * per_unit
        add_gradients(basis, pulls, first, count, gradients)


@compiled_sums
def _cubic_slopes(scores: FloatArray, first: int, d: float, table: FloatArray, point: int) -> float:
    """Sum of scores, from the place ``first`` on, times the slopes of the light of `add_cubic`."""
    number, begin, row = scores.dtype.type, np.uintp(first), np.uintp(point)
    total, two, three = number(0.0), number(2.0), number(3.0)
    for k in range(table.shape[2]):
        p = np.uintp(k)
        slope = table[row, 1, p] + d * (two * table[row, 2, p] + three * d * table[row, 3, p])
        total += scores[begin + p] * slope
    return total


@compiled_sums
def _scores(
    y: FloatArray, usable: BoolArray, f: FloatArray, begin: int, pad: int, read_noise: float, gain: float
) -> float:
    """`log_likelihood_of` pixels whose expected densities begin at ``begin + pad`` in f; its derivatives by them take
    their place, and zeros that of the padding."""
    number = f.dtype.type
    nothing, quiet, total, product = number(0.0), number(1.0 / read_noise), 0.0, 1.0
    for p in range(pad):
        f[begin + p] = f[begin + pad + len(y) + p] = nothing
    first = np.uintp(begin + pad)
    if not gain:
        squares = nothing
        for p in range(len(y)):
            e = y[p] - f[first + np.uintp(p)] if usable[p] else nothing
            squares += e * e
            f[first + np.uintp(p)] = e * quiet
        return -0.5 * squares / read_noise
    for p in range(len(y)):
        light, score = f[first + np.uintp(p)], 0.0
        if usable[p]:
            e, R = y[p] - light, read_noise + gain * max(light, nothing)
            score = e / R
            total += e * score
            if light > nothing:
                product *= R / read_noise
                if product > LARGE:
                    total += math.log(product)
                    product = 1.0
                score += 0.5 * gain * (e * score - 1.0) / R
        f[first + np.uintp(p)] = score
    return -0.5 * (total + math.log(product))


@compiled
def add_gradients(basis: FloatArray, pulls: FloatArray, first: int, count: int, gradients: FloatArray) -> None:
    """Add gradients by t, (n, points), of ``count`` points from ``first`` on: derivatives by the path at the nodes,
    (nodes, points), times those of the path. The adjoint of `paths_of`."""
    for i in range(len(gradients)):
        for node in range(len(pulls)):
            for k in range(count):
                gradients[i, np.uintp(first) + np.uintp(k)] += basis[i, node] * pulls[node, k]


@compiled
def paths_of(offset: FloatArray, basis: FloatArray, t: FloatArray, first: int, count: int, paths: FloatArray) -> None:
    """Paths at the nodes, (nodes, points), of ``count`` points from ``first`` on of t (n, points)."""
    for node in range(len(offset)):
        for k in range(count):
            paths[node, k] = offset[node]
        for i in range(len(t)):
            for k in range(count):
                paths[node, k] += basis[i, node] * t[i, np.uintp(first) + np.uintp(k)]


@inlined
def fisher_information(
    y: FloatArray, usable: BoolArray, f: FloatArray, J: FloatArray, pad: int, read_noise: float, gain: float,
    scores: FloatArray, H: FloatArray, pull: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Lower half of J' I J, I each pixel's Fisher information, added to H, and J' score to ``pull``. f and J are those
    of `linearised_light`.

    Returns the log-likelihood and the sum of score^2 / I over the pixels.

    ``scores`` is room for (3, pixels).
    """
    n, pixels = len(J), len(y)
    total = square = 0.0
    product, quiet = 1.0, 1.0 / read_noise
    for p in range(pixels):
        light = max(f[pad + p], 0.0)
        relative = 0.5 * gain if f[pad + p] > 0.0 else 0.0
        information = 1.0 / (read_noise + gain * light)
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
        pull[i] += summed
        for j in range(i + 1):
            summed = 0.0
            for p in range(pixels):
                summed += J[j, pad + p] * scores[2, p]
            H[i, j] += summed
    return -0.5 * (total + math.log(product)), square


@compiled
def information_of_line(
    line: Line, row: int, path: FloatArray, basis: FloatArray, H: FloatArray, pull: FloatArray
) -> tuple[float, float]:
    """`fisher_information` of the frame of one row about a path (1, nodes), by coefficients of a basis (1, n,
    nodes)."""
    pad, pixels = line.table.shape[2], line.y.shape[1]
    f, J = np.empty(pixels + 2 * pad), np.empty((len(pull), pixels + 2 * pad))
    slope, scores = np.empty(pad), np.empty((3, pixels))
    linearised_light(path[0], line.weights, line.table, line.low, line.per_unit, basis[0], slope, f, J)
    log_likelihood, square = fisher_information(
        line.y[row], line.usable[row], f, J, pad, line.read_noise, line.gain, scores, H, pull
    )
    return log_likelihood, square
