"""A frequency that wanders: copies of an estimator at several values of it, weighted by the likelihood of the frames.

Each copy has one relative frequency s, at which all motion of the plant runs s times as fast with the same spread: A ->
A^s, and a process noise that leaves the stationary covariance as it is. The value is a Markov chain over the copies, a
random walk in log s. Each copy is weighted by the likelihood of each frame under it (multiple models: Magill, IEEE
Trans. Autom. Control 10 (1965); with a chain over them: Blom, Bar-Shalom, ibid. 33 (1988)). States are not mixed
between copies, as the latter do: since the plant forgets its state, each copy's estimate follows from its own
frequency, and each copy can keep a Gaussian mixture as well as a Gaussian.

Each axis has a value of its own. An estimate is the mixture of the copies' estimates, by its mean and covariance.
Its path is written in the basis of the plant as it is in the rig file, so a recording needs no other: the noise inside
an exposure takes up the difference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy import linalg

from aolink.errors import EstimatorError
from aolink.estimation.batch import Batch
from aolink.estimation.estimate import Estimate, WanderingValue
from aolink.estimation.estimator import Estimator
from aolink.estimation.kalman.filter import Posterior
from aolink.estimation.moments.windowed import NOT_BELIEVED
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.numerics.block_diagonal import stationary_covariance
from aolink.numerics.covariance import psd_root
from aolink.plant.alike import MANY_STATES
from aolink.rig import Plant, Rig, Wandering

# Neighbours are apart by this many damping ratios of the least damped resonance, as far as the number of copies allows.
_APART = 2.0
_FEWEST, _MOST = 9, 21
# A frame's evidence is raised to this power: it is approximate, and not quite of the same windows in all copies, and
# what is wrong in it would add up while a value stays where it is.
_TRUST = 0.5
# Where another copy's path has no exact coefficients, it is met to this part of the kernel's standard deviation.
_MET = 0.01


class WanderingEstimator(Estimator):
    """One estimator on a rig with ``plant.wandering``.

    ``make`` makes the estimator for a rig. Raises `EstimatorError` where the plant cannot run faster or slower.
    """

    def __init__(self, rig: Rig, make: Callable[[Rig], Estimator]) -> None:
        wandering = rig.plant.wandering
        assert wandering is not None
        if wandering.parameter != "frequency":
            raise EstimatorError(f"plant.wandering follows a frequency only, not {wandering.parameter}: leave it out")
        logs = _grid(rig.plant, wandering)
        rigs = [replace(rig, plant=at_frequency(rig.plant, math.exp(each))) for each in logs]
        self._each = [make(each) for each in rigs]
        nominal = self._each[len(logs) // 2]
        super().__init__(rig, nominal.name, nominal.filter)
        self._copied = [part for each in rigs for part in (each, each.plant)]
        self._logs, self._wandering = logs, wandering
        self._log_weight = np.full((rig.plant.axes, len(logs)), -math.log(len(logs)))
        self._last_step: int | None = None

    @property
    def shared(self) -> list[object]:
        return [*super().shared, *self._copied]

    def steps_as_aligned(self, batch: Batch) -> Iterator[Estimate]:
        series = [each.steps_as_aligned(Batch(each.rig, batch.exposures)) for each in self._each]
        for exposure in batch.exposures:
            estimates, evidence = [], []
            for copy, made in zip(self._each, series, strict=True):
                estimates.append(next(made))
                assert copy.posterior is not None
                evidence.append(_evidence(copy.posterior))
            self.several = self._each[len(series) // 2].several
            self._weigh(exposure.first_step, np.stack(evidence, axis=1))
            yield self._combined(estimates)

    def _weigh(self, first_step: int, evidence: FloatArray) -> None:
        """Predict the weights to this exposure, and update them with the evidence of each copy, (axes, copies)."""
        before = first_step if self._last_step is None else self._last_step
        minutes = max(0, first_step - before) * self.rig.timing.fast_step_s / 60
        self._last_step = first_step
        spacing = self._logs[1] - self._logs[0]
        # Variance of a step to either side with this probability: 2 p spacing^2. A long pause spreads evenly.
        p = min(1 / 3, self._wandering.rate_per_minute**2 * minutes / (2 * spacing**2))
        weight = np.exp(self._log_weight)
        beside = np.pad(weight, ((0, 0), (1, 1)), mode="edge")
        weight = (1 - 2 * p) * weight + p * (beside[:, :-2] + beside[:, 2:])
        known = np.isfinite(evidence).all(axis=1, keepdims=True)
        logs = np.log(np.maximum(weight, 1e-300)) + np.where(known, _TRUST * evidence, 0.0)
        top = logs.max(axis=1, keepdims=True)
        self._log_weight = logs - top - np.log(np.exp(logs - top).sum(axis=1, keepdims=True))

    def _combined(self, estimates: list[Estimate]) -> Estimate:
        w = np.exp(self._log_weight)
        nominal, heaviest = estimates[len(estimates) // 2], estimates[int(w.sum(axis=0).argmax())]
        tolerance = _MET * math.sqrt(float(np.linalg.eigvalsh(self.rig.sensor.kernel.covariance)[0]))
        z, P = zip(*(_in_basis(nominal, each, tolerance) for each in estimates), strict=True)
        n = nominal.end_state.shape[1]
        mean, covariance = _mixed(w, np.stack(z, axis=1), np.stack(P, axis=1))
        ends = [(each.end_state, each.end_covariance) for each in estimates]
        end, end_covariance = _mixed(w, *(np.stack(each, axis=1) for each in zip(*ends, strict=True)))
        log_mean = w @ self._logs
        spread = (w * (self._logs - log_mean[:, None]) ** 2).sum(axis=1) + (self._logs[1] - self._logs[0]) ** 2 / 12
        value = np.exp(log_mean)
        return replace(
            heaviest, start_state=mean[:, :n], start_covariance=covariance[:, :n, :n], end_state=end,
            end_covariance=end_covariance, coefficients=mean, coefficient_covariance=covariance, model=nominal.model,
            components=None, wandering=WanderingValue(value, value * np.sqrt(spread)),
        )  # fmt: skip


def at_frequency(plant: Plant, relative: float) -> Plant:
    """A plant whose motion is faster by a factor, with the same spread and the same static response.

    Raises EstimatorError: its motion has no stationary spread, or its matrix no real logarithm.
    """
    if relative == 1.0:
        return plant
    values = np.linalg.eigvals(plant.A)
    if np.abs(values).max() >= 1 - 1e-9:
        raise EstimatorError(
            "plant.wandering needs a plant whose motion has a stationary spread, and plant.A has an eigenvalue of"
            f" modulus {np.abs(values).max():.6g}: leave it out"
        )
    if (np.abs(values) < 1e-9).any() or ((values.real < 0) & (np.abs(values.imag) < 1e-9)).any():
        raise EstimatorError(
            "plant.wandering needs a plant that can run a little faster, and an eigenvalue of plant.A is zero or"
            " negative: leave it out"
        )
    n = plant.n_states
    P = stationary_covariance(plant.A, plant.B_w @ plant.process_noise @ plant.B_w.T)
    A = np.real(linalg.expm(relative * linalg.logm(plant.A)))
    B = (np.eye(n) - A) @ np.linalg.solve(np.eye(n) - plant.A, plant.B)
    return replace(plant, A=A, B=B, B_w=psd_root(P - A @ P @ A.T), process_noise=np.eye(n))


def _grid(plant: Plant, wandering: Wandering) -> FloatArray:
    """Logarithms of the copies' relative values; the one in the middle is zero."""
    if plant.n_states > MANY_STATES:
        raise EstimatorError(
            f"plant.wandering is for at most {MANY_STATES} states, this plant has {plant.n_states}: leave it out"
        )
    half = math.log1p(wandering.largest)
    rates = np.log(np.linalg.eigvals(plant.A).astype(complex))
    damping = float((-rates.real / np.maximum(np.abs(rates), 1e-12)).min())
    wanted = half / (_APART * max(damping, 1e-6))
    side = int(min(max(math.ceil(wanted), _FEWEST // 2), _MOST // 2))
    return np.asarray(half * np.arange(-side, side + 1) / side)


def _evidence(posterior: Posterior) -> FloatArray:
    """Log-likelihood of the measurement, (axes,); not finite where there is none.

    By innovation and covariance it is -(NIS + log |S|) / 2, up to a constant.
    """
    if posterior.log_evidence is not None:
        return posterior.log_evidence
    S = posterior.innovation_covariance
    sizes = np.linalg.slogdet(S)[1] if S.ndim == 3 else np.log(np.maximum(S, 1e-300)).sum(axis=1)
    seen = (posterior.nis > 0) & (posterior.nis < NOT_BELIEVED)
    return np.where(seen, -0.5 * (posterior.nis + sizes), np.nan)


def _in_basis(nominal: Estimate, other: Estimate, tolerance: float) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of another copy's path as coefficients of the nominal basis."""
    model, theirs = nominal.model, other.model
    n = nominal.end_state.shape[1]
    own, basis = (each.basis.reshape(-1, each.n_coefficients) for each in (model, theirs))
    noise = own[:, n:]
    size = noise.shape[1]
    solve = np.linalg.solve(noise.T @ noise + model.n_steps * tolerance**2 * np.eye(size), noise.T)
    M = np.zeros((n + size, basis.shape[1]))
    M[:n, :n] = np.eye(n)
    M[n:] = solve @ (basis - np.pad(own[:, :n], ((0, 0), (0, basis.shape[1] - n))))
    z = batched.matvec(M, other.coefficients)
    change = theirs.response(other.inputs).path - model.response(nominal.inputs).path
    z[:, n:] += change.reshape(len(z), -1) @ solve.T
    return z, batched.symmetric(batched.congruence(M, other.coefficient_covariance))


def _mixed(weight: FloatArray, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of mixtures, weights (axes, copies)."""
    whole = (weight[..., None] * mean).sum(axis=1)
    away = mean - whole[:, None]
    spread = covariance + away[..., :, None] * away[..., None, :]
    return whole, batched.symmetric((weight[..., None, None] * spread).sum(axis=1))
