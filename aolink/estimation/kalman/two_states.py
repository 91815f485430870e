"""o3 for one axis with two states, the extended Kalman filter with y_1 and y_2, written out number by number.

The same lines take arrays with a value for each axis, or plain numbers of a single one, to the same bits. For a single
axis a series of exposures is one loop over numbers (`run`): as arrays they would take thirty times as long. The rows
`o3_step` and `reestimation_rate` of tools/bench are theirs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.numerics.arrays import FloatArray
from aolink.numerics.entrywise import Entry, reciprocal

Weights = tuple[float, float, float]


def update(
    mean: Sequence[Entry], spread: Sequence[Entry], innovation: Sequence[Entry], slopes: Sequence[Sequence[Entry]],
    noise: Sequence[Entry], *, together: bool,
) -> tuple[Entry, ...]:  # fmt: skip
    """The Kalman correction with the optimal gain.

    With G = H' R^-1 H, (P^-1 + G)^-1 = (P + |P| adj G) |R| / |S|, |S| = |R| (1 + tr PG + |P| |G|): three quarters of
    the arithmetic of Joseph's form, and as sure to be positive semidefinite, for nothing is subtracted from P.

    Parameters
    ----------
    spread, noise:
        Upper halves of P and R: first variance, covariance, second variance.
    slopes:
        Rows of H.
    together:
        Whether R has a covariance other than zero.

    Returns
    -------
    Mean (2), upper half of P (3), upper half of S (3) and NIS.
    """
    (x, v), (p, q, r), (d, e) = mean, spread, innovation
    (f0, f1), (g0, g1) = slopes
    first, shared, rest = noise
    share: Entry = 0.0
    if together:
        # The second measurement without what its noise shares with the first's: G is then the sum of two dyads.
        share = shared / first
        g0, g1 = g0 - share * f0, g1 - share * f1
        e, rest = e - share * d, rest - share * shared
    pf0, pf1 = p * f0 + q * f1, q * f0 + r * f1
    pg0, pg1 = p * g0 + q * g1, q * g0 + r * g1
    s, t, both = f0 * pf0 + f1 * pf1, g0 * pg0 + g1 * pg1 + rest, f0 * pg0 + f1 * pg1
    # Rounding may make it a little less than zero.
    determinant: Entry = abs(p * r - q * q)  # type: ignore[assignment] # of either it is its own kind
    root = f0 * g1 - f1 * g0
    inverse = reciprocal(first * t + s * rest + determinant * root * root)  # 1 / |S|
    s = s + first

    rf0, rf1, ng0, ng1 = rest * f0, rest * f1, first * g0, first * g1
    size, determinant = first * rest * inverse, determinant * inverse
    p = size * p + determinant * (f1 * rf1 + g1 * ng1)
    q = size * q + determinant * (-f0 * rf1 - g0 * ng1)
    r = size * r + determinant * (f0 * rf0 + g0 * ng0)

    # S^-1 and the gain P H' S^-1
    s_inverse, t_inverse, off = t * inverse, s * inverse, both * inverse
    x = x + ((pf0 * s_inverse - pg0 * off) * d + (pg0 * t_inverse - pf0 * off) * e)
    v = v + ((pf1 * s_inverse - pg1 * off) * d + (pg1 * t_inverse - pf1 * off) * e)
    nis = d * (s_inverse * d - 2.0 * (off * e)) + e * (t_inverse * e)
    if together:
        both, t = both + share * s, t + share * (2.0 * both + share * s)
    return x, v, p, q, r, s, both, t, nis


@dataclass(frozen=True, eq=False)
class Run:
    """Posteriors of consecutive exposures of one axis, as in `Posterior`; arrays are (exposures, 1, ...)."""

    coefficients: FloatArray
    covariance: FloatArray
    end: FloatArray
    end_covariance: FloatArray
    innovation: FloatArray
    innovation_covariance: FloatArray
    nis: FloatArray


def run(
    model: ExposureModel, process_noise: FloatArray, state: FloatArray, covariance: FloatArray,
    responses: InputResponse, values: FloatArray, noises: FloatArray, gate: float,
) -> Run:  # fmt: skip
    """Update and predict exposure by exposure, up to the first that is gated or not finite.

    Parameters
    ----------
    process_noise:
        What an exposure adds to the covariance, (2, 2).
    state, covariance:
        At the start of the first exposure, (2,) and (2, 2).
    responses:
        Responses to the inputs of each exposure, (exposures, ...).
    values, noises:
        Measured moments, (exposures, 2), and their covariance, (exposures, 2, 2).
    gate:
        The largest NIS of a measurement that is used.

    Returns
    -------
    One row for each exposure before that one.
    """
    (f0, f1), ((m00, m01), (m10, m11)) = model.mean_row[0].tolist(), model.quadratic[0].tolist()
    (a, b), (c, d) = model.transition.tolist()
    (first_weights, cross_weights, second_weights) = _weights(model.transition)
    (q0, _), (q1, q2) = process_noise.tolist()
    (x, v), ((p, q), (_, r)) = state.tolist(), covariance.tolist()
    rows: list[float] = []
    given = zip(
        values.tolist(), noises.reshape(-1, 4).tolist(), responses.mean[:, 0].tolist(),
        responses.slope[:, 0].tolist(), responses.square[:, 0].tolist(), responses.end.tolist(), strict=True,
    )  # fmt: skip
    for (y1, y2), (noise, shared, _, rest), mean, (b0, b1), square, (d0, d1) in given:
        half0, half1 = m00 * x + m01 * v + b0, m10 * x + m11 * v + b1
        z1 = y1 - (f0 * x + f1 * v + mean)
        z2 = y2 - (x * (half0 + b0) + v * (half1 + b1) + square)
        after: tuple[float, ...] = update(  # type: ignore[assignment] # numbers in, numbers out
            (x, v), (p, q, r), (z1, z2), ((f0, f1), (2 * half0, 2 * half1)), (noise, shared, rest),
            together=shared != 0.0,
        )  # fmt: skip
        # The caller takes an exposure that is gated or not finite step by step, and says why.
        if not (after[8] <= gate and math.isfinite(sum(after) + z1 + z2)):
            break
        x0, v0, p0, q0_, r0 = after[:5]
        x, v = a * x0 + b * v0 + d0, c * x0 + d * v0 + d1
        p = _weighted(first_weights, p0, q0_, r0) + q0
        q = _weighted(cross_weights, p0, q0_, r0) + q1
        r = _weighted(second_weights, p0, q0_, r0) + q2
        rows.extend((*after, x, v, p, q, r, z1, z2))
    table = np.array(rows).reshape(-1, 1, 16)
    return Run(
        coefficients=table[..., :2],
        covariance=table[..., _SQUARE + 2],
        end=table[..., 9:11],
        end_covariance=table[..., _SQUARE + 11],
        innovation=table[..., 14:],
        innovation_covariance=table[..., _SQUARE + 5],
        nis=table[..., 8],
    )


def unseen(
    model: ExposureModel, state: FloatArray, covariance: FloatArray, kicks: FloatArray, settled: float | None
) -> tuple[FloatArray, FloatArray, bool]:
    """Predict over exposures one after the other: state, covariance, and whether that no longer changes.

    Parameters
    ----------
    kicks:
        The state's response to the inputs of each exposure, (exposures, 2).
    settled:
        Relative change below which the covariance has settled; None if it has settled already.
    """
    (a, b), (c, d) = model.transition.tolist()
    x, v = state.tolist()
    for d0, d1 in kicks.tolist():
        x, v = a * x + b * v + d0, c * x + d * v + d1
    moved = np.array([x, v])
    if settled is None:
        return moved, covariance, True
    weights, ((q0, _), (q1, q2)) = _weights(model.transition), model.process_noise.tolist()
    (p, q), (_, r) = covariance.tolist()
    for _ in kicks:
        before = (p, q, r)
        p, q, r = (_weighted(w, *before) + each for w, each in zip(weights, (q0, q1, q2), strict=True))
        change = max(abs(p - before[0]), abs(q - before[1]), abs(r - before[2]))
        if change <= settled * max(map(abs, before)):
            return moved, np.array([[p, q], [q, r]]), True
    return moved, np.array([[p, q], [q, r]]), False


_SQUARE = np.array([[0, 1], [1, 2]])
"""Where the entries of a symmetric matrix are in its upper half."""


def _weights(transition: FloatArray) -> tuple[Weights, Weights, Weights]:
    """Coefficients of P's upper half in the upper half of A P A'."""
    (a, b), (c, d) = transition.tolist()
    return (a * a, a * b + b * a, b * b), (c * a, c * b + d * a, d * b), (c * c, c * d + d * c, d * d)


def _weighted(weights: Weights, p: float, q: float, r: float) -> float:
    return weights[0] * p + weights[1] * q + weights[2] * r
