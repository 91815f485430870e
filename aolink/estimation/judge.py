"""The verdict's evidence, gathered exposure by exposure; and the wider intervals where the model does not fit.

The evidence is what the estimator has computed: its innovation, and of `profile` the residuals of the pixels at the
most likely path. Each exposure gives numbers that are standard normal where the model is right (squares by Wilson &
Hilferty, Proc. Natl. Acad. Sci. 17 (1931)), and the sums over the newest exposures decide:

- *pixels*: the residuals, and the light that was measured (the moment of order 0);
- *motion*: the squared errors with which the spot's mean position was predicted;
- *zero*: the mean of these errors;
- *nis*: the squared innovation as a whole, which does not say what is wrong.

So does a share of refused frames. `o1` to `o3` leave out the process noise inside an exposure: of them only the mean
position is judged, with the noise that it has of that.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.verdict import Fit, Verdict
from aolink.numerics.arrays import FloatArray, IntArray
from aolink.rig import Rig

FIRST = 8
"""Exposures before the first one that counts: the start settles."""
WINDOW, FEWEST, BETWEEN = 96, 40, 8
"""Exposures that are judged together, the fewest of them, and those from one judgement to the next."""
LIMITS = {"pixels": 3.8, "motion": 3.6, "zero": 3.6, "nis": 3.0}
"""Standard errors from which on the model does not fit; below `FITS` of them it does (`tools/judge verdict`)."""
FITS = 0.8
_GATED = 0.2
"""Share of gated exposures from which on the model does not fit: where it is right, hardly one in a hundred is."""
_REFUSED = (Status.GATED, Status.DIVERGED, Status.REINITIALISED)
_WIDEST = 100.0
"""The most that a variance is multiplied by."""
_MOST = 4.0
"""The most that one normal number counts: no single exposure decides."""


class Shown(NamedTuple):
    """What one exposure says."""

    innovation: FloatArray
    """(axes, n_measurements)"""
    covariance: FloatArray
    """(axes, n_measurements, n_measurements)"""
    nis: FloatArray
    """(axes,), zero where nothing was measured."""
    residual: FloatArray
    """As in `Posterior`, (axes, 2)."""


class Judge:
    """Judges the estimates of one estimator on a rig; ``orders`` are those of the moments that it measures."""

    def __init__(self, rig: Rig, orders: IntArray) -> None:
        self._position, self._light = (np.flatnonzero(orders == order) for order in (1, 0))
        self._able = 0 < len(self._position) == rig.plant.n_outputs <= 2 and rig.sensor.spot_light is None
        self._no_residual = np.zeros((rig.plant.axes, 2))
        self._shown: deque[Shown] = deque(maxlen=WINDOW)
        self._gated: deque[bool] = deque(maxlen=WINDOW)
        self._exposures = 0
        self.verdict = Verdict(fit=Fit.UNKNOWN)

    def take(self, estimate: Estimate, residual: FloatArray | None) -> Estimate:
        """The estimate with the verdict on the exposures up to it, wider where the model does not fit.

        ``residual`` is that of the posterior.
        """
        if not self._able or estimate.status is Status.PREDICTED:
            return estimate
        self._exposures += 1
        if self._exposures > FIRST:
            self._gated.append(estimate.status in _REFUSED)
            if estimate.innovation.shape[1]:
                residual = self._no_residual if residual is None else residual
                shown = Shown(estimate.innovation, estimate.innovation_covariance, estimate.nis, residual)
                self._shown.append(shown)
            if len(self._gated) >= FEWEST and self._exposures % BETWEEN == 0:
                after = judged(self._evidence(estimate), len(self._shown), float(np.mean(self._gated)), self.verdict)
                since = self.verdict.since if after.fit is self.verdict.fit else estimate.frame_id
                self.verdict = replace(after, since=since)
        return widened(estimate, self.verdict)

    def _evidence(self, estimate: Estimate) -> Evidence:
        """What the newest exposures say; ``estimate`` is the last of them."""
        if not self._shown:
            return Evidence(0.0, 0.0, 0.0, 0.0, 1.0)
        innovation, covariance, nis, residual = (np.array(each) for each in zip(*self._shown, strict=True))
        count, _, m = innovation.shape
        seen, n = nis > 0, estimate.start_state.shape[1]
        variance = np.where(seen[..., None], np.einsum("kamm->kam", covariance), 1.0)
        with_noise = estimate.coefficients.shape[1] > n
        inside = np.zeros(1) if with_noise else (estimate.model.basis[..., n:].mean(axis=1) ** 2).sum(axis=1)
        position = innovation[..., self._position] / np.sqrt(variance[..., self._position] + inside)
        squares = position**2
        kinds = {"motion": (squares, 1)}
        if with_noise:
            light = innovation[..., self._light] ** 2 / variance[..., self._light]
            kinds |= {"nis": (nis[..., None], m), "light": (light, 1)}
        fitted, pixels = residual[..., :1], residual[..., 1:]
        if pixels.any():
            kinds["pixels"] = (fitted, np.maximum(pixels, 1.0))
        # Means over the axes, whose errors may be alike.
        share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
        sums = {
            name: float((as_normal(each, degrees).mean(axis=2) * share).sum()) / math.sqrt(count)
            for name, (each, degrees) in kinds.items()
        }
        ratios = [((each / degrees).mean(axis=2) * share).sum(axis=1) for each, degrees in kinds.values()]
        mean = np.abs(np.clip(position, -_MOST, _MOST).sum(axis=0)).max() / math.sqrt(count)
        return Evidence(
            pixels=max(sums.get("pixels", 0.0), sums.get("light", 0.0)), motion=sums["motion"], zero=float(mean),
            nis=sums.get("nis", 0.0), square=float(np.minimum(np.max(ratios, axis=0), _WIDEST).mean()),
        )  # fmt: skip


class Evidence(NamedTuple):
    """Sums over some exposures of numbers that are standard normal where the model is right, in standard errors."""

    pixels: float
    motion: float
    zero: float
    nis: float
    square: float
    """Mean of the largest of each exposure's squares over their expectations."""


