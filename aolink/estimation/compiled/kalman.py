"""The paper's filters o1, o2 and o3, for a plant of few states and one or two outputs: a series of exposures, axis by
axis, in one compiled loop.

An exposure by itself is a series of one, so estimates online and offline are the same bits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled.small import compiled, inlined, times
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray


class Step(NamedTuple):
    """How an exposure is predicted, and how its measurement is used; n states, m measurements of an axis."""

    transition: FloatArray
    """A of an exposure, (n, n)."""
    noise: FloatArray
    """What an exposure adds to the covariance, (n, n)."""
    mean_row: FloatArray
    """C-bar, (outputs, n)."""
    quadratic: FloatArray
    """M, (outputs, n, n)."""
    first: bool
    """Whether the first moment of each output is measured."""
    second: bool
    """And the second."""
    second_order: bool
    """Whether the terms that the linearisation of the second moment leaves out are taken."""
    gains: FloatArray
    """Constant gains, one for all axes or one each, (1 or axes, n, m); (0, n, m) for the optimal ones."""
    gate: float
    """The largest NIS of a measurement that is used."""
    patience: int
    """After so many measurements in a row that were not used, an axis starts again."""
    most_wider: float
    """NIS, over its expectation, of an axis's first measurement up to which that widens the prior."""


class Series(NamedTuple):
    """What differs from exposure to exposure: the axes of the first one, then of the second, in rows."""

    mean: FloatArray
    """Responses to the inputs as in `InputResponse`, (rows, outputs)."""
    slope: FloatArray
    """(rows, outputs, n)"""
    square: FloatArray
    """(rows, outputs)"""
    end: FloatArray
    """(rows, n)"""
    value: FloatArray
    """Measurements, (rows, m)."""
    noise: FloatArray
    """Their covariance, (rows, m, m)."""
    usable: BoolArray
    """Whether there is a measurement, (rows,)."""


class Carried(NamedTuple):
    """What a filter knows before an exposure of each axis, and after it."""

    mean: FloatArray
    """(axes, n)"""
    covariance: FloatArray
    """(axes, n, n)"""
    model_only_mean: FloatArray
    """The prediction without any measurement, (axes, n)."""
    model_only_covariance: FloatArray
    """One for all axes, (n, n)."""
    missed: IntArray
    """Measurements in a row that were not used, (axes,)."""
    begun: BoolArray
    """Whether a measurement was used, (axes,)."""


class Filtered(NamedTuple):
    """The results, in rows as in `Series`."""

    mean: FloatArray
    """State at the start of the exposure, (rows, n)."""
    covariance: FloatArray
    """(rows, n, n)"""
    end_mean: FloatArray
    """(rows, n)"""
    end_covariance: FloatArray
    """(rows, n, n)"""
    innovation: FloatArray
    """(rows, m)"""
    innovation_covariance: FloatArray
    """(rows, m, m)"""
    nis: FloatArray
    """(rows,)"""
    used: BoolArray
    """Whether the measurement was used, (rows,)."""
    again: BoolArray
    """Whether the axis started again from the prediction without any measurement, (rows,)."""
    missed: IntArray
    """Measurements in a row that were not used, up to this one, (rows,)."""


