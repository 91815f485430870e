"""Quantiles of the chi-square distribution.

SciPy has them, too, but takes a third of a second to load: too long where a recording is only viewed.
"""

from __future__ import annotations

import math

_CLOSE = 1e-9
"""Relative size of the last step: the step before it was about its square root."""
_ROUNDS = 100


def chi_square_quantile(share: float, degrees: int) -> float:
    """The value below which a chi-square variable with a number of degrees of freedom stays with probability ``share``.

    Newton's iteration on the regularised incomplete gamma function, P(a, x) = share with a = degrees / 2: the quantile
    is 2 x. Raises `ValueError` where ``share`` is not between 0 and 1, or ``degrees`` not positive.
    """
    if not (0 < share < 1 and degrees > 0):
        raise ValueError(f"a share between 0 and 1 of a positive number of degrees, not {share:g} of {degrees}")
    a = degrees / 2
    low, high = 0.0, math.inf
    x = a
    for _ in range(_ROUNDS):
        density, below = _gamma(a, x)
        low, high = (x, high) if below < share else (low, x)
        step = (share - below) / density if density else math.inf
        if low <= x + step <= high:
            x += step
        else:  # the step leaves the interval of the solution, which is halved instead, as a ratio
            x = math.sqrt((low or 1e-6 * x) * high) if high < math.inf else 2 * x
        if abs(step) <= _CLOSE * x:
            break
    return 2 * x


def _gamma(a: float, x: float) -> tuple[float, float]:
    """Density of the gamma distribution of shape a at x, and P(a, x) = density x/a (1 + x/(a+1) + ...)."""
    density = math.exp((a - 1) * math.log(x) - x - math.lgamma(a))
    term = total = 1.0
    n = 0
    while term > 1e-17 * total:
        n += 1
        term *= x / (a + n)
        total += term
    return density, density * x / a * total
