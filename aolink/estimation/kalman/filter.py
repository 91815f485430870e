"""The recursion of the Kalman filters from exposure to exposure: it takes measurements and gives states. It knows no
pixels and no clock."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from aolink.estimation.estimate import Status
from aolink.estimation.frames.frame_data import Measurement, Needs
from aolink.estimation.kalman.gaussian import MOST_COVARIANCES, Gaussian, Update
from aolink.estimation.kalman.path_moments import MOST_OUTPUTS, Observation, PathMoments
from aolink.estimation.kalman.predict import Predict, predict, predicted_mean
from aolink.estimation.model.base import ExposureModel, InputResponse, over_steps
from aolink.numerics import batched
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray
from aolink.plant.alike import MANY_STATES
from aolink.rig import Plant

if TYPE_CHECKING:
    from aolink.estimation.compiled.kalman import Step

# A measurement with a smaller chi-square tail probability than this is not used. The gate is wide: the paper's filters
# leave the process noise inside an exposure out, so their innovations may be larger than they expect.
GATE_PROBABILITY = 1e-9
PATIENCE = 3
"""After this many gated measurements in a row a filter starts again from the prediction without any measurement."""
MOST_WIDER = 1e4
"""NIS, over its expectation, of an axis's first measurement up to which that widens the prior: what is further away is
no motion of the plant."""
# Relative change of a covariance that counts as rounding.
_SETTLED = 1e-13


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior:
    """The posterior of one exposure, and the use of its measurement."""

    coefficients: Gaussian
    """Coefficients of the exposure basis; the start state comes first."""
    end: Gaussian
    status: IntArray
    """`Status` of each axis, (axes,)."""
    innovation: FloatArray
    """(axes, n_measurements)"""
    innovation_covariance: FloatArray
    """(axes, n_measurements, n_measurements), or its diagonal for many measurements, (axes, n_measurements)."""
    nis: FloatArray
    """(axes,)"""
    is_multimodal: BoolArray | None = None
    """Whether several modes of the posterior were found (more than one path explains the blur), (axes,); None where
    they are not searched for."""
    remark: str = ""
    """A note for the estimate's reason about unusual steps of the filter on some axes; otherwise empty."""
    residual: FloatArray | None = None
    """The pixels' chi-square at the most likely path, with what that takes of it given back, and the number of pixels
    that it should be, (axes, 2), zero without a measurement; None where no path was fitted to pixels."""
    log_evidence: FloatArray | None = None
    """Log-likelihood of the measurement, up to a constant that is the same for all plants and cameras, (axes,), NaN
    without a measurement; None where it follows from innovation and covariance."""

    @property
    def start(self) -> Gaussian:
        """The state at the exposure's first fast step."""
        n = self.end.mean.shape[1]
        return Gaussian(self.coefficients.mean[:, :n], self.coefficients.covariance[:, :n, :n])


class Filter(ABC):
    """A recursive filter for one rig: it takes the measurements of each exposure and gives its posterior."""

    @property
    @abstractmethod
    def needs(self) -> Needs | None:
        """The measurements that it needs of each frame; None if it takes none."""

    @property
    def orders(self) -> IntArray:
        """Orders of the moments of a spot that it measures, (n_measurements,); none where it measures no such."""
        return np.zeros(0, dtype=np.int64)

    @abstractmethod
    def bridge(self, inputs: FloatArray) -> None:
        """Predict over fast steps that no exposure covers, with their inputs, (k, axes * n_inputs)."""

    @abstractmethod
    def step(self, model: ExposureModel, response: InputResponse, measured: Any | None) -> Posterior:
        """Predict over one exposure and update with its measurements; only predict where these are None."""

    def run(self, model: ExposureModel, responses: InputResponse, measured: Measurement) -> list[Posterior] | None:
        """The posteriors of `step` for exposures without a gap between them, at once where the filter can do so;
        otherwise None. ``responses`` and ``measured`` have a row for each axis of the first exposure, then of the
        second."""
        return None


