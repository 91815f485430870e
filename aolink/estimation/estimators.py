"""The estimators by name, and the driver that live sessions, replays and batches share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from aolink.errors import EstimatorError
from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.exposure_model import ExposureModel, exposure_model
from aolink.estimation.filter import BlurFilter, Noise, Posterior, added_noise, steady_gain
from aolink.estimation.moments import (
    Flux,
    Measurement,
    known_flux_covariance,
    measure_moments,
    noise_integrals,
    spot_significance,
)
from aolink.exposure import Exposure
from aolink.optics.camera import effective_noise_density, is_saturated
from aolink.rig import Rig

FloatArray = NDArray[np.float64]

_ORDERS: dict[str, tuple[int, ...]] = {"open-loop": (), "o1": (1,), "o2": (2,), "o3": (1, 2)}
ESTIMATOR_NAMES: tuple[str, ...] = tuple(_ORDERS)
"""The names that `make_estimator` knows."""

# A frame without a spot reaches this about once in thirty.
_LEAST_SIGNIFICANCE = 4.0


@dataclass(frozen=True)
class Options:
    """Choices that the paper leaves open."""

    gain: str = "steady-state"
    """Of o1: "steady-state", or "time-varying", which a plant without a steady-state gain always gets."""
    process_noise: Noise = "lifted"
    """Noise that an exposure adds to the state: "lifted", or "printed" for the paper's B_w W B_w'."""
    flux: Flux = "known"
    """"known": the light of a frame sums to one; "measured": moments are divided by what it sums to."""
    gate: bool = True
    """Whether measurements that cannot be believed are left out."""


class Estimator:
    """One estimator on one rig: exposures in, estimates out, in the order in which they come.

    It has no clock and does no input or output: the same exposures give the same estimates, bit for bit.
    """

    def __init__(self, rig: Rig, name: str, options: Options) -> None:
        self.name = name
        self.rig = rig
        self.options = options
        model = exposure_model(rig.plant, rig.timing.exposure_steps)
        orders = _ORDERS[name]
        gain = None
        if name == "o1" and options.gain == "steady-state":
            gain = _steady_gain(rig, model, options)
            if gain is None:
                self.options = replace(options, gain="time-varying")
        self._filter = BlurFilter(rig.plant, orders, process_noise=options.process_noise, gain=gain, gate=options.gate)
        self._next_step: int | None = None
        self._last_input = np.zeros(rig.n_inputs)

    def step(self, exposure: Exposure) -> Estimate:
        """The estimate of an exposure, from it and from all that came before."""
        model = exposure_model(self.rig.plant, exposure.n_steps)
        reasons = self._bridge(exposure)
        response = model.response(exposure.inputs)
        measurement: Measurement | str | None = None
        if self._filter.orders:
            measurement = measure(self.rig, exposure, self._filter.orders, self.options.flux)
        if isinstance(measurement, str):
            reasons.insert(0, measurement)
            measurement = None
        posterior = self._filter.step(model, response, measurement)
        reasons += _told(posterior)
        coefficients, covariance = self._coefficients(model, posterior)
        shape = (self.rig.n_outputs, exposure.n_steps)
        return Estimate(
            estimator=self.name,
            frame_id=exposure.frame_id,
            first_step=exposure.first_step,
            n_steps=exposure.n_steps,
            status=_worst(posterior.status),
            reason="; ".join(reasons),
            start_state=posterior.start.mean,
            start_covariance=posterior.start.covariance,
            end_state=posterior.end.mean,
            end_covariance=posterior.end.covariance,
            coefficients=coefficients,
            coefficient_covariance=covariance,
            path=model.path(coefficients, response.path).reshape(shape),
            path_sd=model.path_sd(covariance).reshape(shape),
            innovation=posterior.innovation,
            innovation_covariance=posterior.innovation_covariance,
            nis=posterior.nis,
        )

    def _bridge(self, exposure: Exposure) -> list[str]:
        """Predict to the start of an exposure; what there is to say about it."""
        lead, reasons = exposure.lead_inputs, []
        gap = len(lead) if self._next_step is None else exposure.first_step - self._next_step
        if gap < 0:
            reasons.append(f"it starts at step {exposure.first_step}, before {self._next_step}: taken as the next")
            gap = 0
        elif gap > len(lead):
            reasons.append(f"inputs of {gap - len(lead)} of the {gap} steps before it are not known: held")
            lead = np.concatenate([np.tile(self._last_input, (gap - len(lead), 1)), lead])
        self._filter.bridge(lead[len(lead) - gap :])
        if not (np.isfinite(exposure.inputs).all() and np.isfinite(lead).all()):
            reasons.append("an input is not a number: taken as zero")
        self._next_step = exposure.first_step + exposure.n_steps
        self._last_input = exposure.inputs[-1]
        return reasons

    def _coefficients(self, model: ExposureModel, posterior: Posterior) -> tuple[FloatArray, FloatArray]:
        """The path's coefficients. Those who look leave the noise inside the exposure out, as the paper does."""
        mean, covariance = posterior.start.mean, posterior.start.covariance
        if self._filter.orders:
            return mean, covariance
        axes, n = mean.shape
        whole = np.zeros((axes, model.n_coefficients))
        whole[:, :n] = mean
        spread = np.zeros((axes, model.n_coefficients, model.n_coefficients))
        spread[:] = np.eye(model.n_coefficients)
        spread[:, :n, :n] = covariance
        return whole, spread