@compiled
def filter_series(step: Step, series: Series, carried: Carried, out: Filtered) -> None:
    """Kalman's update with the moments of each exposure, the gate, and the prediction to the next exposure: Mishra &
    Wen (16) to (20), with the moments of `path_moments.predicted_moments`. ``carried`` and ``out`` are filled."""
    # Fields by themselves: those of a tuple have their references counted at each use.
    A, Q, gains, gate, patience = step.transition, step.noise, step.gains, step.gate, step.patience
    C_bar, M, first, second, second_order = step.mean_row, step.quadratic, step.first, step.second, step.second_order
    means, slopes, squares, kicks, values, noises, usable = series
    x, P, model_only, model_only_P, missed, begun = carried
    start, start_P, end, end_P, innovation, spread, nis, used, again, missed_by_then = out
    (axes, n), m = x.shape, values.shape[1]
    s, after, y, white = np.empty(n), np.empty(n), np.empty(m), np.empty(m)
    V, updated, keep, product = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    H, K, KR = np.empty((m, n)), np.empty((n, m)), np.empty((n, m))
    R, S, root, MP = np.empty((m, m)), np.empty((m, m)), np.empty((m, m)), np.empty((len(C_bar), n, n))
    for row in range(len(values)):
        axis = row % axes
        restarts = missed[axis] >= patience
        for i in range(n):
            s[i] = model_only[axis, i] if restarts else x[axis, i]
            for j in range(n):
                V[i, j] = model_only_P[i, j] if restarts else P[axis, i, j]
        passes, square = False, 0.0
        for i in range(m):
            y[i] = 0.0
            for j in range(m):
                S[i, j] = 0.0
        for widened in range(2 if usable[row] else 0):
            square = 0.0
            for i in range(m):
                for j in range(m):
                    R[i, j] = noises[row, i, j]
            _innovation(C_bar, M, first, second, means, slopes, squares, values, row, s, y, H)
            if second_order:
                _second_order(M, first, V, MP, y, R)
            _optimal_gain(V, y, H, R, S, root, white, K)
            for i in range(m):
                square += white[i] * white[i]
            if widened or begun[axis] or not gate < square < step.most_wider * m:
                break
            for i in range(n):  # the plant moved before the first exposure
                for j in range(n):
                    V[i, j] *= square / m
        if usable[row]:
            if len(gains) and not widened:
                for i in range(n):
                    for j in range(m):
                        K[i, j] = gains[axis % len(gains), i, j]
            passes = square <= gate and math.isfinite(_joseph(s, V, y, H, R, K, KR, keep, product, after, updated))
            begun[axis] = begun[axis] or passes
            missed[axis] = 0 if passes else 1 if restarts else missed[axis] + 1
        nis[row], used[row], again[row], missed_by_then[row] = square, passes, restarts, missed[axis]
        for i in range(m):
            innovation[row, i] = y[i]
            for j in range(m):
                spread[row, i, j] = S[i, j]
        if passes:
            for i in range(n):
                s[i] = after[i]
                for j in range(n):
                    V[i, j] = updated[i, j]
        _congruence(A, V, product, Q, updated)
        for i in range(n):
            start[row, i], end[row, i] = s[i], kicks[row, i]
            for j in range(n):
                end[row, i] += A[i, j] * s[j]
                start_P[row, i, j], end_P[row, i, j], P[axis, i, j] = V[i, j], updated[i, j], updated[i, j]
        for i in range(n):
            x[axis, i], s[i] = end[row, i], model_only[axis, i]
        for i in range(n):
            model_only[axis, i] = kicks[row, i]
            for j in range(n):
                model_only[axis, i] += A[i, j] * s[j]
        if axis == axes - 1:
            _congruence(A, model_only_P, product, Q, model_only_P)


@inlined
def _innovation(
    C_bar: FloatArray, M: FloatArray, first: bool, second: bool, means: FloatArray, slopes: FloatArray,
    squares: FloatArray, values: FloatArray, row: int, x: FloatArray, y: FloatArray, H: FloatArray,
) -> None:  # fmt: skip
    """y - h(x), and H, the Jacobian of h."""
    n, k = len(x), 0
    for o in range(len(C_bar)):
        if first:
            expected = means[row, o]
            for i in range(n):
                H[k, i] = C_bar[o, i]
                expected += C_bar[o, i] * x[i]
            y[k] = values[row, k] - expected
            k += 1
        if second:
            expected = squares[row, o]
            for i in range(n):
                half = slopes[row, o, i]
                for j in range(n):
                    half += M[o, i, j] * x[j]
                H[k, i] = 2.0 * half
                expected += (half + slopes[row, o, i]) * x[i]
            y[k] = values[row, k] - expected
            k += 1