class BlurFilter(Filter):
    """State and prior of all axes, carried from exposure to exposure.

    Timing: an exposure's measurement corrects the state at its start; the state at its end is the
    prediction through the exposure, and is where the next one begins.

    Parameters
    ----------
    observation:
        The measurement of an exposure, and the update with it; None for prediction only.
    gate:
        Whether measurements that are too far from their prediction are left out.
    predictor:
        Another engine's prediction instead of `predict`.
    """

    def __init__(
        self, plant: Plant, observation: Observation[Any] | None, *, gate: bool = True,
        predictor: Predict | None = None,
    ) -> None:  # fmt: skip
        self.plant, self.observation = plant, observation
        self._predict = predictor or predict
        prior = self.prior = Gaussian(
            batched.tile(plant.initial_mean, plant.axes), batched.tile(plant.initial_covariance, plant.axes)
        )
        """The state after the last exposure or bridge: the next exposure starts there."""
        # The prediction without any measurement; its covariance is that of every axis, (1, n_states, n_states).
        self._from_model_only = Gaussian(prior.mean, prior.covariance[:1])
        # The transition that no longer changes that covariance; None until it has settled.
        self._settled_under: FloatArray | None = None
        self._missed = np.zeros(plant.axes, dtype=np.int64)
        self._begun = np.zeros(plant.axes, dtype=bool)
        degrees = observation.n_measurements if observation else 0
        self._of_model: tuple[ExposureModel, Step] | None = None
        self._gate = 2 * float(special.gammainccinv(degrees / 2, GATE_PROBABILITY)) if gate and degrees else np.inf

    @property
    def needs(self) -> Needs | None:
        return self.observation.needs if self.observation else None

    @property
    def orders(self) -> IntArray:
        return np.asarray(getattr(self.observation, "moment_orders", ()), dtype=np.int64)

    def bridge(self, inputs: FloatArray) -> None:
        if len(inputs):
            over = over_steps(self.plant, inputs)
            self.prior = self._predict(self.prior, *over)
            self._predict_from_model_only(*over)

    def step(self, model: ExposureModel, response: InputResponse, measured: Any | None) -> Posterior:
        axes, observation = self.plant.axes, self.observation
        lost = self._missed >= PATIENCE
        prior = _where(lost, self._from_model_only, self.prior)
        with_noise = observation is None or observation.models_noise
        if with_noise:
            prior = prior.with_noise(model.n_coefficients)
        if measured is None or observation is None:
            done = Update(prior, np.zeros((axes, 0)), np.zeros((axes, 0, 0)), np.zeros(axes))
            status = np.full(axes, Status.PREDICTED if observation is None else Status.INPUT_INVALID, dtype=np.int64)
            coefficients = prior
        else:
            done = _without(observation.update(model, response, prior, measured), measured.usable)
            wide = starts_wider(~self._begun, _gated(done), self._gate, observation.n_measurements)
            if wide is not None:
                prior = _scaled(prior, wide, model.plant.n_states)
                done = _without(observation.update(model, response, prior, measured), measured.usable)
            coefficients, status = self._trusted(prior, done, lost, measured.usable)
        if with_noise:
            self.prior = predict(coefficients, model.end_rows, model.end_remainder, response.end)
        else:
            self.prior = self._predict(coefficients, model.transition, model.process_noise, response.end)
        self._predict_from_model_only(model.transition, model.process_noise, response.end)
        return Posterior(
            coefficients=coefficients, end=self.prior, status=status, innovation=_numbers(done.innovation),
            innovation_covariance=_numbers(_kept(done.innovation_covariance)), nis=_numbers(done.nis),
        )  # fmt: skip

    def _predict_from_model_only(self, transition: FloatArray, noise: FloatArray, kick: FloatArray) -> None:
        """Predict `_from_model_only`; a covariance that has settled is not computed again."""
        before = self._from_model_only
        if transition is self._settled_under:
            self._from_model_only = Gaussian(predicted_mean(before.mean, transition, kick), before.covariance)
            return
        self._from_model_only = after = predict(before, transition, noise, kick)
        change = np.abs(after.covariance - before.covariance).max()
        settled = change <= _SETTLED * np.abs(before.covariance).max()
        self._settled_under = transition if settled else None

    def _trusted(
        self, prior: Gaussian, done: Update, lost: BoolArray, usable: BoolArray | None
    ) -> tuple[Gaussian, IntArray]:
        """The updated Gaussian where it is finite and not gated, otherwise the prior; and the status of each axis."""
        after = done.posterior
        used = _gated(done) <= self._gate
        # Sums are finite where all is; those that overflow are checked again, axis by axis.
        if not (_has_finite_sum(after.mean) and _has_finite_sum(after.covariance)):
            used &= np.isfinite(after.mean).all(axis=1) & np.isfinite(after.covariance).all(axis=(1, 2))
        self._begun |= used if usable is None else used & usable
        if usable is None and used.all() and not self._missed.any():
            return after, np.full(len(used), int(Status.OK), dtype=np.int64)
        status, missed = gate_status(used, lost, self._missed)
        if usable is not None:
            used &= usable
            status[~usable] = Status.INPUT_INVALID
            missed = np.where(usable, missed, self._missed)
        self._missed = missed
        return _where(~used, prior, after), status


