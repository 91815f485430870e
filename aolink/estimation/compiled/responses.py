"""Responses of plants of few states to their inputs: the plant stepped through the exposure, several axes abreast.

NumPy would run through memory for each of the means; here some axes at a time stay in the processor's cache until their
exposure ends. Plants of two states have a form of their own, in which all axes take four steps between a load and a
store: a third of the time (row `frame_moments_and_o3` of tools/bench). The twin is
`aolink.plant.lifting.input_response`.
"""

from __future__ import annotations

import numpy as np

from aolink.estimation.compiled.small import compiled, inlined
from aolink.numerics.arrays import FloatArray

# Axes abreast, of few and of many. There are always so many, some of them empty: the last ones are computed as all are.
_FEW, _MANY = 16, 64


@compiled
def responses(
    A: FloatArray, B: FloatArray, C: FloatArray, rows: FloatArray, inputs: FloatArray,
    end: FloatArray, mean: FloatArray, slope: FloatArray, square: FloatArray, path: FloatArray,
) -> None:  # fmt: skip
    """End state, and means over the exposure, of the response from rest.

    Parameters
    ----------
    A, B, C:
        The plant's, (n, n), (n, n_inputs), (n_outputs, n).
    rows:
        C A^i, (n_outputs, n_steps, n).
    inputs:
        (exposures, n_steps, axes * n_inputs).
    end, mean, slope, square:
        Filled with d (n, exposures * axes), and with the means of c (n_outputs, .), of C A^i times c_i
        (n_outputs, n, .) and of c squared (n_outputs, .).
    path:
        Filled with c, (exposures * axes, n_outputs, n_steps), unless it has no axes.
    """
    n, n_u, n_y = len(A), B.shape[1], len(C)
    n_steps, axes = inputs.shape[1], inputs.shape[2] // n_u
    batch = len(inputs) * axes
    abreast = _FEW if batch <= _FEW else _MANY
    state, ahead, u = np.empty((n, abreast)), np.empty((n, abreast)), np.zeros((n_u, abreast))
    c, sums, squares = np.empty(abreast), np.empty((n_y, abreast)), np.empty((n_y, abreast))
    weighted = np.empty((n_y, n, abreast))
    exposure, column = np.zeros(abreast, dtype=np.intp), np.zeros(abreast, dtype=np.intp)
    for first in range(0, batch, abreast):
        count = min(abreast, batch - first)
        for a in range(count):
            exposure[a], column[a] = divmod(first + a, axes)
        together = n_u == 1 and exposure[0] == exposure[abreast - 1] and count == abreast
        u[:] = 0.0
        state[:] = 0.0
        sums[:] = 0.0
        squares[:] = 0.0
        weighted[:] = 0.0
        for i in range(n_steps):
            if together:
                for a in range(abreast):
                    u[0, a] = inputs[exposure[0], i, column[0] + a]
            else:
                for j in range(n_u):
                    for a in range(count):
                        u[j, a] = inputs[exposure[a], i, column[a] * n_u + j]
            for o in range(n_y):
                for a in range(abreast):
                    c[a] = C[o, 0] * state[0, a]
                for j in range(1, n):
                    for a in range(abreast):
                        c[a] += C[o, j] * state[j, a]
                for a in range(abreast):
                    sums[o, a] += c[a]
                    squares[o, a] += c[a] * c[a]
                for j in range(n):
                    for a in range(abreast):
                        weighted[o, j, a] += rows[o, i, j] * c[a]
                if len(path):
                    for a in range(count):
                        path[first + a, o, i] = c[a]
            for j in range(n):
                for a in range(abreast):
                    ahead[j, a] = B[j, 0] * u[0, a] + A[j, 0] * state[0, a]
                for k in range(1, n_u):
                    for a in range(abreast):
                        ahead[j, a] += B[j, k] * u[k, a]
                for k in range(1, n):
                    for a in range(abreast):
                        ahead[j, a] += A[j, k] * state[k, a]
            state, ahead = ahead, state
        share = 1.0 / n_steps
        for a in range(count):
            for j in range(n):
                end[j, first + a] = state[j, a]
            for o in range(n_y):
                mean[o, first + a] = sums[o, a] * share
                square[o, first + a] = squares[o, a] * share
                for j in range(n):
                    slope[o, j, first + a] = weighted[o, j, a] * share


