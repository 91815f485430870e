"""The estimators by name, and the driver that live sessions, replays and batches share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from aolink.errors import EstimatorError
from aolink.estimation.centroids import centroid_covariance
from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.exposure_model import InputResponse, exposure_model
from aolink.estimation.filter import BlurFilter, Noise, Posterior, added_noise
from aolink.estimation.filterpy_engine import FilterpyMoments
from aolink.estimation.hypothesis_filter import HypothesisFilter, Updates
from aolink.estimation.joint_moments import JointMoments
from aolink.estimation.joint_profile import JointProfile
from aolink.estimation.mixture import MixtureUpdates
from aolink.estimation.moments import (
    Flux,
    Measurement,
    least_significance,
    measure_moments,
    spot_significance,
)
from aolink.estimation.observation import Observation, PathMoments, steady_gain
from aolink.estimation.profile import ProfileUpdates
from aolink.estimation.sampled import SampledUpdates
from aolink.estimation.spots import measure_spots
from aolink.estimation.windowed import Basis, Profile, WindowedMoments
from aolink.estimation.windowed_spots import SpotWindows, WindowedSpots
from aolink.exposure import Exposure
from aolink.optics.camera import is_saturated, to_density
from aolink.plant import MANY_STATES, alike_systems
from aolink.rig import Rig, Sensor, SpotSensor

FloatArray = NDArray[np.float64]
Engine = Literal["aolink", "filterpy"]

_PAPER_ORDERS: dict[str, tuple[int, ...]] = {"o1": (1,), "o2": (2,), "o3": (1, 2)}
_OF_PIXELS: dict[str, Callable[[Options], Updates]] = {
    "profile": lambda options: ProfileUpdates(),
    "mixture": lambda options: MixtureUpdates(),
    "sampled": lambda options: SampledUpdates(options.particles, options.seed),
}
ESTIMATOR_NAMES: tuple[str, ...] = ("open-loop", *_PAPER_ORDERS, "moments", *_OF_PIXELS)
"""The names that `make_estimator` knows."""

_HIGHEST_ORDER = 8
# Of one copy of the plant, by `moments`.
_MOST_SPOTS = 128
# Share of the pixels that `moments` can do with; and of the spots, where hundreds of states hang together.
_LEAST_USABLE = 0.5
# Exposures together, and numbers in them.
_AT_ONCE = 64
_NUMBERS_AT_ONCE = 1_000_000

Measured = tuple[Measurement | Profile | SpotWindows | None, str]
"""What an observation takes of an exposure, or nothing; and what there is to say about it."""


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
    engine: Engine = "aolink"
    """What o1 to o3 run on: "aolink", or "filterpy", for one axis."""
    orders: tuple[int, ...] = (0, 1, 2, 3)
    """Of `moments`: which functions of the basis; 0 is the light in the window."""
    basis: Basis = "monomial"
    """Of `moments`: "monomial", "legendre" or "fourier"."""
    particles: int = 3000
    """Of `sampled`."""
    seed: int = 0
    """Of `sampled`: the same one gives the same estimates, bit for bit."""


class Estimator:
    """One estimator on one rig: exposures in, estimates out, in the order in which they come.

    It has no clock and does no input or output: the same exposures give the same estimates, bit for bit.
    """

    def __init__(self, rig: Rig, name: str, options: Options) -> None:
        self.name = name
        self.rig = rig
        self.options = options
        if options.gain == "steady-state" and name == "o1" and _steady_gain(rig, options) is None:
            self.options = options = replace(options, gain="time-varying")
        self._observation = _observation(rig, name, options)
        self._filter: BlurFilter | HypothesisFilter
        if name in _OF_PIXELS and not isinstance(self._observation, JointProfile):
            self._filter = HypothesisFilter(rig.plant, rig.sensor, _OF_PIXELS[name](options), gate=options.gate)
        else:
            predict = self._observation.predict if isinstance(self._observation, FilterpyMoments) else None
            self._filter = BlurFilter(
                rig.plant, self._observation, process_noise=options.process_noise, gate=options.gate, predict=predict
            )
        self._next_step: int | None = None
        self._last_input = np.zeros(rig.n_inputs)

    def step(
        self, exposure: Exposure, response: InputResponse | None = None, measured: Measured | None = None
    ) -> Estimate:
        """The estimate of an exposure, from it and from all that came before.

        ``response``, to the exposure's inputs, and ``measured``, of `measure_all`, save computing them again.
        """
        model = exposure_model(self.rig.plant, exposure.n_steps, exposure.start_offset)
        reasons = self._bridge(exposure)
        response = response or model.response(exposure.inputs)
        taken, remark = measured or self.measure_all([exposure])[0]
        if isinstance(self._filter, HypothesisFilter):
            assert not isinstance(taken, Measurement)
            posterior = self._filter.step(model, response, taken)
        else:
            posterior = self._filter.step(model, response, taken)
        reasons = [*([remark] if remark else []), *reasons, *_told(posterior)]
        coefficients, covariance = posterior.coefficients.mean, posterior.coefficients.covariance
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
            inputs=exposure.inputs,
            model=model,
            innovation=posterior.innovation,
            innovation_covariance=posterior.innovation_covariance,
            nis=posterior.nis,
        )

    def measure_all(self, exposures: Sequence[Exposure]) -> list[Measured]:
        """What it takes of each exposure; it does not matter what came before."""
        return measure_all(self.rig, exposures, self._observation, self.options)

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


def measure_all(
    rig: Rig, exposures: Sequence[Exposure], observation: Observation[Any] | None, options: Options
) -> list[Measured]:
    """`measure` of many exposures, each to the same bits: line-sensor frames without a flaw all at once."""
    sensor, found = rig.sensor, dict[int, Measured]()
    many = len(exposures) > 1 and sensor.shape[0] == 1
    if many and isinstance(sensor, Sensor) and isinstance(observation, PathMoments):
        whole = [k for k, each in enumerate(exposures) if each.pixels.shape == sensor.shape and each.complete]
        pixels = np.concatenate([np.empty(sensor.shape, np.uint16)[:0], *(exposures[k].pixels for k in whole)])
        lit = spot_significance(sensor, to_density(sensor, pixels)) >= least_significance(sensor)
        good = np.flatnonzero(lit & ~is_saturated(sensor, pixels).any(axis=1))
        moments = measure_moments(sensor, pixels[good], observation.orders, options.flux) if len(good) else ""
        if not isinstance(moments, str):
            for i, k in enumerate(good):
                own = Measurement(value=moments.value[i : i + 1], covariance=moments.covariance[i : i + 1])
                found[whole[k]] = (own, "")
    return [found.get(k) or measure(rig, each, observation, options) for k, each in enumerate(exposures)]


def measure(rig: Rig, exposure: Exposure, observation: Observation[Any] | None, options: Options) -> Measured:
    """What an observation takes of an exposure, or nothing; and what there is to say about it."""
    if observation is None:
        return None, ""
    sensor, pixels = rig.sensor, exposure.pixels
    if pixels.shape != sensor.shape:
        return None, f"the frame has {pixels.shape} pixels, the rig's sensor {sensor.shape}"
    if isinstance(sensor, SpotSensor):
        orders = observation.orders if isinstance(observation, PathMoments) else None
        return measure_spots(
            sensor, rig.plant, pixels, exposure.mask, orders, options.flux,
            least_usable=_LEAST_USABLE, least_significance=_least_significance(sensor),
            least_spots=_LEAST_USABLE if isinstance(observation, JointMoments | JointProfile) else 1.0,
        )  # fmt: skip
    sensor = sensor.profile
    saturated = is_saturated(sensor, pixels) & exposure.mask
    usable = exposure.mask & ~saturated
    remark = ""
    if not usable.all():
        remark = f"{int((~exposure.mask).sum())} of {pixels.size} pixels are missing"
        if saturated.any():
            remark = f"{int(saturated.sum())} of {pixels.size} pixels are at an end of the scale"
        if isinstance(observation, PathMoments) or usable.sum() < _LEAST_USABLE * pixels.size:
            return None, remark
        remark += ": left out"
    density = np.where(usable, to_density(sensor, pixels), 0.0)
    significance = spot_significance(sensor, density)[0]
    if significance < least_significance(sensor):
        return None, f"no spot: the brightest stretch is {significance:.1f} standard deviations of noise"
    rows = (rig.plant.axes, -1)
    if not isinstance(observation, PathMoments):
        return Profile(density=density.reshape(rows), mask=usable.reshape(rows)), remark
    moments = measure_moments(sensor, pixels.reshape(rows), observation.orders, options.flux)
    return (None, moments) if isinstance(moments, str) else (moments, "")


def _least_significance(sensor: SpotSensor) -> FloatArray:
    """`least_significance` of each profile, (n_outputs,), or of all."""
    light = 1.0 if sensor.spot_light is None else np.repeat(sensor.spot_light, 2)
    return least_significance(sensor.profile, light)


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
    if name not in ESTIMATOR_NAMES:
        raise EstimatorError(f"there is no estimator {name!r}: use one of {', '.join(ESTIMATOR_NAMES)}")
    known = Options.__dataclass_fields__
    for key in options:
        if key not in known:
            raise EstimatorError(f"estimators have no option {key!r}: use {', '.join(known)}")
    chosen = Options(**options)
    choices = {
        "gain": ("steady-state", "time-varying"),
        "process_noise": get_args(Noise),
        "flux": get_args(Flux),
        "basis": get_args(Basis),
        "engine": get_args(Engine),
    }
    for key, values in choices.items():
        if getattr(chosen, key) not in values:
            raise EstimatorError(f"{key} = {getattr(chosen, key)!r} is not known: use one of {', '.join(values)}")
    orders = tuple(chosen.orders)
    if len(set(orders)) < len(orders) or not any(orders) or not set(orders) <= set(range(_HIGHEST_ORDER + 1)):
        raise EstimatorError(f"orders = {orders}: use different ones from 0 to {_HIGHEST_ORDER}, not 0 alone")
    joint = alike_systems(rig.plant) is not None
    if name in _OF_PIXELS and rig.plant.n_states > MANY_STATES and not (name == "profile" and joint):
        alike = "" if name != "profile" else " that is not of alike systems side by side"
        raise EstimatorError(
            f"{name} follows the readings of a blur for at most {MANY_STATES} states of one plant, {rig.name} has"
            f" {rig.plant.n_states}{alike}: use {'o3' if alike else 'profile or moments'}"
        )
    partly_lit = isinstance(rig.sensor, SpotSensor) and rig.sensor.spot_light is not None
    if name in _OF_PIXELS and partly_lit and not joint:
        raise EstimatorError(
            f"{name} takes each spot to have the whole light, but {rig.name} has partly lit lenslets: use moments or o3"
        )
    if chosen.engine == "filterpy" and (name not in _PAPER_ORDERS or rig.plant.axes != 1):
        raise EstimatorError(
            f"engine 'filterpy' runs {', '.join(_PAPER_ORDERS)} on a plant of one axis, this is {name} with"
            f" plant.axes = {rig.plant.axes}: use engine 'aolink'"
        )
    if name == "moments" and rig.plant.n_outputs > 2 * _MOST_SPOTS and not joint:
        raise EstimatorError(
            f"moments looks at each two spots that one plant moves together: at most {_MOST_SPOTS},"
            f" {rig.name} has {rig.plant.n_outputs // 2}; use o3"
        )
    return Estimator(rig, name, chosen)


class Driver:
    """Several estimators side by side, exposure by exposure, on one engine."""

    def __init__(self, rig: Rig, names: Sequence[str], engine: Engine = "aolink") -> None:
        self.rig = rig
        self.estimators = [make_estimator(rig, name, engine=engine) for name in names]

    def step(self, exposure: Exposure) -> list[Estimate]:
        """What each of them says about an exposure, in the order of the names."""
        model = exposure_model(self.rig.plant, exposure.n_steps, exposure.start_offset)
        response = model.response(exposure.inputs)
        return [estimator.step(exposure, response) for estimator in self.estimators]

    def steps(self, exposures: Iterable[Exposure]) -> Iterator[tuple[Exposure, list[Estimate]]]:
        """The same for a series, to the same bits; what knows no recursion is done for many exposures at once."""
        for some in _batches(exposures):
            models = {(each.n_steps, each.start_offset) for each in some}
            responses: Sequence[InputResponse | None] = [None] * len(some)
            if len(models) == 1:
                responses = exposure_model(self.rig.plant, *models.pop()).responses([each.inputs for each in some])
            measured = [estimator.measure_all(some) for estimator in self.estimators]
            for k, exposure in enumerate(some):
                each = zip(self.estimators, measured, strict=True)
                yield exposure, [estimator.step(exposure, responses[k], own[k]) for estimator, own in each]


def run(rig: Rig, exposures: Iterable[Exposure], names: Sequence[str]) -> dict[str, list[Estimate]]:
    """Estimates of a series of exposures, by the estimators' names."""
    driver = Driver(rig, names)
    estimates: dict[str, list[Estimate]] = {name: [] for name in names}
    for _, each in driver.steps(exposures):
        for estimate in each:
            estimates[estimate.estimator].append(estimate)
    return estimates