def starts_wider(first: BoolArray, gate: FloatArray, limit: float, degrees: int) -> FloatArray | None:
    """How many times as large the prior's covariance is to be where the first measurement of an axis is beyond the
    gate, (axes,): the plant moved before the session, which its prior does not know. None where none is."""
    wide = first & (gate > limit) & (gate < MOST_WIDER * degrees)
    return np.where(wide, gate / degrees, 1.0) if wide.any() else None


def _gated(done: Update) -> FloatArray:
    """What the gate compares."""
    return done.nis if done.gate is None else done.gate


def _scaled(prior: Gaussian, factor: FloatArray, n: int) -> Gaussian:
    """The prior with the covariance of its first n coefficients times a factor, (axes,)."""
    covariance = np.array(np.broadcast_to(prior.covariance, (len(factor), *prior.covariance.shape[1:])))
    covariance[:, :n, :n] *= factor[:, None, None]
    return Gaussian(prior.mean, covariance)


def gate_status(used: BoolArray, lost: BoolArray, missed: IntArray) -> tuple[IntArray, IntArray]:
    """The `Status` of measured axes, and how many of their measurements in a row were gated, all (axes,).

    ``used`` says whether the measurement passed the gate, ``lost`` whether enough of those before it were gated for the
    filter to start again; ``missed`` counts the measurements in a row before it that were gated.
    """
    now = np.where(used, 0, np.where(lost, 1, missed + 1))
    return _status(used, lost, now), now


def _status(used: BoolArray, again: BoolArray, missed: IntArray) -> IntArray:
    if used.all() and not again.any():
        return np.full(used.shape, int(Status.OK), dtype=np.int64)
    passed = np.where(again, Status.REINITIALISED, Status.OK)
    refused = np.where(missed >= PATIENCE, Status.DIVERGED, Status.GATED)
    return np.where(used, passed, refused).astype(np.int64)