def measure(rig: Rig, exposure: Exposure, orders: Sequence[int], flux: Flux) -> Measurement | str:
    """The moments of an exposure, or why it has none."""
    sensor = rig.sensor
    if exposure.pixels.shape != sensor.shape:
        return f"the frame has {exposure.pixels.shape} pixels, the rig's sensor {sensor.shape}"
    if not exposure.complete:
        return f"{int((~exposure.mask).sum())} of {exposure.mask.size} pixels are missing"
    saturated = int(is_saturated(sensor, exposure.pixels).sum())
    if saturated:
        return f"{saturated} pixels are at an end of the scale"
    significance = spot_significance(sensor, exposure.pixels)
    if significance < _LEAST_SIGNIFICANCE:
        return f"no spot: the brightest stretch is {significance:.1f} standard deviations of noise"
    return measure_moments(sensor, exposure.pixels.reshape(rig.plant.axes, -1), orders, flux)


def make_estimator(rig: Rig, name: str, **options: Any) -> Estimator:
    """An estimator by its name.

    Parameters
    ----------
    name:
        One of `ESTIMATOR_NAMES`.
    options:
        Fields of `Options`.

    Raises
    ------
    EstimatorError
        There is no such estimator or option, or it cannot work on this rig.
    """
    if name not in _ORDERS:
        raise EstimatorError(f"there is no estimator {name!r}: use one of {', '.join(ESTIMATOR_NAMES)}")
    known = Options.__dataclass_fields__
    for key in options:
        if key not in known:
            raise EstimatorError(f"estimators have no option {key!r}: use {', '.join(known)}")
    chosen = Options(**options)
    choices = {"gain": ("steady-state", "time-varying"), "process_noise": get_args(Noise), "flux": get_args(Flux)}
    for key, values in choices.items():
        if getattr(chosen, key) not in values:
            raise EstimatorError(f"{key} = {getattr(chosen, key)!r} is not known: use one of {', '.join(values)}")
    return Estimator(rig, name, chosen)


class Driver:
    """Several estimators side by side, exposure by exposure."""

    def __init__(self, rig: Rig, names: Sequence[str]) -> None:
        self.estimators = [make_estimator(rig, name) for name in names]

    def step(self, exposure: Exposure) -> list[Estimate]:
        """What each of them says about an exposure, in the order of the names."""
        return [estimator.step(exposure) for estimator in self.estimators]


def run(rig: Rig, exposures: Iterable[Exposure], names: Sequence[str]) -> dict[str, list[Estimate]]:
    """Estimates of a series of exposures, by the estimators' names."""
    driver = Driver(rig, names)
    estimates: dict[str, list[Estimate]] = {name: [] for name in names}
    for exposure in exposures:
        for estimate in driver.step(exposure):
            estimates[estimate.estimator].append(estimate)
    return estimates


def _steady_gain(rig: Rig, model: ExposureModel, options: Options) -> FloatArray | None:
    """The gain of o1 with the noise that a frame has by the rig file; None where there is none."""
    integrals = noise_integrals(rig.sensor, 2)
    noise = known_flux_covariance(effective_noise_density(rig.sensor), integrals, [1])
    return steady_gain(model, added_noise(model, options.process_noise), noise)


# From good to bad; the worst of all axes is the estimate's status.
_BY_GRAVITY = (Status.PREDICTED, Status.OK, Status.REINITIALISED, Status.GATED, Status.DIVERGED, Status.INPUT_INVALID)


def _worst(status: NDArray[np.int64]) -> Status:
    return max((Status(int(s)) for s in np.unique(status)), key=_BY_GRAVITY.index)


def _told(posterior: Posterior) -> list[str]:
    """What the statuses of the axes say, in words."""
    words = {
        Status.GATED: "too far from the prediction, not used",
        Status.DIVERGED: "too far from the prediction several times in a row: it starts again",
        Status.REINITIALISED: "started again from the plant's prior",
    }
    counts = Counter(Status(int(s)) for s in posterior.status)
    axes = len(posterior.status)
    told = []
    for status, text in words.items():
        if counts[status]:
            nis = f"NIS {posterior.nis[posterior.status == status].max():.3g}"
            told.append(f"{nis}, {text}" if axes == 1 else f"{counts[status]} of {axes} axes: {nis}, {text}")
    return told
