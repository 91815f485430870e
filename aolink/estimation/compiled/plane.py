"""The pixels of spots on a plane: expected light, its derivatives, and likelihood.

As `compiled.line`: a Gaussian spot's light in a row of pixels, and in a column, comes from a short table of Taylor
series, and a pixel's light is the product of the two; where the kernel lies aslant, the sum of a few such products.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.line import (
    AT_ONCE,
    LARGE,
    add_gradients,
    fisher_information,
    log_likelihood_of,
    paths_of,
    place,
    places_of,
)
from aolink.estimation.compiled.small import compiled, compiled_sums, inlined
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray


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
    """Log-likelihoods of the points ``begin`` to ``end`` of t (n, points) in one row.

    In the loop over points no part of an array is taken, as `compiled.line.log_likelihoods_of_lines` says.
    """
    weights, terms, low, per_unit = seen.weights, seen.terms, seen.low, seen.per_unit
    across, down, read_noise, gain = seen.across, seen.down, seen.read_noise, seen.gain
    side, wide, high = seen.y.shape[2], across.shape[3], down.shape[3]
    # Padded by what a spot outside the window still lights in it.
    number, nodes = across.dtype, len(weights)
    f = np.zeros((side + 2 * high, side + 2 * wide), number)
    flat = f.ravel()
    columns, rows = np.empty(wide, number), np.empty(high, number)
    own, dark = np.empty(side * side, number), np.empty(side)
    path = np.empty((nodes, AT_ONCE), number)
    dx, dy = np.empty((nodes, AT_ONCE), number), np.empty((nodes, AT_ONCE), number)
    lefts, tops = np.empty((nodes, AT_ONCE), np.int64), np.empty((nodes, AT_ONCE), np.int64)
    of_columns, of_rows = np.empty((nodes, AT_ONCE), np.int64), np.empty((nodes, AT_ONCE), np.int64)
    for first in range(begin, end, AT_ONCE):
        count = min(AT_ONCE, end - first)
        for k in range(count):
            out[first + k] = 0.0
        for spot in range(seen.y.shape[1]):
            paths_of(seen.inputs[row, 2 * spot], seen.basis[2 * spot], t, first, count, path)
            places_of(path, count, low, per_unit, side, across.shape[1], wide, lefts, of_columns, dx)
            paths_of(seen.inputs[row, 2 * spot + 1], seen.basis[2 * spot + 1], t, first, count, path)
            places_of(path, count, low, per_unit, side, down.shape[1], high, tops, of_rows, dy)
            light, usable = seen.y[row, spot].ravel(), seen.usable[row, spot].ravel()
            # The sums of rows without light, for all points.
            _squares(light, usable, flat, f.shape[1], side, 0, 0, 0, 0, dark)
            for k in range(count):
                top, bottom, left, right = _add_light(
                    k, lefts, of_columns, dx, tops, of_rows, dy, weights, terms, across, down, columns, rows, f
                )
                if gain:
                    for r in range(side):
                        for c in range(side):
                            own[r * side + c] = f[high + r, wide + c]
                    out[first + k] += log_likelihood_of(light, usable, own, 0, read_noise, gain)
                else:
                    squares = _squares(light, usable, flat, f.shape[1], side, high, wide, top, bottom, dark)
                    out[first + k] -= 0.5 * squares / read_noise
                for r in range(top, bottom):
                    for c in range(left, right):
                        f[r, c] = 0.0


@compiled
def gradients_of_spots(
    seen: Plane, row: int, t: FloatArray, begin: int, end: int, out: FloatArray, gradients: FloatArray
) -> None:
    """As `log_likelihoods_of_spots`; the log-likelihoods' gradients by t are added to ``gradients``, (n, points)."""
    weights, terms, low, per_unit = seen.weights, seen.terms, seen.low, seen.per_unit
    across, down, read_noise, gain = seen.across, seen.down, seen.read_noise, seen.gain
    side, wide, high = seen.y.shape[2], across.shape[3], down.shape[3]
    number, nodes = across.dtype, len(weights)
    f = np.zeros((side + 2 * high, side + 2 * wide), number)
    columns, rows, dark = np.empty(wide, number), np.empty(high, number), np.empty(side)
    column_slopes, row_slopes, pull = np.empty(wide, number), np.empty(high, number), np.empty(2, number)
    path = np.empty((nodes, AT_ONCE), number)
    dx, dy = np.empty((nodes, AT_ONCE), number), np.empty((nodes, AT_ONCE), number)
    lefts, tops = np.empty((nodes, AT_ONCE), np.int64), np.empty((nodes, AT_ONCE), np.int64)
    of_columns, of_rows = np.empty((nodes, AT_ONCE), np.int64), np.empty((nodes, AT_ONCE), np.int64)
    pulls_x, pulls_y = np.empty((nodes, AT_ONCE), number), np.empty((nodes, AT_ONCE), number)
    for first in range(begin, end, AT_ONCE):
        count = min(AT_ONCE, end - first)
        for k in range(count):
            out[first + k] = 0.0
        for spot in range(seen.y.shape[1]):
            by_x, by_y = seen.basis[2 * spot], seen.basis[2 * spot + 1]
            paths_of(seen.inputs[row, 2 * spot], by_x, t, first, count, path)
            places_of(path, count, low, per_unit, side, across.shape[1], wide, lefts, of_columns, dx)
            paths_of(seen.inputs[row, 2 * spot + 1], by_y, t, first, count, path)
            places_of(path, count, low, per_unit, side, down.shape[1], high, tops, of_rows, dy)
            light, usable = seen.y[row, spot], seen.usable[row, spot]
            _squares(light.ravel(), usable.ravel(), f.ravel(), f.shape[1], side, 0, 0, 0, 0, dark)
            for k in range(count):
                top, bottom, left, right = _add_light(
                    k, lefts, of_columns, dx, tops, of_rows, dy, weights, terms, across, down, columns, rows, f
                )
                out[first + k] += _scores(
                    light, usable, f, high, wide, top, bottom, left, right, dark, read_noise, gain
                )
                _put_pulls(
                    k, lefts, of_columns, dx, tops, of_rows, dy, weights, terms, across, down, columns, rows,
                    column_slopes, row_slopes, f, per_unit, pull, pulls_x, pulls_y,
                )  # fmt: skip
                for r in range(top, bottom):
                    for c in range(left, right):
                        f[r, c] = 0.0
            add_gradients(by_x, pulls_x, first, count, gradients)
            add_gradients(by_y, pulls_y, first, count, gradients)


