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
    log_likelihood_of,
    paths_of,
    place,
    places_of,
)
from aolink.estimation.compiled.small import compiled, compiled_sums, inlined
from aolink.estimation.compiled.vectors import add_outer, add_slopes, lanes_of, put_cubic, put_cubic_slope
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
    """Taylor coefficients of the densities of columns of pixels about points of a pixel, (terms, points, 4, reach); the
    reach is a multiple of `vectors.lanes_of`."""
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
    wide, high, width, lanes = across.shape[3], down.shape[3], scores.shape[1], lanes_of(scores)
    for k in range(len(weights)):
        left, top = lefts[k, point], tops[k, point]
        pull[0] = pull[1] = 0.0
        if left >= 0 and top >= 0:
            at, x, y = top * width + left, dx[k, point], dy[k, point]
            for j in range(len(terms)):
                column = 4 * (j * across.shape[1] + of_columns[k, point]) * wide
                row = 4 * (j * down.shape[1] + of_rows[k, point]) * high
                weight = terms[j] * weights[k] * per_unit
                for p in range(0, high, lanes):
                    put_cubic(rows, p, 1.0, y, down, row + p, high)
                    put_cubic_slope(row_slopes, p, 1.0, y, down, row + p, high)
                for p in range(0, wide, lanes):
                    put_cubic(columns, p, weight, x, across, column + p, wide)
                    put_cubic_slope(column_slopes, p, weight, x, across, column + p, wide)
                    add_slopes(pull, scores, at + p, width, rows, row_slopes, high, columns, column_slopes, p)
        pulls_x[k, point], pulls_y[k, point] = pull[0], pull[1]


@compiled
def linearised_light_of_spots(seen: Plane, t: FloatArray, light: FloatArray, slopes: FloatArray) -> None:
    """Densities (rows, points, spots, side, side) of points t (rows, points, n); their derivatives by t, (..., n)."""
    n, side, across, down = t.shape[2], seen.y.shape[2], seen.across.shape[3], seen.down.shape[3]
    path = np.empty((2, len(seen.weights)))
    f = np.empty((side + 2 * down, side + 2 * across))
    J = np.empty((n, side + 2 * down, side + 2 * across))
    columns, more_columns, rows, more_rows = np.empty(across), np.empty(across), np.empty(down), np.empty(down)
    for row in range(t.shape[0]):
        for k in range(t.shape[1]):
            for spot in range(seen.y.shape[1]):
                _path_of(seen, row, spot, t[row, k], path)
                f[:] = 0.0
                J[:] = 0.0
                for node in range(len(seen.weights)):
                    left, column, dx = place(path[0, node], seen.low, seen.per_unit, side, seen.across.shape[1], across)
                    top, line, dy = place(path[1, node], seen.low, seen.per_unit, side, seen.down.shape[1], down)
                    if left < 0 or top < 0:
                        continue
                    for j in range(len(seen.terms)):
                        weight = seen.terms[j] * seen.weights[node]
                        _taylor(seen.across[j, column], dx, weight, columns)
                        _taylor(seen.down[j, line], dy, 1.0, rows)
                        _taylor_slope(seen.across[j, column], dx, weight * seen.per_unit, more_columns)
                        _taylor_slope(seen.down[j, line], dy, seen.per_unit, more_rows)
                        _add_product(f, top, left, rows, columns)
                        for i in range(n):
                            along, aside = seen.basis[2 * spot, i, node], seen.basis[2 * spot + 1, i, node]
                            for r in range(down):
                                lit, a, b = J[i, top + r, left : left + across], along * rows[r], aside * more_rows[r]
                                for c in range(across):
                                    lit[c] += a * more_columns[c] + b * columns[c]
                for r in range(side):
                    for c in range(side):
                        light[row, k, spot, r, c] = f[down + r, across + c]
                        for i in range(n):
                            slopes[row, k, spot, r, c, i] = J[i, down + r, across + c]


@inlined
def _path_of(seen: Plane, row: int, spot: int, t: FloatArray, path: FloatArray) -> None:
    """The path of one spot at the nodes, (2, nodes), of coefficients t (n,)."""
    for d in range(2):
        output = 2 * spot + d
        path[d] = seen.inputs[row, output]
        for i in range(len(t)):
            value = t[i]
            for node in range(path.shape[1]):
                path[d, node] += value * seen.basis[output, i, node]


@compiled
def _add_light(
    point: int, lefts: IntArray, of_columns: IntArray, dx: FloatArray, tops: IntArray, of_rows: IntArray,
    dy: FloatArray, weights: FloatArray, terms: FloatArray, across: FloatArray, down: FloatArray, columns: FloatArray,
    rows: FloatArray, f: FloatArray,
) -> tuple[int, int, int, int]:  # fmt: skip
    """Densities without noise of one of the paths that `places_of` has placed, added to padded densities f.

    The results are the first row and the one after the last that get light, and the same for columns.
    """
    wide, high, width, lanes = across.shape[3], down.shape[3], f.shape[1], lanes_of(f)
    begin, end, first, last = len(f), 0, width, 0
    for j in range(len(terms)):
        for k in range(len(weights)):
            left, top = lefts[k, point], tops[k, point]
            if left < 0 or top < 0:
                continue
            begin, end, first, last = min(begin, top), max(end, top + high), min(first, left), max(last, left + wide)
            column = 4 * (j * across.shape[1] + of_columns[k, point]) * wide
            row = 4 * (j * down.shape[1] + of_rows[k, point]) * high
            for p in range(0, wide, lanes):
                put_cubic(columns, p, terms[j] * weights[k], dx[k, point], across, column + p, wide)
            for p in range(0, high, lanes):
                put_cubic(rows, p, 1.0, dy[k, point], down, row + p, high)
            at = top * width + left
            for p in range(0, wide, lanes):
                add_outer(f, at + p, width, rows, high, columns, p)
    return begin, end, first, last


@inlined
def _add_product(f: FloatArray, top: int, left: int, rows: FloatArray, columns: FloatArray) -> None:
    for r in range(len(rows)):
        # A slice of one row, so that the compiler knows that its pixels are side by side: four times as fast.
        lit, light = f[top + r, left : left + len(columns)], rows[r]
        for c in range(len(columns)):
            lit[c] += light * columns[c]


@compiled
def _taylor(series: FloatArray, d: float, factor: float, out: FloatArray) -> None:
    for p in range(len(out)):
        out[p] = factor * (series[0, p] + d * (series[1, p] + d * (series[2, p] + d * series[3, p])))


@compiled
def _taylor_slope(series: FloatArray, d: float, factor: float, out: FloatArray) -> None:
    for p in range(len(out)):
        out[p] = factor * (series[1, p] + d * (2.0 * series[2, p] + 3.0 * d * series[3, p]))


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
