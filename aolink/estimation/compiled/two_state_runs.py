"""o3 over many exposures of many axes with two states: the lines of `two_states`, compiled to the same bits.

Products and sums are not fused and not reordered: an exposure that is estimated alone, in whole-array calls, gives the
same numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from numba.extending import overload

from aolink.estimation.compiled import two_states
from aolink.estimation.compiled.small import compiled_exactly
from aolink.numerics.arrays import FloatArray
from aolink.numerics.entrywise import reciprocal

NUMBERS = 16
"""Numbers for each axis and exposure: mean (2), upper halves of P and S (3 each), NIS; end state (2) and upper half of
its covariance (3), innovation (2)."""


@overload(reciprocal, jit_options={"error_model": "numpy"}, strict=False)  # names differ in annotations
def _reciprocal(x: Any) -> Callable[[float], float]:
    return lambda x: 1.0 / x


_update = compiled_exactly(two_states.update)
_weighted = compiled_exactly(two_states.weighted)


@compiled_exactly
def update_and_predict(
    transition: FloatArray, weights: FloatArray, mean_row: FloatArray, quadratic: FloatArray, added: FloatArray,
    means: FloatArray, slopes: FloatArray, squares: FloatArray, kicks: FloatArray, values: FloatArray,
    noises: FloatArray, gate: float, state: FloatArray, covariance: FloatArray, unseen: FloatArray, out: FloatArray,
) -> int:  # fmt: skip
    """Update and predict exposure by exposure, up to the first of which an axis is gated or not finite.

    Parameters
    ----------
    transition, weights:
        A (2, 2), and `two_states.weights_of` it, (3, 3).
    mean_row, quadratic:
        Rows of both moments' prediction, (2,) and (2, 2).
    added:
        Upper half of what an exposure adds to the covariance, (3,).
    means, slopes, squares, kicks:
        Responses to the inputs, (exposures, axes), (., ., 2), (., .) and (., ., 2).
    values, noises:
        Measured moments (., ., 2) and the upper half of their covariance (., ., 3).
    gate:
        The largest NIS of a measurement that is used.
    state, covariance, unseen:
        At the start of the first exposure: (axes, 2), upper halves (axes, 3), and the state by the prediction without
        any measurement (axes, 2). They become those after the last one that was taken.
    out:
        Filled with `NUMBERS` of each, (exposures, axes, 16).

    Returns
    -------
    How many exposures were taken.
    """
    a, b, c, d = transition[0, 0], transition[0, 1], transition[1, 0], transition[1, 1]
    m00, m01, m10, m11 = quadratic[0, 0], quadratic[0, 1], quadratic[1, 0], quadratic[1, 1]
    f0, f1 = mean_row[0], mean_row[1]
    for k in range(len(values)):
        for axis in range(values.shape[1]):
            x, v = state[axis, 0], state[axis, 1]
            p, q, r = covariance[axis, 0], covariance[axis, 1], covariance[axis, 2]
            b0, b1 = slopes[k, axis, 0], slopes[k, axis, 1]
            half0, half1 = m00 * x + m01 * v + b0, m10 * x + m11 * v + b1
            z1 = values[k, axis, 0] - (f0 * x + f1 * v + means[k, axis])
            z2 = values[k, axis, 1] - (x * (half0 + b0) + v * (half1 + b1) + squares[k, axis])
            noise = (noises[k, axis, 0], noises[k, axis, 1], noises[k, axis, 2])
            after = _update((x, v), (p, q, r), (z1, z2), ((f0, f1), (2 * half0, 2 * half1)), noise, noise[1] != 0.0)
            total = z1 + z2
            for j in range(9):
                total += after[j]
                out[k, axis, j] = after[j]
            # The caller takes an exposure that is gated or not finite step by step, and says why.
            if not (after[8] <= gate and math.isfinite(total)):
                return k
            x, v, p, q, r = after[0], after[1], after[2], after[3], after[4]
            out[k, axis, 9] = a * x + b * v + kicks[k, axis, 0]
            out[k, axis, 10] = c * x + d * v + kicks[k, axis, 1]
            for j in range(3):
                share = _weighted((weights[j, 0], weights[j, 1], weights[j, 2]), p, q, r)
                out[k, axis, 11 + j] = share + added[j]
            out[k, axis, 14], out[k, axis, 15] = z1, z2
        for axis in range(values.shape[1]):  # only now is it known that all axes are good
            for j in range(2):
                state[axis, j] = out[k, axis, 9 + j]
            for j in range(3):
                covariance[axis, j] = out[k, axis, 11 + j]
            x, v = unseen[axis, 0], unseen[axis, 1]
            unseen[axis, 0] = a * x + b * v + kicks[k, axis, 0]
            unseen[axis, 1] = c * x + d * v + kicks[k, axis, 1]
    return len(values)
