"""The verdict's evidence, gathered exposure by exposure; and the wider intervals where the model does not fit.

Every second exposure is compared with the model (`aolink.estimation.pixels.residuals`). Two statistics of the newest of
them decide. That of the pixels is Student's t of the residuals beyond those of frames drawn from the fitted paths. That
of the motion is the sum of squared, white errors of prediction of the spot's mean position, each made normal (Wilson &
Hilferty, Proc. Natl. Acad. Sci. 17 (1931)), or the mean of these errors. The estimator's own NIS, made normal as well,
decides with them; it does not say which of the two it is, and is wider than a chi-square, since posteriors are not
Gaussian. Gated exposures cannot be compared: their share is evidence of the motion by itself.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.base import over_steps
from aolink.estimation.pixels.residuals import Residuals, residuals
from aolink.estimation.verdict import Fit, Verdict
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.plant.alike import MANY_STATES
from aolink.rig import Rig

FIRST = 8
"""Exposures before the first one that is compared: the start settles."""
EVERY = 2
"""Of so many exposures one is compared; of fewer where there are many axes."""
WINDOW, FEWEST, BETWEEN = 48, 24, 8
"""Comparisons that are judged together, the fewest of them, and those from one judgement to the next."""
_AT_ONCE = 4
"""Most axes that are compared in one exposure."""
PIXELS_OFF, MOTION_OFF = 4.5, 4.0
"""Statistics from which on the model does not fit; below `FITS` of them it does. They were
chosen on some 40 right recordings of `moments`, and judged on others (`tools/judge verdict`)."""
FITS = 0.7
_NIS_SPREAD, _NIS_SPREAD_OF_MIXTURES = 1.5, 3.2
"""Standard deviation of the summed NIS where the model is right: of `moments`, and of `profile`."""
_STATIC = 7.0
"""Student's t of a single pixel's mean residual from which on it is no chance."""
_GATED = 0.2
"""Share of gated exposures from which on the model does not fit: where it is right, hardly one in a hundred is."""
_REFUSED = (Status.GATED, Status.DIVERGED, Status.REINITIALISED)
_WIDEST = 100.0
"""The most that a variance is multiplied by."""
_ALONE = 0.5
"""Share of a single pixel in the mean residuals' squares from which on they are at fixed places."""
_MOST = 4.0
"""The most that one normal number counts: no single exposure decides."""


class Statistics(NamedTuple):
    """Of the newest comparisons."""

    pixels: float
    motion: float
    mean: float
    """Largest mean error of a position."""
    static: float
    """Largest mean residual of a single pixel, as Student's t."""
    alone: float
    """Its share in the sum of their squares."""
    signatures: FloatArray
    """Mean products with `residuals.SIGNATURES`, as Student's t."""
    squares: float
    """Mean square of the white errors of position."""
    excess: float
    """Mean excess of a pixel's squared residual."""


_NOTHING = Statistics(0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(5), 1.0, 0.0)