class PathFilter(BlurFilter):
    """The paper's filters for plants of few states and one or two outputs: a series of exposures is one compiled loop,
    and one exposure a series of one."""

    observation: PathMoments

    @staticmethod
    def suits(plant: Plant) -> bool:
        """Whether a plant is of this size."""
        return plant.n_outputs <= MOST_OUTPUTS and plant.n_states <= MANY_STATES

    def warm_up(self, model: ExposureModel) -> None:
        """Load the loop, or compile it, before the session."""
        m = self.observation.n_measurements
        nothing = Measurement(value=np.zeros((0, m)), covariance=np.zeros((0, m, m)))
        response = model.response(np.zeros((model.n_steps, self.plant.axes * self.plant.n_inputs)))
        self.run(model, response.of(slice(0)), nothing)

    def step(self, model: ExposureModel, response: InputResponse, measured: Measurement | None) -> Posterior:
        if measured is not None:
            return self.run(model, response, measured)[0]
        axes, m = self.plant.axes, self.observation.n_measurements
        nothing = np.zeros(axes, dtype=bool)
        blank = Measurement(value=np.zeros((axes, m)), covariance=np.zeros((axes, m, m)), usable=nothing)
        (posterior,) = self.run(model, response, blank)
        return replace(posterior, innovation=np.zeros((axes, 0)), innovation_covariance=np.zeros((axes, 0, 0)))

    def run(self, model: ExposureModel, responses: InputResponse, measured: Measurement) -> list[Posterior]:
        from aolink.estimation.compiled import kalman  # not before an estimator needs it

        axes, rows, m = self.plant.axes, *measured.value.shape
        usable = np.ones(rows, dtype=bool) if measured.usable is None else measured.usable
        noise = np.broadcast_to(measured.single_block, (rows, m, m))
        series = (responses.mean, responses.slope, responses.square, responses.end, measured.value, noise, usable)
        covariance = np.broadcast_to(self.prior.covariance, (axes, *self.prior.covariance.shape[1:]))
        model_only = self._from_model_only
        before = (
            self.prior.mean, covariance, model_only.mean, model_only.covariance[0], self._missed, self._begun
        )  # fmt: skip
        carried = kalman.Carried(*(np.array(each, order="C") for each in before))  # they are changed
        n = carried.mean.shape[1]
        shapes = ((n,), (n, n), (n,), (n, n), (m,), (m, m), ())
        flags = (np.empty(rows, dtype=kind) for kind in (bool, bool, np.int64))
        out = kalman.Filtered(*(np.empty((rows, *shape)) for shape in shapes), *flags)
        kalman.filter_series(self._step_of(model), kalman.Series(*map(_own, series)), carried, out)
        self.prior = Gaussian(carried.mean, carried.covariance)
        self._missed, self._begun = carried.missed, carried.begun
        self._from_model_only = Gaussian(carried.model_only_mean, carried.model_only_covariance[None])
        status = np.where(usable, _status(out.used, out.again, out.missed), Status.INPUT_INVALID)
        innovation, spread, nis = map(_numbers, (out.innovation, out.innovation_covariance, out.nis))
        return [
            Posterior(
                coefficients=Gaussian(out.mean[some], out.covariance[some]),
                end=Gaussian(out.end_mean[some], out.end_covariance[some]),
                status=status[some],
                innovation=innovation[some],
                innovation_covariance=spread[some],
                nis=nis[some],
            )
            for some in (slice(k, k + axes) for k in range(0, rows, axes))
        ]

    def _step_of(self, model: ExposureModel) -> Step:
        if self._of_model is None or self._of_model[0] is not model:
            from aolink.estimation.compiled.kalman import Step

            observation, n = self.observation, self.plant.n_states
            gains = np.zeros((0, n, observation.n_measurements)) if observation.gain is None else observation.gain
            self._of_model = model, Step(
                transition=_own(model.transition), noise=_own(model.process_noise),
                mean_row=_own(model.mean_row), quadratic=_own(model.quadratic), first=1 in observation.orders,
                second=2 in observation.orders, second_order=observation.second_order,
                gains=_own(gains.reshape(-1, n, observation.n_measurements)), gate=self._gate, patience=PATIENCE,
                most_wider=MOST_WIDER,
            )  # fmt: skip
        return self._of_model[1]


def _own(values: NDArray[Any]) -> NDArray[Any]:
    """The array as compiled code takes it: contiguous and writeable, if need be a copy."""
    own = values.flags.c_contiguous and values.flags.writeable
    return values if own else np.array(values, order="C")


def _without(done: Update, usable: BoolArray | None) -> Update:
    """Innovations, their covariance and NIS of zero for axes of which nothing was measured."""
    if usable is None:
        return done
    innovation = np.where(usable[:, None], done.innovation, 0.0)
    covariance = done.innovation_covariance
    covariance = np.where(usable.reshape(-1, *[1] * (covariance.ndim - 1)), covariance, 0.0)
    return Update(done.posterior, innovation, covariance, np.where(usable, done.nis, 0.0), done.gate)


def _kept(covariance: FloatArray) -> FloatArray:
    """An innovation covariance, or its diagonal where it is large."""
    if covariance.ndim == 3 and covariance.shape[-1] > MOST_COVARIANCES:
        return np.array(np.einsum("amm->am", covariance))
    return covariance


def _numbers(values: FloatArray) -> FloatArray:
    """The numbers with zero for NaN, and the largest double for infinite ones."""
    return values if _has_finite_sum(values) else np.nan_to_num(values)


def _has_finite_sum(values: FloatArray) -> bool:
    return math.isfinite(np.add.reduce(values, axis=None))


def _where(chosen: BoolArray, first: Gaussian, second: Gaussian) -> Gaussian:
    """Axis by axis, the first Gaussian where chosen, otherwise the second."""
    which = np.flatnonzero(chosen)
    if not len(which):
        return second
    mean, covariance = second.mean.copy("K"), second.covariance.copy("K")
    mean[which] = first.mean[which]
    covariance[which] = first.covariance[which] if len(first.covariance) > 1 else first.covariance[0]
    return Gaussian(mean, covariance)
