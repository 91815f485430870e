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
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray
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
    """What one exposure says; means over the axes, whose errors may be alike."""

    pixels: float
    motion: float
    nis: float
    position: FloatArray
    """Error of the predicted mean position in its standard deviations, zero where there was none, (axes, outputs)."""
    widening: float
    """The largest of the squares over their expectation."""


class Judge:
    """Judges the estimates of one estimator on a rig; ``orders`` are those of the moments that it measures."""

    def __init__(self, rig: Rig, orders: IntArray) -> None:
        self._position, self._light = (np.flatnonzero(orders == order) for order in (1, 0))
        self._able = 0 < len(self._position) == rig.plant.n_outputs <= 2 and rig.sensor.spot_light is None
        self._shown: deque[Shown] = deque(maxlen=WINDOW)
        self._gated: deque[bool] = deque(maxlen=WINDOW)
        self._exposures = 0
        self._noise_of: tuple[object, FloatArray] = None, np.zeros(0)
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
            seen = estimate.nis > 0
            if seen.any():
                self._shown.append(self._shown_by(estimate, seen, residual))
            if len(self._gated) >= FEWEST and self._exposures % BETWEEN == 0:
                after = judged(self._shown, float(np.mean(self._gated)), self.verdict)
                since = self.verdict.since if after.fit is self.verdict.fit else estimate.frame_id
                self.verdict = replace(after, since=since)
        return widened(estimate, self.verdict)

    def _shown_by(self, estimate: Estimate, seen: BoolArray, residual: FloatArray | None) -> Shown:
        innovation, degrees = estimate.innovation[seen], estimate.innovation.shape[1]
        variance = np.einsum("amm->am", estimate.innovation_covariance[seen])
        whole = estimate.coefficients.shape[1] > estimate.start_state.shape[1]
        position = np.zeros((len(seen), len(self._position)))
        spread = variance[:, self._position] + (0.0 if whole else self._noise_inside(estimate))
        position[seen] = innovation[:, self._position] / np.sqrt(spread)
        squares = position[seen] ** 2
        ratios, pixels, nis = [squares.mean()], [0.0], 0.0
        if whole:
            nis = float(as_normal(estimate.nis[seen], degrees).mean())
            ratios.append(estimate.nis[seen].mean() / degrees)
            pixels += [as_normal(innovation[:, k] ** 2 / variance[:, k], 1).mean() for k in self._light]
        if residual is not None:
            sums, counts = residual[seen].T
            pixels.append(as_normal(sums, counts).mean())
            ratios.append((sums / counts).mean())
        motion = float(as_normal(squares, 1).mean())
        return Shown(
            float(max(pixels, key=abs)), motion, nis, np.clip(position, -_MOST, _MOST), min(max(ratios), _WIDEST)
        )

    def _noise_inside(self, estimate: Estimate) -> FloatArray:
        """Variance of the mean path by the process noise inside the exposure, (outputs,)."""
        model, of = self._noise_of
        if model is not estimate.model:
            rows = estimate.model.basis[..., estimate.start_state.shape[1] :].mean(axis=1)
            of = np.asarray((rows**2).sum(axis=1))
            self._noise_of = estimate.model, of
        return of


def as_normal(squares: FloatArray, degrees: FloatArray | int) -> FloatArray:
    """Chi-square numbers made normal, those far out cut off."""
    bend = 2 / (9 * np.asarray(degrees, dtype=np.float64))
    return np.clip((np.cbrt(squares / degrees) - (1 - bend)) / np.sqrt(bend), -_MOST, _MOST)


def judged(shown: deque[Shown], gated: float, before: Verdict) -> Verdict:
    """The verdict by some exposures, of which a share was gated; between the limits it stays as it was."""
    root = math.sqrt(max(len(shown), 1))
    numbers = {name: sum(getattr(each, name) for each in shown) / root for name in ("pixels", "motion", "nis")}
    numbers["zero"] = float(np.abs(sum(each.position for each in shown)).max(initial=0.0)) / root
    worst = max(gated / _GATED, *(numbers[name] / limit for name, limit in LIMITS.items()))
    fit = Fit.DOES_NOT_FIT if worst > 1 else Fit.FITS if worst < FITS else before.fit
    found = Verdict(fit=fit, exposures=len(shown), **numbers)
    if fit is not Fit.DOES_NOT_FIT:
        return found
    kind = max(("pixels", "motion", "zero"), key=lambda name: numbers[name] / LIMITS[name])
    told = gated <= _GATED and numbers[kind] > LIMITS[kind]
    widening = math.sqrt(max(1.0, float(np.mean([each.widening for each in shown]))))
    return replace(found, kind=kind if told else "", widening=widening)


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