class Judge:
    """Judges the estimates of one estimator on a rig."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._seen: deque[Residuals] = deque(maxlen=WINDOW)
        self._nis: deque[tuple[float, float]] = deque(maxlen=2 * WINDOW)
        """NIS made normal, and over its expectation; means over the axes, whose errors may be alike."""
        self._gated: deque[bool] = deque(maxlen=2 * WINDOW)
        self._nis_spread = _NIS_SPREAD
        self._exposures = self._compared = 0
        self._before: tuple[int, Gaussian] | None = None
        self.verdict = Verdict(fit=Fit.UNKNOWN)
        plant = rig.plant
        self._able = plant.n_outputs <= 2 and plant.n_states <= MANY_STATES and rig.sensor.spot_light is None
        self._every = max(EVERY, EVERY * -(-plant.axes // _AT_ONCE) // 2)

    def take(self, exposure: Exposure, estimate: Estimate, likeliest: FloatArray | None) -> Estimate:
        """The estimate with the verdict on the exposures up to it, wider where the model does not fit.

        ``likeliest`` is that of the posterior.
        """
        self._nis_spread = _NIS_SPREAD if likeliest is None else _NIS_SPREAD_OF_MIXTURES
        if not self._able or estimate.status is Status.PREDICTED:
            return estimate
        if self._exposures >= FIRST:
            self._gated.append(estimate.status in _REFUSED)
            if self._exposures % self._every == 0:
                self._compare(exposure, estimate, likeliest)
            due = len(self._gated) >= FEWEST and self._exposures % (self._every * BETWEEN) == 0
            if due and np.mean(self._gated) > _GATED:
                self._judge(exposure, estimate)
        degrees, seen = estimate.innovation.shape[1], estimate.nis > 0
        if self._exposures >= FIRST and seen.any() and self._models_noise(estimate):
            nis, each = estimate.nis[seen], np.full(int(seen.sum()), float(degrees))
            self._nis.append((float(_normal(nis, each).mean()), float(np.minimum(nis / degrees, _WIDEST).mean())))
        self._exposures += 1
        end = exposure.first_step + exposure.n_steps
        self._before = end, Gaussian(estimate.end_state, estimate.end_covariance)
        return widened(estimate, self.verdict)

    def _compare(self, exposure: Exposure, estimate: Estimate, likeliest: FloatArray | None) -> None:
        axes = np.arange(self._rig.plant.axes)
        if len(axes) > _AT_ONCE:
            axes = np.sort(np.roll(axes, -_AT_ONCE * self._compared)[:_AT_ONCE])
        found = residuals(self._rig, exposure, estimate, self._prediction(exposure, estimate), axes, likeliest)
        if found is None:
            return
        self._seen.append(found)
        self._compared += 1
        if len(self._seen) >= FEWEST and self._compared % BETWEEN == 0:
            self._judge(exposure, estimate)

    def _judge(self, exposure: Exposure, estimate: Estimate) -> None:
        nis, ratio = np.array(self._nis or [(0.0, 1.0)]).T
        own, gated = float(nis.sum()) / math.sqrt(len(nis)) / self._nis_spread, float(np.mean(self._gated))
        found = statistics(self._seen) if len(self._seen) >= FEWEST else _NOTHING
        after = judged(found, own, float(ratio.mean()), gated, self.verdict, self._compared)
        since = self.verdict.since if after.fit is self.verdict.fit else exposure.frame_id
        self.verdict = replace(after, since=since)

    def _models_noise(self, estimate: Estimate) -> bool:
        return bool(estimate.coefficients.shape[1] > self._rig.plant.n_states)

    def _prediction(self, exposure: Exposure, estimate: Estimate) -> Gaussian | None:
        """The start states as predicted from the exposure before; None where that is not known, and for the paper's
        filters, which leave out the noise inside an exposure."""
        if self._before is None or not self._models_noise(estimate):
            return None
        end, before = self._before
        gap = exposure.first_step - end
        if not 0 <= gap <= len(exposure.lead_inputs):
            return None
        if gap:
            transition, noise, kick = over_steps(self._rig.plant, exposure.lead_inputs[-gap:])
            before = before.mapped(transition, noise)
            before = Gaussian(before.mean + kick, before.covariance)
        return before


def statistics(seen: deque[Residuals]) -> Statistics:
    """What some comparisons say together."""
    excess = np.array([each.excess for each in seen])
    pixels = sum(each.pixels for each in seen)
    known = [each.position for each in seen if len(each.position)]
    squares, degrees = np.array([float(each @ each) for each in known]), np.array([float(len(each)) for each in known])
    motion = mean = 0.0
    if len(squares) >= FEWEST // 2:
        motion = float(_normal(squares, degrees).sum()) / math.sqrt(len(squares))
    same = [each for each in seen if each.position.shape == seen[-1].position.shape]
    if len(same) >= FEWEST // 2 and len(seen[-1].position):
        each = np.array([one.position for one in same])
        mean = float(np.abs(np.clip(each, -_MOST, _MOST).sum(axis=0)).max()) / math.sqrt(len(each))
    shapes = [each.static for each in seen if each.static.shape == seen[-1].static.shape]
    each_pixel = _student(np.array(shapes)) ** 2
    static, alone = math.sqrt(each_pixel.max()), float(each_pixel.max() / max(each_pixel.sum(), 1e-300))
    signatures = _student(np.array([each.signatures for each in seen]))
    total = float(squares.sum() / degrees.sum()) if len(squares) else 1.0
    return Statistics(
        float(_student(excess)), motion, mean, static, alone, signatures, total, float(excess.sum() / pixels)
    )


def _normal(squares: FloatArray, degrees: FloatArray) -> FloatArray:
    """Chi-square numbers made normal, those far out cut off."""
    bend = 2 / (9 * degrees)
    return np.clip(((squares / degrees) ** (1 / 3) - (1 - bend)) / np.sqrt(bend), -_MOST, _MOST)


def _student(values: FloatArray) -> FloatArray:
    """Student's t of the means over the first axis; zero where all values are equal."""
    spread = values.std(axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(spread > 0, values.mean(axis=0) / (spread / math.sqrt(len(values))), 0.0))


