"""The scanner: a line of the scene as the output of a small system that white noise drives (Shahin, V)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from aolink.errors import RestorationError
from aolink.numerics.arrays import FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Scanner:
    """Z(k+1) = alpha Z(k) + beta U(k), scene(k) = gamma Z(k), of zero mean; Shahin (11)."""

    alpha: FloatArray
    """(states, states); stable."""
    noise: FloatArray
    """beta K beta', (states, states)."""
    gamma: FloatArray
    """(states,)"""

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the stationary state, (states, states)."""
        return np.asarray(linalg.solve_discrete_lyapunov(self.alpha, self.noise))

    def correlation(self, lags: int) -> FloatArray:
        """Covariance of the scene with itself 0 .. lags pixels on, (lags + 1,)."""
        reach, out = self.covariance @ self.gamma, np.empty(lags + 1)
        for k in range(lags + 1):
            out[k] = self.gamma @ reach
            reach = self.alpha @ reach
        return out


def first_order(correlation: float, variance: float) -> Scanner:
    """A first-order Gauss-Markov line: neighbours have this ``correlation``; 0 is the delay of Shahin, V.

    Raises
    ------
    RestorationError
        The correlation is not from 0 to below 1, or the variance not above 0.
    """
    if not 0 <= correlation < 1 or not (variance > 0 and math.isfinite(variance)):
        raise RestorationError(
            f"a first-order scanner needs a correlation from 0 to below 1 and a variance above 0,"
            f" found {correlation:g} and {variance:g}"
        )
    return Scanner(
        alpha=np.array([[correlation]]), noise=np.array([[variance * (1 - correlation**2)]]), gamma=np.ones(1)
    )


def from_correlation(correlation: ArrayLike) -> Scanner:
    """The autoregressive line that has a given correlation function (Yule and Walker).

    Parameters
    ----------
    correlation:
        Covariance of the zero-mean line with itself 0, 1, .. p pixels on, p >= 1: given, or as `measured_correlation`
        finds it on a sharp picture of the same kind, (p + 1,).

    Raises
    ------
    RestorationError
        No line can have this correlation function.
    """
    r = np.asarray(correlation, dtype=np.float64)
    if r.ndim != 1 or len(r) < 2 or not np.isfinite(r).all() or np.linalg.eigvalsh(linalg.toeplitz(r)).min() <= 0:
        raise RestorationError(
            "a correlation function needs two or more finite values that some line can have (a positive definite"
            " Toeplitz matrix); take fewer lags, or measure it over more pixels"
        )
    p = len(r) - 1
    weights = linalg.solve_toeplitz(r[:-1], r[1:])
    alpha, noise = np.eye(p, k=-1), np.zeros((p, p))
    alpha[0], noise[0, 0] = weights, r[0] - weights @ r[1:]
    return Scanner(alpha=alpha, noise=noise, gamma=np.eye(p)[0])


def measured_correlation(image: FloatArray, lags: int) -> FloatArray:
    """Covariance along the rows of a picture (rows, columns) about its mean, 0 .. lags pixels on, (lags + 1,).

    Divided by the number of all pixels, so that some line can have it.
    """
    away = image - image.mean()
    columns = image.shape[-1]
    return np.array([(away[:, k:] * away[:, : columns - k]).sum() / away.size for k in range(lags + 1)])
