"""The posterior by sampling: tempered sequential Monte Carlo. Offline and slow; the limit for all other estimators.

Particles are drawn from the prior, and the pixels' likelihood is let in by and by, raised to a power that grows from
zero to one: each time so far that the effective sample size falls to one half. Particles are then drawn anew by their
weights and moved by Metropolis' rule: differences of two others (ter Braak's differential evolution), which go from
mode to mode, and random walks of the particles' own covariance. All fast steps are looked at.

Del Moral, Doucet, Jasra, Sequential Monte Carlo samplers, J. R. Stat. Soc. B 68 (2006), section 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from aolink.estimation import stacked
from aolink.estimation.exposure_model import ExposureModel
from aolink.estimation.hypotheses import Hypotheses, cholesky, log_sum
from aolink.estimation.hypothesis_filter import Update
from aolink.estimation.mixture import explored
from aolink.estimation.observation import Belief
from aolink.estimation.pixels import PixelView, Reduction, reduction
from aolink.estimation.profile import LEAST_SHARE, innovation
from aolink.sensor import BaseSensor

FloatArray = NDArray[np.float64]

_MOVES = 16
_EFFECTIVE = 0.5
# Rms of the path that is left out, in standard deviations of the kernel.
_LEFT_OUT = 0.05
_COMPONENTS = 8
_EM_PASSES = 25
# Part of the covariance of all that a component of the fit has at least.
_LEAST_SPREAD = 1e-3
# Every so many moves a difference is taken whole, which leads from one mode to another.
_WHOLE = 4


@dataclass(frozen=True, eq=False)
class SampledUpdates:
    """Particles of one axis after another; a mixture of Gaussians is fitted to their end states."""

    particles: int = 3000
    seed: int = 0

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        """The coefficients that it works with."""
        return reduction(model, sensor, left_out=_LEFT_OUT, all_steps=True)

    def update(self, view: PixelView, prior: Hypotheses, number: int) -> Update:
        """The posterior of axes with a prior of their start states."""
        t = self.sample(view, prior, number)
        reduced, before = view.reduced, view.reduced.prior(prior.belief)
        mean = t.mean(axis=1)
        away = t - mean[:, None]
        after = Belief(mean, stacked.matmul(stacked.transpose(away), away) / (t.shape[1] - 1))
        modes, _ = explored(view, prior)
        new = innovation(view, before, modes)
        fits = [fitted(points @ reduced.end_rows.T, self.seed) for points in t]
        end = Hypotheses(
            np.concatenate([fit.log_weight for fit in fits]),
            np.concatenate([fit.mean for fit in fits]),
            np.concatenate([fit.covariance for fit in fits]) + reduced.end_remainder,
        )
        share = np.exp(modes.log_evidence - log_sum(modes.log_evidence, axis=1)[:, None])
        return Update(after, end, new, (share > LEAST_SHARE).sum(axis=1) > 1)

    def sample(self, view: PixelView, prior: Hypotheses, number: int) -> FloatArray:
        """Equally likely particles of the posterior, (axes, particles, n).

        Parameters
        ----------
        prior:
            Of the start state; the noise coefficients have N(0, I).
        number:
            Of the exposure: with the seed and the axis it makes the random numbers.
        """
        each = [np.array([axis]) for axis in range(len(prior.mean))]
        keys = [(self.seed, number, int(axis)) for axis in view.axes]
        return np.stack([self._sample(view.part(a), prior.part(a), key) for a, key in zip(each, keys, strict=True)])

    def _sample(self, view: PixelView, prior: Hypotheses, key: tuple[int, ...]) -> FloatArray:
        rng, count, n = np.random.default_rng(key), self.particles, view.reduced.size
        t = _drawn(prior, rng, count, n)
        log_prior, log_light = _log_prior(prior, t), _log_likelihood(view, t)
        power = 0.0
        while power < 1.0:
            power, before = _next_power(log_light, power), power
            chosen = _resampled(np.exp((power - before) * (log_light - log_light.max())), rng)
            t, log_prior, log_light = t[chosen], log_prior[chosen], log_light[chosen]
            root = cholesky(np.cov(t, rowvar=False))
            size = 1.0
            for move in range(_MOVES):
                if move % 2:
                    step = 2.38 / math.sqrt(n) * size * rng.standard_normal((count, n)) @ root.T
                else:
                    first, second = rng.integers(0, count, (2, count))
                    length = 1.0 if move % _WHOLE == 0 else 2.38 / math.sqrt(2 * n) * size
                    step = length * (t[first] - t[second]) + 0.01 * rng.standard_normal((count, n)) @ root.T
                there = t + step
                its_prior, its_light = _log_prior(prior, there), _log_likelihood(view, there)
                gain = its_prior - log_prior + power * (its_light - log_light)
                taken = np.log(rng.random(count)) < gain
                t[taken], log_prior[taken], log_light[taken] = there[taken], its_prior[taken], its_light[taken]
                if move % _WHOLE:
                    # Towards a quarter of the moves taken.
                    size *= math.exp(taken.mean() - 0.25)
        return t


def fitted(points: FloatArray, seed: int, components: int = _COMPONENTS) -> Hypotheses:
    """A mixture of Gaussians for equally likely points of one axis, (points, n), by expectation and maximisation."""
    rng, (count, n) = np.random.default_rng(seed), points.shape
    total = np.cov(points, rowvar=False).reshape(n, n)
    white = np.linalg.solve(cholesky(total), (points - points.mean(axis=0)).T).T
    centres = _spread_centres(white, components, rng)
    nearest = np.argmin(((white[:, None] - white[centres]) ** 2).sum(axis=2), axis=1)
    share = np.eye(components)[nearest]
    for _ in range(_EM_PASSES):
        mass = share.sum(axis=0) + 1e-300
        mean = (share.T @ points) / mass[:, None]
        away = points[:, None] - mean
        spread = np.einsum("kc,kci,kcj->cij", share, away, away) / mass[:, None, None] + _LEAST_SPREAD * total
        with np.errstate(divide="ignore"):
            log_weight = np.log(mass / count)
        mixture = Hypotheses(log_weight[None], mean[None], spread[None])
        logs = mixture.component_log_densities(points[None])[0]
        share = np.exp(logs - log_sum(logs, axis=0)).T
    return mixture


def _spread_centres(white: FloatArray, count: int, rng: np.random.Generator) -> list[int]:
    """Points far from each other (k-means++)."""
    chosen = [int(rng.integers(len(white)))]
    distance = np.full(len(white), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, ((white - white[chosen[-1]]) ** 2).sum(axis=1))
        total = distance.sum()
        weights = distance / total if total > 0 else np.full(len(white), 1 / len(white))
        chosen.append(int(rng.choice(len(white), p=weights)))
    return chosen


def _drawn(prior: Hypotheses, rng: np.random.Generator, count: int, n: int) -> FloatArray:
    """Points of the prior: start states of the mixture of one axis, standard normal numbers after them."""
    weights, states = np.exp(prior.log_weight[0]), prior.mean.shape[2]
    component = rng.choice(len(weights), size=count, p=weights / weights.sum())
    t = rng.standard_normal((count, n))
    root = cholesky(prior.covariance[0])
    t[:, :states] = prior.mean[0, component] + (root[component] @ t[:, :states, None])[..., 0]
    return t


def _log_prior(prior: Hypotheses, t: FloatArray) -> FloatArray:
    states = prior.mean.shape[2]
    return np.asarray(prior.log_density(t[None, :, :states])[0] - 0.5 * (t[:, states:] ** 2).sum(axis=1))


def _log_likelihood(view: PixelView, t: FloatArray) -> FloatArray:
    return np.asarray(view.log_likelihoods(t[None])[0])


def _next_power(log_light: FloatArray, power: float) -> float:
    """The largest one up to 1 that leaves the effective sample size that is wanted."""
    away = log_light - log_light.max()

    def excess(more: float) -> float:
        w = np.exp(more * away)
        return float(w.sum() ** 2 / (w @ w) / len(w)) - _EFFECTIVE

    if excess(1.0 - power) >= 0:
        return 1.0
    return power + float(optimize.brentq(excess, 0.0, 1.0 - power, xtol=1e-12))


def _resampled(weights: FloatArray, rng: np.random.Generator) -> NDArray[np.intp]:
    """Systematic resampling."""
    count = len(weights)
    places = (rng.random() + np.arange(count)) / count
    total = np.cumsum(weights)
    return np.minimum(np.searchsorted(total / total[-1], places), count - 1)
