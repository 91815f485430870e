"""Responses of plants of few states to their inputs: the plant stepped through the exposure, several axes abreast.

NumPy would run through memory for each of the means; here some axes at a time stay in the processor's cache until their
exposure ends. Plants of two states have a form of their own, in which they stay in its registers for some steps: a
third of the time (row `frame_moments_and_o3` of tools/bench). The twin is `aolink.plant.lifting.input_response`.
"""

from __future__ import annotations

import math

import numpy as np

from aolink.estimation.compiled.small import compiled, inlined
from aolink.numerics.arrays import FloatArray

# Axes abreast, of few and of many. There are always so many, some of them empty: the last ones are computed as all are.
_FEW, _MANY = 16, 64
# Steps that a plant of two states takes between a load and a store of its state.
_STEPS = 4


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
        (exposures, n_steps, axes * n_inputs). What is not a number is taken as zero.
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
            for j in range(n_u):
                for a in range(abreast):
                    u[j, a] = u[j, a] if abs(u[j, a]) < math.inf else 0.0
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
def _on(
    a: float, b: float, c: float, d: float, e: float, f: float, u: float, x: float, v: float
) -> tuple[float, float]:
    """The next state: A = [[a, b], [c, d]], B = [[e], [f]]."""
    return a * x + e * u + b * v, c * x + f * u + d * v


@compiled
def responses_of_two_states(
    A: FloatArray, B: FloatArray, C: FloatArray, rows: FloatArray, inputs: FloatArray,
    end: FloatArray, mean: FloatArray, slope: FloatArray, square: FloatArray,
) -> None:  # fmt: skip
    """`responses` of a plant with two states, one input and one output, to the same bits, without the path."""
    a, b, c, d, e, f, g, h = A[0, 0], A[0, 1], A[1, 0], A[1, 1], B[0, 0], B[1, 0], C[0, 0], C[0, 1]
    n_steps, axes = inputs.shape[1], inputs.shape[2]
    batch = len(inputs) * axes
    abreast = _FEW if batch <= _FEW else _MANY
    p, q, total, squares = np.empty(abreast), np.empty(abreast), np.empty(abreast), np.empty(abreast)
    first, second, u = np.empty(abreast), np.empty(abreast), np.zeros((_STEPS, abreast))
    for begin in range(0, batch, abreast):
        count = min(abreast, batch - begin)
        u[:] = 0.0
        for values in (p, q, total, squares, first, second):
            values[:] = 0.0
        for i in range(0, n_steps, _STEPS):
            steps = min(_STEPS, n_steps - i)
            exposure, column = divmod(begin, axes)
            done = 0
            while done < count:  # the axes of one exposure after the other
                some = min(axes - column, count - done)
                for step in range(steps):
                    given, taken = inputs[exposure, i + step, column : column + some], u[step, done : done + some]
                    for k in range(some):
                        taken[k] = given[k] if abs(given[k]) < math.inf else 0.0
                done, exposure, column = done + some, exposure + 1, 0
            if steps == _STEPS:
                r0, r1, r2, r3 = rows[0, i, 0], rows[0, i + 1, 0], rows[0, i + 2, 0], rows[0, i + 3, 0]
                s0, s1, s2, s3 = rows[0, i, 1], rows[0, i + 1, 1], rows[0, i + 2, 1], rows[0, i + 3, 1]
                for k in range(abreast):
                    x, v = p[k], q[k]
                    y0 = g * x + h * v
                    x, v = _on(a, b, c, d, e, f, u[0, k], x, v)
                    y1 = g * x + h * v
                    x, v = _on(a, b, c, d, e, f, u[1, k], x, v)
                    y2 = g * x + h * v
                    x, v = _on(a, b, c, d, e, f, u[2, k], x, v)
                    y3 = g * x + h * v
                    p[k], q[k] = _on(a, b, c, d, e, f, u[3, k], x, v)
                    total[k] = total[k] + y0 + y1 + y2 + y3
                    squares[k] = squares[k] + y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3
                    first[k] = first[k] + r0 * y0 + r1 * y1 + r2 * y2 + r3 * y3
                    second[k] = second[k] + s0 * y0 + s1 * y1 + s2 * y2 + s3 * y3
            else:
                for step in range(steps):
                    r, s = rows[0, i + step, 0], rows[0, i + step, 1]
                    for k in range(abreast):
                        y = g * p[k] + h * q[k]
                        total[k] += y
                        squares[k] += y * y
                        first[k] += r * y
                        second[k] += s * y
                        p[k], q[k] = _on(a, b, c, d, e, f, u[step, k], p[k], q[k])
        share = 1.0 / n_steps
        for k in range(count):
            end[0, begin + k], end[1, begin + k] = p[k], q[k]
            mean[0, begin + k], square[0, begin + k] = total[k] * share, squares[k] * share
            slope[0, 0, begin + k], slope[0, 1, begin + k] = first[k] * share, second[k] * share