def judged(found: Statistics, nis: float, ratio: float, gated: float, before: Verdict, compared: int) -> Verdict:
    """The verdict by these statistics; between the limits it stays as it was.

    ``nis`` is the summed NIS in standard deviations, ``ratio`` its mean over its expectation, ``gated`` the share of
    gated exposures.
    """
    # Many judgements of a right model go beyond any limit in the end.
    often = math.sqrt(1 + 2 * math.log(max(1.0, compared / WINDOW)) / MOTION_OFF**2)
    pixels, motion = found.pixels / (PIXELS_OFF * often), max(found.motion, found.mean) / (MOTION_OFF * often)
    worst = max(pixels, motion, nis / (MOTION_OFF * often), gated / _GATED)
    fit = Fit.DOES_NOT_FIT if worst > 1 else Fit.FITS if worst < FITS else before.fit
    numbers = {"pixels": found.pixels, "motion": max(found.motion, found.mean), "nis": nis, "exposures": compared}
    if fit is not Fit.DOES_NOT_FIT:
        return Verdict(fit=fit, **numbers)  # type: ignore[arg-type]
    width, _, _, fade, ends = np.abs(found.signatures)
    if found.static > _STATIC or pixels >= max(motion, gated / _GATED):
        where = "everywhere in the spot"
        if found.static > _STATIC and found.alone > _ALONE:
            where = "at fixed places"
        elif width > PIXELS_OFF or found.static > _STATIC:
            where = "in a ring about the spot"
        elif max(fade, ends) > PIXELS_OFF:
            where = "at the ends of the blur"
    else:
        where = "to one side of the prediction" if found.mean > found.motion else "from exposure to exposure"
    widening = math.sqrt(min(max(found.squares, 1 + found.excess, ratio, 1.0), _WIDEST))
    return Verdict(fit=fit, where=where, widening=widening, **numbers)  # type: ignore[arg-type]


def widened(estimate: Estimate, verdict: Verdict) -> Estimate:
    """The estimate with a verdict; where the model does not fit, with wider intervals and the reason for them."""
    if verdict.fit is not Fit.DOES_NOT_FIT:
        return replace(estimate, verdict=verdict)
    square = verdict.widening**2
    alignment = estimate.alignment
    if alignment is not None:
        alignment = replace(
            alignment, coefficients=alignment.coefficients * verdict.widening,
            end_state=alignment.end_state * verdict.widening,
        )  # fmt: skip
    return replace(
        estimate, verdict=verdict, reason="; ".join(filter(None, [estimate.reason, verdict.text])),
        start_covariance=estimate.start_covariance * square, end_covariance=estimate.end_covariance * square,
        coefficient_covariance=estimate.coefficient_covariance * square, alignment=alignment,
    )  # fmt: skip