@compiled
def _second_order(M: FloatArray, first: bool, P: FloatArray, MP: FloatArray, y: FloatArray, R: FloatArray) -> None:
    """The mean tr(M P) that h(x) leaves out of a second moment, and the covariance 2 tr(M P M' P) of two of them."""
    outputs, n, orders = len(M), len(P), 2 if first else 1
    for o in range(outputs):
        times(M[o], P, MP[o])
        for i in range(n):
            y[orders * (o + 1) - 1] -= MP[o, i, i]
    for o in range(outputs):
        for p in range(outputs):
            for i in range(n):
                for j in range(n):
                    R[orders * (o + 1) - 1, orders * (p + 1) - 1] += 2.0 * MP[o, i, j] * MP[p, j, i]


@inlined
def _optimal_gain(
    P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, S: FloatArray, root: FloatArray, white: FloatArray,
    K: FloatArray,
) -> None:  # fmt: skip
    """S = H P H' + R, its root L, L^-1 y and K = P H' S^-1; NaN where S is not positive definite."""
    m, n = H.shape
    for i in range(n):
        for j in range(m):
            K[i, j] = 0.0
            for k in range(n):
                K[i, j] += P[i, k] * H[j, k]
    for j in range(m):
        white[j] = y[j]
        for i in range(j, m):
            total = R[i, j]
            for k in range(n):
                total += H[i, k] * K[k, j]
            S[i, j] = S[j, i] = total
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = math.sqrt(total) if i == j else total / root[j, j]
    for j in range(m):
        for k in range(j):
            white[j] -= root[j, k] * white[k]
        white[j] /= root[j, j]
    for i in range(n):
        for j in range(m):
            for k in range(j):
                K[i, j] -= root[j, k] * K[i, k]
            K[i, j] /= root[j, j]
        for j in range(m - 1, -1, -1):
            for k in range(j + 1, m):
                K[i, j] -= root[k, j] * K[i, k]
            K[i, j] /= root[j, j]


@inlined
def _joseph(
    x: FloatArray, P: FloatArray, y: FloatArray, H: FloatArray, R: FloatArray, K: FloatArray, KR: FloatArray,
    keep: FloatArray, product: FloatArray, after: FloatArray, updated: FloatArray,
) -> float:  # fmt: skip
    """x + K y and (I - K H) P (I - K H)' + K R K'; returns a sum that is finite where all of them are."""
    n, m = K.shape
    whole = 0.0
    for i in range(n):
        after[i] = x[i]
        for j in range(m):
            after[i] += K[i, j] * y[j]
            KR[i, j] = 0.0
            for k in range(m):
                KR[i, j] += K[i, k] * R[k, j]
        whole += after[i]
        for j in range(n):
            keep[i, j] = 1.0 if i == j else 0.0
            for k in range(m):
                keep[i, j] -= K[i, k] * H[k, j]
    for i in range(n):
        for j in range(i + 1):
            updated[i, j] = 0.0
            for k in range(m):
                updated[i, j] += KR[i, k] * K[j, k]
    _congruence(keep, P, product, updated, updated)
    for i in range(n):
        for j in range(n):
            whole += updated[i, j]
    return whole


@inlined
def _congruence(A: FloatArray, P: FloatArray, product: FloatArray, added: FloatArray, out: FloatArray) -> None:
    """A P A' + Q, from Q's lower half; ``added`` and P may be ``out``."""
    n = len(A)
    for i in range(n):
        for j in range(n):
            product[i, j] = 0.0
            for k in range(n):
                product[i, j] += A[i, k] * P[k, j]
    for i in range(n):
        for j in range(i + 1):
            total = added[i, j]
            for k in range(n):
                total += product[i, k] * A[j, k]
            out[i, j] = out[j, i] = total