def _batches(exposures: Iterable[Exposure]) -> Iterator[list[Exposure]]:
    """Some exposures at a time, a few megabytes of them."""
    batch: list[Exposure] = []
    for exposure in exposures:
        batch.append(exposure)
        if len(batch) >= min(_AT_ONCE, _NUMBERS_AT_ONCE // (1 + exposure.inputs.size + exposure.pixels.size)):
            yield batch
            batch = []
    if batch:
        yield batch


def _observation(rig: Rig, name: str, options: Options) -> Observation[Any] | None:
    if name == "open-loop":
        return None
    if name in _PAPER_ORDERS:
        gain = _steady_gain(rig, options) if name == "o1" and options.gain == "steady-state" else None
        engine = FilterpyMoments if options.engine == "filterpy" else PathMoments
        return engine(rig.plant.n_outputs, _PAPER_ORDERS[name], gain)
    if rig.plant.n_outputs > 1:
        assert isinstance(rig.sensor, SpotSensor)
        spots = rig.plant.n_outputs // 2
        if alike_systems(rig.plant) is not None:
            if name == "profile":
                return JointProfile(rig.sensor, rig.plant.n_outputs)
            of = options.orders, options.basis, options.flux
            return JointMoments(rig.sensor, rig.plant.n_outputs, of[0], basis=of[1], flux=of[2])
        return WindowedSpots(rig.sensor, spots, options.orders, basis=options.basis, flux=options.flux)
    return WindowedMoments(rig.sensor.profile, options.orders, basis=options.basis, flux=options.flux)


@lru_cache(maxsize=4)
def _steady_gain(rig: Rig, options: Options) -> FloatArray | None:
    """The gain of o1 with the noise that a frame has by the rig file, of all axes or of each; None if there is none."""
    model = exposure_model(rig.plant, rig.timing.exposure_steps, rig.timing.exposure_offset)
    Q = added_noise(model, options.process_noise)
    # Axes whose spots have as much light share a gain.
    noises, of_axis = np.unique(centroid_covariance(rig), axis=0, return_inverse=True)
    gains = [steady_gain(model, Q, noise) for noise in noises]
    if len(gains) == 1:
        return gains[0]
    known = [gain for gain in gains if gain is not None]
    return np.array(known)[of_axis] if len(known) == len(gains) else None


# From good to bad; the worst of all axes is the estimate's status.
_BY_GRAVITY = (Status.PREDICTED, Status.OK, Status.REINITIALISED, Status.GATED, Status.DIVERGED, Status.INPUT_INVALID)


def _worst(status: NDArray[np.int64]) -> Status:
    counts = np.bincount(status)
    return max((Status(int(s)) for s in np.flatnonzero(counts)), key=_BY_GRAVITY.index)


def _told(posterior: Posterior) -> list[str]:
    """What the statuses of the axes say, in words."""
    words = {
        Status.GATED: "too far from the prediction, not used",
        Status.DIVERGED: "too far from the prediction several times in a row: it starts again",
        Status.REINITIALISED: "started again from the plant's prior",
    }
    counts = np.bincount(posterior.status, minlength=len(Status))
    axes = len(posterior.status)
    told = []
    for status, text in words.items():
        if counts[status]:
            nis = f"NIS {posterior.nis[posterior.status == status].max():.3g}"
            told.append(f"{nis}, {text}" if axes == 1 else f"{counts[status]} of {axes} axes: {nis}, {text}")
    if posterior.several is not None and posterior.several.any():
        of = "" if axes == 1 else f"{int(posterior.several.sum())} of {axes} axes: "
        told.append(f"{of}the blur has more than one reading")
    return told