@compiled_sums
def _scores(
    y: FloatArray, usable: BoolArray, f: FloatArray, down: int, across: int, top: int, bottom: int, left: int,
    right: int, dark: FloatArray, read_noise: float, gain: float,
) -> float:  # fmt: skip
    """Log-likelihood of the usable pixels of y (side, side) with padded expected densities f.

    Only the padded rows ``top`` to ``bottom`` and columns ``left`` to ``right`` have light; there the log-likelihood's
    derivatives take the place of the densities, and zeros that of the padding. ``dark`` is as in `_squares`.
    """
    side, number = len(y), f.dtype.type
    nothing, noise, growth, half, one = number(0.0), number(read_noise), number(gain), number(0.5), number(1.0)
    quiet = one / noise
    squares, logs = 0.0, 0.0
    for r in range(side):
        squares += dark[r]
    first, end = max(left - across, 0), min(right - across, side)
    for padded in range(top, bottom):
        r = padded - down
        if r < 0 or r >= side:
            for c in range(left, right):
                f[padded, c] = nothing
            continue
        for c in range(left, across):
            f[padded, c] = nothing
        for c in range(across + side, right):
            f[padded, c] = nothing
        more, base = nothing, np.uintp(across)
        if not gain:
            for c in range(first, end):
                light = f[padded, base + np.uintp(c)]
                e = y[r, np.uintp(c)] - light
                seen = one if usable[r, np.uintp(c)] else nothing
                more -= seen * light * (e + y[r, np.uintp(c)])  # e^2 - y^2
                f[padded, base + np.uintp(c)] = seen * e * quiet
            squares += more
            continue
        product = 1.0
        for c in range(first, end):
            score = nothing
            if usable[r, c]:
                light = f[padded, across + c]
                R, e = noise + growth * max(light, nothing), y[r, c] - light
                score = e / R
                squares += read_noise * (e * score) - y[r, c] * y[r, c]
                if light > nothing:
                    product *= R * quiet
                    if product > LARGE:
                        logs += math.log(product)
                        product = 1.0
                    score += half * growth * (e * score - one) / R
            f[padded, across + c] = score
        logs += math.log(product)
    return -0.5 * (squares / read_noise + logs)