@inlined
def _four_steps(
    A: FloatArray, B: FloatArray, C: FloatArray, rows: FloatArray,
    u0: FloatArray, u1: FloatArray, u2: FloatArray, u3: FloatArray, x: FloatArray, v: FloatArray,
    total: FloatArray, squares: FloatArray, first: FloatArray, second: FloatArray,
) -> None:  # fmt: skip
    """Four steps of all axes, between which nothing is stored."""
    a, b, c, d, e, f, g, h = A[0, 0], A[0, 1], A[1, 0], A[1, 1], B[0, 0], B[1, 0], C[0, 0], C[0, 1]
    r0, r1, r2, r3 = rows[0, 0], rows[1, 0], rows[2, 0], rows[3, 0]
    s0, s1, s2, s3 = rows[0, 1], rows[1, 1], rows[2, 1], rows[3, 1]
    for k in range(len(x)):
        p, q = x[k], v[k]
        y0 = g * p + h * q
        p, q = e * u0[k] + a * p + b * q, f * u0[k] + c * p + d * q
        y1 = g * p + h * q
        p, q = e * u1[k] + a * p + b * q, f * u1[k] + c * p + d * q
        y2 = g * p + h * q
        p, q = e * u2[k] + a * p + b * q, f * u2[k] + c * p + d * q
        y3 = g * p + h * q
        x[k], v[k] = e * u3[k] + a * p + b * q, f * u3[k] + c * p + d * q
        total[k] = total[k] + y0 + y1 + y2 + y3
        squares[k] = squares[k] + y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3
        first[k] = first[k] + r0 * y0 + r1 * y1 + r2 * y2 + r3 * y3
        second[k] = second[k] + s0 * y0 + s1 * y1 + s2 * y2 + s3 * y3


@inlined
def _step(
    A: FloatArray, B: FloatArray, C: FloatArray, row: FloatArray, u: FloatArray, x: FloatArray, v: FloatArray,
    total: FloatArray, squares: FloatArray, first: FloatArray, second: FloatArray,
) -> None:  # fmt: skip
    for k in range(len(x)):
        p, q = x[k], v[k]
        y = C[0, 0] * p + C[0, 1] * q
        x[k], v[k] = B[0, 0] * u[k] + A[0, 0] * p + A[0, 1] * q, B[1, 0] * u[k] + A[1, 0] * p + A[1, 1] * q
        total[k] += y
        squares[k] += y * y
        first[k] += row[0] * y
        second[k] += row[1] * y


@compiled
def responses_of_two_states(
    A: FloatArray, B: FloatArray, C: FloatArray, rows: FloatArray, inputs: FloatArray,
    end: FloatArray, mean: FloatArray, slope: FloatArray, square: FloatArray,
) -> None:  # fmt: skip
    """`responses` of a plant with two states, one input and one output, without the path."""
    n_steps, axes = inputs.shape[1], inputs.shape[2]
    for e in range(len(inputs)):
        some = slice(e * axes, (e + 1) * axes)
        x, v, total, squares = end[0, some], end[1, some], mean[0, some], square[0, some]
        first, second = slope[0, 0, some], slope[0, 1, some]
        for values in (x, v, total, squares, first, second):
            values[:] = 0.0
        for i in range(0, n_steps - 3, 4):
            _four_steps(
                A, B, C, rows[0, i : i + 4], inputs[e, i], inputs[e, i + 1], inputs[e, i + 2], inputs[e, i + 3],
                x, v, total, squares, first, second,
            )  # fmt: skip
        for i in range(n_steps - n_steps % 4, n_steps):
            _step(A, B, C, rows[0, i], inputs[e, i], x, v, total, squares, first, second)
        for k in range(axes):  # an array divided at once would compile NumPy's error messages, for four seconds
            total[k] /= n_steps
            squares[k] /= n_steps
            first[k] /= n_steps
            second[k] /= n_steps