def as_normal(squares: FloatArray, degrees: FloatArray | int) -> FloatArray:
    """Chi-square numbers made normal, those far out cut off."""
    bend = 2 / (9 * np.asarray(degrees, dtype=np.float64))
    return np.clip((np.cbrt(squares / degrees) - (1 - bend)) / np.sqrt(bend), -_MOST, _MOST)


def judged(found: Evidence, exposures: int, gated: float, before: Verdict) -> Verdict:
    """The verdict by some exposures, of which a share was gated; between the limits it stays as it was."""
    over = {name: getattr(found, name) / limit for name, limit in LIMITS.items()}
    worst = max(gated / _GATED, *over.values())
    fit = Fit.DOES_NOT_FIT if worst > 1 else Fit.FITS if worst < FITS else before.fit
    numbers = {name: getattr(found, name) for name in LIMITS}
    if fit is not Fit.DOES_NOT_FIT:
        return Verdict(fit=fit, exposures=exposures, **numbers)
    kind = max(("pixels", "motion", "zero"), key=over.__getitem__)
    kind = kind if gated <= _GATED and over[kind] > 1 else ""
    widening = math.sqrt(max(1.0, found.square))
    return Verdict(fit=fit, kind=kind, exposures=exposures, widening=widening, **numbers)


def widened(estimate: Estimate, verdict: Verdict) -> Estimate:
    """The estimate with a verdict; where the model does not fit, with wider intervals and the reason for them."""
    estimate = replace(estimate, verdict=verdict)
    if verdict.fit is not Fit.DOES_NOT_FIT:
        return estimate
    reason = "; ".join(filter(None, [estimate.reason, verdict.text]))
    return replace(scaled(estimate, verdict.widening), reason=reason)


def scaled(estimate: Estimate, factor: float) -> Estimate:
    """The estimate with standard deviations times a factor."""
    square, alignment = factor**2, estimate.alignment
    if alignment is not None:
        alignment = replace(
            alignment, coefficients=alignment.coefficients * factor, end_state=alignment.end_state * factor
        )
    return replace(
        estimate, start_covariance=estimate.start_covariance * square, end_covariance=estimate.end_covariance * square,
        coefficient_covariance=estimate.coefficient_covariance * square, alignment=alignment,
    )  # fmt: skip