@compiled
def _put_pulls(
    point: int, lefts: IntArray, of_columns: IntArray, dx: FloatArray, tops: IntArray, of_rows: IntArray,
    dy: FloatArray, weights: FloatArray, terms: FloatArray, across: FloatArray, down: FloatArray, columns: FloatArray,
    rows: FloatArray, column_slopes: FloatArray, row_slopes: FloatArray, scores: FloatArray, per_unit: float,
    pull: FloatArray, pulls_x: FloatArray, pulls_y: FloatArray,
) -> None:  # fmt: skip
    """Derivatives of the log-likelihood by the path at the nodes, (nodes, points), of the point of `_add_light`, from
    those by the densities: its adjoint. ``pull`` is room for (2,)."""
    for k in range(len(weights)):
        left, top = lefts[k, point], tops[k, point]
        pull[0] = pull[1] = 0.0
        if left >= 0 and top >= 0:
            for j in range(len(terms)):
                weight = terms[j] * weights[k] * per_unit
                _taylor(down, j, of_rows[k, point], dy[k, point], 1.0, rows)
                _taylor_slope(down, j, of_rows[k, point], dy[k, point], 1.0, row_slopes)
                _taylor(across, j, of_columns[k, point], dx[k, point], weight, columns)
                _taylor_slope(across, j, of_columns[k, point], dx[k, point], weight, column_slopes)
                _add_slopes(scores, top, left, rows, row_slopes, columns, column_slopes, pull)
        pulls_x[k, point], pulls_y[k, point] = pull[0], pull[1]


@compiled_sums
def _add_slopes(
    scores: FloatArray, top: int, left: int, rows: FloatArray, row_slopes: FloatArray, columns: FloatArray,
    column_slopes: FloatArray, pull: FloatArray,
) -> None:  # fmt: skip
    """Add the sums of scores times the slopes of `_add_product` by x and by y, (2,)."""
    for k in range(len(rows)):
        r = np.uintp(top) + np.uintp(k)
        by_x = by_y = scores.dtype.type(0.0)
        for m in range(len(columns)):
            score = scores[r, np.uintp(left) + np.uintp(m)]
            by_x += score * column_slopes[m]
            by_y += score * columns[m]
        pull[0] += rows[k] * by_x
        pull[1] += row_slopes[k] * by_y


@compiled
def information_of_spots(
    seen: Plane, row: int, path: FloatArray, basis: FloatArray, H: FloatArray, pull: FloatArray
) -> tuple[float, float]:
    """`fisher_information` of the spots of one row about their path (outputs, nodes), by coefficients of a basis
    (outputs, n, nodes)."""
    n, side, across, down = len(pull), seen.y.shape[2], seen.across.shape[3], seen.down.shape[3]
    f, J = np.empty((side + 2 * down, side + 2 * across)), np.empty((n, side + 2 * down, side + 2 * across))
    light, slopes, scores = np.empty(side * side), np.empty((n, side * side)), np.empty((3, side * side))
    log_likelihood = square = 0.0
    for spot in range(seen.y.shape[1]):
        _linearised_spot(seen, spot, path, basis, f, J)
        for r in range(side):
            for c in range(side):
                light[r * side + c] = f[down + r, across + c]
                for i in range(n):
                    slopes[i, r * side + c] = J[i, down + r, across + c]
        own, squares = fisher_information(
            seen.y[row, spot].ravel(), seen.usable[row, spot].ravel(), light, slopes, 0, seen.read_noise, seen.gain,
            scores, H, pull,
        )  # fmt: skip
        log_likelihood += own
        square += squares
    return log_likelihood, square


