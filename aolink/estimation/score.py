"""Estimates against the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from aolink.estimation.estimate import Estimate
from aolink.exposure import Exposure

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Consistency:
    """A mean of squares that follows chi-square where the covariance is right."""

    mean: float
    """NaN where there was nothing to average."""
    low: float
    high: float
    """Bounds that a consistent estimator's mean keeps to with 95 % probability, for samples that are independent."""

    @property
    def inside(self) -> bool:
        """Whether the mean is within its bounds."""
        return self.low <= self.mean <= self.high


@dataclass(frozen=True, kw_only=True)
class Score:
    """How well an estimator knew the truth."""

    exposures: int
    """Exposures with truth that were scored."""
    start_rmse: float
    """Root mean square over exposures and axes of the norm of the error of the start state (Mishra & Wen, figure 5)."""
    end_rmse: float
    """The same of the end state."""
    path_rmse: float
    """Root mean square error of the path, slope units."""
    nis: Consistency
    start_nees: Consistency
    end_nees: Consistency


def score(exposures: Sequence[Exposure], estimates: Sequence[Estimate], skip: int = 0) -> Score:
    """Score estimates, one for each exposure, against their truth; the first ``skip`` are left out."""
    if len(exposures) != len(estimates):
        raise ValueError(f"{len(estimates)} estimates for {len(exposures)} exposures")
    start, end, path = [], [], []
    start_nees, end_nees, nis, dimensions = [], [], [], []
    for exposure, estimate in list(zip(exposures, estimates, strict=True))[skip:]:
        truth = exposure.truth
        if truth is None:
            continue
        at_start, at_end = estimate.start_state - truth.start_state, estimate.end_state - truth.end_state
        start.append(at_start)
        end.append(at_end)
        path.append(np.mean((estimate.path - truth.path) ** 2))
        start_nees.append(_normalised(at_start, estimate.start_covariance))
        end_nees.append(_normalised(at_end, estimate.end_covariance))
        if estimate.innovation.shape[1]:
            seen = estimate.nis > 0  # nothing was measured of the other axes
            nis.append(estimate.nis[seen])
            dimensions.append(estimate.innovation.shape[1] * int(seen.sum()))
    n_states = start[0].shape[1] if start else 0
    states = len(start) * (len(start[0]) if start else 0) * n_states
    return Score(
        exposures=len(start),
        start_rmse=_rms_norm(start),
        end_rmse=_rms_norm(end),
        path_rmse=math.sqrt(np.mean(path)) if path else math.nan,
        nis=_consistency(nis, sum(dimensions)),
        start_nees=_consistency(start_nees, states),
        end_nees=_consistency(end_nees, states),
    )


def _rms_norm(errors: Sequence[FloatArray]) -> float:
    return math.sqrt(np.mean([np.mean((e**2).sum(axis=1)) for e in errors])) if errors else math.nan


def _normalised(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Error' covariance^+ error for each axis, (axes,). A direction without variance counts nothing."""
    weighted = np.linalg.pinv(covariance, hermitian=True) @ error[..., None]
    return np.asarray((error * weighted[..., 0]).sum(axis=1))


def _consistency(values: Sequence[FloatArray], degrees: int) -> Consistency:
    samples = sum(len(v) for v in values)
    if not samples:
        return Consistency(mean=math.nan, low=math.nan, high=math.nan)
    low, high = (2 * float(special.gammaincinv(degrees / 2, p)) / samples for p in (0.025, 0.975))
    return Consistency(mean=float(np.concatenate(values).mean()), low=low, high=high)
