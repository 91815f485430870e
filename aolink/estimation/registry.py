"""The estimators by name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from aolink.errors import EstimatorError
from aolink.estimation.batch import Block
from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.frames.measure import Measured, Measurements
from aolink.estimation.frames.moments import Flux
from aolink.estimation.kalman.filter import BlurFilter, Noise, Posterior, added_noise
from aolink.estimation.kalman.filterpy_engine import FilterpyMoments
from aolink.estimation.kalman.observation import Observation, PathMoments, steady_gain
from aolink.estimation.kalman.two_states import Run
from aolink.estimation.model.exposure_model import exposure_model
from aolink.estimation.moments.joint_moments import JointMoments
from aolink.estimation.moments.spots import SpotWindows, WindowedSpots
from aolink.estimation.moments.windowed import Basis, WindowedMoments
from aolink.estimation.options import Engine, Options
from aolink.estimation.pixels.joint_pixels import JointProfile
from aolink.exposure import Exposure
from aolink.optics.sensor import SpotSensor
from aolink.plant.alike import MANY_STATES, alike_systems
from aolink.rig import Rig

if TYPE_CHECKING:
    from aolink.estimation.pixels.filter import HypothesisFilter

FloatArray = NDArray[np.float64]

_PAPER_ORDERS: dict[str, tuple[int, ...]] = {"o1": (1,), "o2": (2,), "o3": (1, 2)}
_OF_PIXELS = ("profile", "mixture", "sampled")
ESTIMATOR_NAMES: tuple[str, ...] = ("open-loop", *_PAPER_ORDERS, "moments", *_OF_PIXELS)
"""The names that `make_estimator` knows."""

_HIGHEST_ORDER = 8
# Of one copy of the plant, by `moments`.
_MOST_SPOTS = 128


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
            self._filter = _of_pixels(rig, name, options)
        else:
            predict = self._observation.predict if isinstance(self._observation, FilterpyMoments) else None
            self._filter = BlurFilter(
                rig.plant, self._observation, process_noise=options.process_noise, gate=options.gate, predict=predict
            )
            if isinstance(self._observation, JointMoments | JointProfile):
                _warm_up(rig)
        self.several: NDArray[np.bool_] | None = None
        """Which axes of the last exposure have a blur of more than one reading; None of estimators that do not look."""
        self._next_step: int | None = None
        self._last_input = np.zeros(rig.n_inputs)

    def step(self, exposure: Exposure) -> Estimate:
        """The estimate of an exposure, from it and from all that came before."""
        (estimate,) = self.steps(Block(self.rig, [exposure]))
        return estimate

    def steps(self, block: Block) -> Iterator[Estimate]:
        """The estimates of exposures one after the other, to the same bits."""
        measured = Measurements(self.rig, block.exposures, self._observation, self.options)
        k = 0
        while k < len(block.exposures):
            done = self._run(block, measured, k)
            if done is None:
                yield self._stepped(block, k, measured[k])
                k += 1
                continue
            count = len(done.nis)
            last = block.exposures[k + count - 1]
            self._next_step, self._last_input = last.first_step + last.n_steps, last.inputs[-1]
            yield from self._believed(block, k, done)
            k += count

    def _run(self, block: Block, measured: Measurements, first: int) -> Run | None:
        """What the filter makes of exposures from ``first`` on between which there is no gap, and that have no flaw."""
        row, moments = measured.rows[first], measured.moments
        if not isinstance(self._filter, BlurFilter) or block.model is None or moments is None or row < 0:
            return None
        end, next_step = first, self._next_step
        for exposure in block.exposures[first:]:
            follows = next_step in (None, exposure.first_step) and not len(exposure.lead_inputs)
            if not (follows and block.finite[end] and measured.rows[end] == row + end - first):
                break
            end, next_step = end + 1, exposure.first_step + exposure.n_steps
        if end == first:
            return None
        axes = self.rig.plant.axes
        responses = block.responses.of(slice(first * axes, end * axes))
        return self._filter.run(block.model, responses, measured.some(row, row + end - first))

    def _believed(self, block: Block, first: int, done: Run) -> Iterator[Estimate]:
        """Estimates of a run of exposures."""
        assert block.model is not None
        exposures = block.exposures[first : first + len(done.nis)]
        for exposure, state, covariance, end, end_covariance, innovation, S, nis in zip(
            exposures, done.coefficients, done.covariance, done.end, done.end_covariance, done.innovation,
            done.innovation_covariance, done.nis, strict=True,
        ):  # fmt: skip
            yield Estimate(
                estimator=self.name,
                frame_id=exposure.frame_id,
                first_step=exposure.first_step,
                n_steps=exposure.n_steps,
                status=Status.OK,
                reason="",
                start_state=state,
                start_covariance=covariance,
                end_state=end,
                end_covariance=end_covariance,
                coefficients=state,
                coefficient_covariance=covariance,
                inputs=exposure.inputs,
                model=block.model,
                innovation=innovation,
                innovation_covariance=S,
                nis=nis,
            )

    def _stepped(self, block: Block, k: int, measured: Measured) -> Estimate:
        """The estimate of exposure k, whatever it is like."""
        exposure, model = block.exposures[k], block.model_of(k)
        reasons = self._bridge(exposure)
        taken, remark = measured
        posterior = self._filter.step(model, block.response_to(k), taken)  # type: ignore[arg-type] # it measured it
        self.several = posterior.several
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
    if name in _OF_PIXELS and partly_lit and not (name == "profile" and joint):
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


def _of_pixels(rig: Rig, name: str, options: Options) -> HypothesisFilter:
    """The filters of the pixels themselves; the code that they compile is loaded when one is wanted."""
    from aolink.estimation.pixels.filter import HypothesisFilter, Updates
    from aolink.estimation.pixels.sampled import SampledUpdates
    from aolink.estimation.pixels.updates import MIXTURE, PROFILE

    updates: Updates = SampledUpdates(options.particles, options.seed)
    if name != "sampled":
        updates = PROFILE if name == "profile" else MIXTURE
    pixels = HypothesisFilter(rig.plant, rig.sensor, updates, gate=options.gate)
    # What profile compiles when a blur has several readings, mixture does at once.
    pixels.warm_up(MIXTURE)
    updates.reduction(exposure_model(rig.plant, rig.timing.exposure_steps, rig.timing.exposure_offset), rig.sensor)
    return pixels


def _warm_up(rig: Rig) -> None:
    """Have a dark exposure of many spots estimated: what that compiles, a session need not wait for."""
    assert isinstance(rig.sensor, SpotSensor)
    steps = rig.timing.exposure_steps
    model = exposure_model(rig.plant, steps, rig.timing.exposure_offset)
    shape = (rig.plant.axes, rig.plant.n_outputs // 2, *rig.sensor.window)
    dark = SpotWindows(density=np.zeros(shape), mask=np.ones(shape, dtype=bool))
    for each in (JointMoments, JointProfile):
        blur_filter = BlurFilter(rig.plant, each(rig.sensor, rig.plant.n_outputs))
        blur_filter.step(model, model.response(np.zeros((steps, rig.n_inputs))), dark)


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
