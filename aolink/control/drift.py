"""The check whether the model still fits, by the innovations of the estimator that closes the loop."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aolink.estimation import Estimate
from aolink.estimation.verdict import Fit as VerdictFit
from aolink.estimation.verdict import Verdict
from aolink.numerics.arrays import FloatArray

WINDOW = 60
"""Exposures that are judged together."""
TOLERATED_RATIO = 2.0
"""No model is exact: a mean NIS within this factor of its expectation does not count as drift, however significant."""
_TOLERATED_CORRELATION = 0.3
_SIGMAS = 5.0
"""Least deviation of a window, in standard deviations by chance."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Statistics of the innovations of the newest `WINDOW` exposures."""

    nis_ratio: float
    """Mean NIS over its expectation, the number of measurements: 1 where the model is right."""
    whiteness: float
    """Correlation of neighbouring innovations, in units of their own covariance: 0 where the model is right."""
    fits: bool
    """Whether both are within what chance and an inexact model explain, and the estimator's verdict agrees."""
    verdict: str = ""
    """The estimator's verdict, where it is that the model does not fit."""

    def text(self) -> str:
        if self.verdict:
            return self.verdict
        squares = f"squared errors of prediction (NIS) {self.nis_ratio:.2f} times what the model expects"
        return f"{squares}, correlation of neighbouring errors {self.whiteness:+.2f} where it expects 0"


class _Sums(NamedTuple):
    nis: float
    numbers: int
    product: float
    square: float


class FitMonitor:
    """Follows the innovations of an estimator, exposure by exposure."""

    def __init__(self) -> None:
        self._window: deque[_Sums] = deque(maxlen=WINDOW)
        self._before: FloatArray | None = None
        self._verdict: Verdict | None = None

    def add(self, estimate: Estimate) -> Fit | None:
        """Take the next estimate; None while fewer than `WINDOW` of them had a measurement."""
        measured, self._verdict = estimate.nis > 0, estimate.verdict
        if not measured.any():
            self._before = None
            return self.fit()
        white = _whitened(estimate)
        white[~measured] = 0.0
        before = white if self._before is None or self._before.shape != white.shape else self._before
        product = 0.0 if self._before is None else float((white * before).sum())
        count = int(measured.sum()) * white.shape[1]
        self._window.append(_Sums(float(estimate.nis.sum()), count, product, float((white**2).sum())))
        self._before = white
        return self.fit()

    def fit(self) -> Fit | None:
        """Statistics of the innovations of the newest exposures; None while they are too few."""
        wrong = self._verdict is not None and self._verdict.fit is VerdictFit.DOES_NOT_FIT
        if len(self._window) < (1 if wrong else WINDOW):
            return None
        nis, count, product, square = (sum(each) for each in zip(*self._window, strict=True))
        ratio, whiteness = nis / count, product / square
        off = max(ratio, 1 / ratio) > max(TOLERATED_RATIO, 1 + _SIGMAS * math.sqrt(2 / count))
        coloured = abs(whiteness) > max(_TOLERATED_CORRELATION, _SIGMAS / math.sqrt(count))
        verdict = self._verdict.text if wrong and self._verdict is not None else ""
        return Fit(nis_ratio=ratio, whiteness=whiteness, fits=not (off or coloured or wrong), verdict=verdict)


def _whitened(estimate: Estimate) -> FloatArray:
    """Innovations in units of their covariance, (axes, n_measurements)."""
    S = estimate.innovation_covariance
    if S.ndim == 2:  # with many measurements, only the diagonal is given
        return np.asarray(estimate.innovation / np.sqrt(np.where(S > 0, S, 1.0)))
    sound = np.diagonal(S, axis1=1, axis2=2).min(axis=1) > 0
    root = np.linalg.cholesky(np.where(sound[:, None, None], S, np.eye(S.shape[-1])))
    return np.asarray(np.linalg.solve(root, estimate.innovation[..., None])[..., 0])
