"""o3 for two states, the extended Kalman filter with y_1 and y_2, written out number by number.

The same lines take arrays with a value for each axis, plain numbers of a single one, or are compiled
(`aolink.estimation.compiled.two_state_runs`), all to the same bits: the rows `o3_step` and `reestimation_rate` of
tools/bench need them.
"""

from __future__ import annotations

from collections.abc import Sequence

from aolink.numerics.arrays import FloatArray
from aolink.numerics.entrywise import Entry, reciprocal

Weights = tuple[float, float, float]


def update(
    mean: Sequence[Entry], spread: Sequence[Entry], innovation: Sequence[Entry], slopes: Sequence[Sequence[Entry]],
    noise: Sequence[Entry], together: bool,
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


def weights_of(transition: FloatArray) -> tuple[Weights, Weights, Weights]:
    """Coefficients of P's upper half in the upper half of A P A'."""
    (a, b), (c, d) = transition.tolist()
    return (a * a, a * b + b * a, b * b), (c * a, c * b + d * a, d * b), (c * c, c * d + d * c, d * d)


def weighted(weights: Weights, p: float, q: float, r: float) -> float:
    return weights[0] * p + weights[1] * q + weights[2] * r