@inlined
def _linearised_spot(seen: Plane, spot: int, path: FloatArray, basis: FloatArray, f: FloatArray, J: FloatArray) -> None:
    """Padded densities f of one spot, and their Jacobian J, (n, ...), by coefficients of a basis (outputs, n,
    nodes)."""
    side, points_across, points_down = seen.y.shape[2], seen.across.shape[1], seen.down.shape[1]
    across, down = seen.across.shape[3], seen.down.shape[3]
    columns, more_columns, rows, more_rows = np.empty(across), np.empty(across), np.empty(down), np.empty(down)
    f[:] = 0.0
    J[:] = 0.0
    for node in range(path.shape[1]):
        left, column, dx = place(path[2 * spot, node], seen.low, seen.per_unit, side, points_across, across)
        top, line, dy = place(path[2 * spot + 1, node], seen.low, seen.per_unit, side, points_down, down)
        if left < 0 or top < 0:
            continue
        for j in range(len(seen.terms)):
            weight = seen.terms[j] * seen.weights[node]
            _taylor(seen.across, j, column, dx, weight, columns)
            _taylor(seen.down, j, line, dy, 1.0, rows)
            _taylor_slope(seen.across, j, column, dx, weight * seen.per_unit, more_columns)
            _taylor_slope(seen.down, j, line, dy, seen.per_unit, more_rows)
            _add_product(f, top, left, rows, columns)
            for i in range(len(J)):
                along, aside = basis[2 * spot, i, node], basis[2 * spot + 1, i, node]
                for k in range(down):
                    a, b, r = along * rows[k], aside * more_rows[k], np.uintp(top) + np.uintp(k)
                    for m in range(across):
                        J[i, r, np.uintp(left) + np.uintp(m)] += a * more_columns[m] + b * columns[m]


@compiled
def _add_light(
    point: int, lefts: IntArray, of_columns: IntArray, dx: FloatArray, tops: IntArray, of_rows: IntArray,
    dy: FloatArray, weights: FloatArray, terms: FloatArray, across: FloatArray, down: FloatArray, columns: FloatArray,
    rows: FloatArray, f: FloatArray,
) -> tuple[int, int, int, int]:  # fmt: skip
    """Densities without noise of one of the paths that `places_of` has placed, added to padded densities f.

    The results are the first row and the one after the last that get light, and the same for columns.
    """
    wide, high = across.shape[3], down.shape[3]
    begin, end, first, last = len(f), 0, f.shape[1], 0
    for j in range(len(terms)):
        for k in range(len(weights)):
            left, top = lefts[k, point], tops[k, point]
            if left < 0 or top < 0:
                continue
            begin, end, first, last = min(begin, top), max(end, top + high), min(first, left), max(last, left + wide)
            _taylor(across, j, of_columns[k, point], dx[k, point], terms[j] * weights[k], columns)
            _taylor(down, j, of_rows[k, point], dy[k, point], 1.0, rows)
            _add_product(f, top, left, rows, columns)
    return begin, end, first, last


@inlined
def _add_product(f: FloatArray, top: int, left: int, rows: FloatArray, columns: FloatArray) -> None:
    for k in range(len(rows)):
        r, light = np.uintp(top) + np.uintp(k), rows[k]
        for m in range(len(columns)):
            f[r, np.uintp(left) + np.uintp(m)] += light * columns[m]


@compiled
def _taylor(table: FloatArray, term: int, point: int, d: float, factor: float, out: FloatArray) -> None:
    weight = out.dtype.type(factor)
    for p in range(len(out)):
        slope = table[term, point, 1, p] + d * (table[term, point, 2, p] + d * table[term, point, 3, p])
        out[p] = weight * (table[term, point, 0, p] + d * slope)


@compiled
def _taylor_slope(table: FloatArray, term: int, point: int, d: float, factor: float, out: FloatArray) -> None:
    number = out.dtype.type
    weight, two, three = number(factor), number(2.0), number(3.0)
    for p in range(len(out)):
        steeper = two * table[term, point, 2, p] + three * d * table[term, point, 3, p]
        out[p] = weight * (table[term, point, 1, p] + d * steeper)


@compiled_sums
def _squares(
    y: FloatArray, usable: BoolArray, f: FloatArray, width: int, side: int, down: int, across: int, begin: int,
    end: int, dark: FloatArray,
) -> float:  # fmt: skip
    """Sum of squared deviations of the usable pixels of y (side * side,) from padded expected densities f, flat, with
    ``width`` columns.

    Only the padded rows ``begin`` to ``end`` have light. ``dark`` (side,) has the sum of each row without light: where
    no row has any (``begin`` >= ``end``) it is filled, otherwise it is read.
    """
    total, nothing = 0.0, f.dtype.type(0.0)
    for r in range(side):
        if begin < end and not begin <= down + r < end:
            total += dark[r]
            continue
        of_row, pixel, first = nothing, np.uintp(r * side), np.uintp((down + r) * width + across)
        for c in range(side):
            e = y[pixel + np.uintp(c)] - f[first + np.uintp(c)]
            of_row += e * e if usable[pixel + np.uintp(c)] else nothing
        total += of_row
        if begin >= end:
            dark[r] = of_row
    return total
