"""The reference that estimators of the blur are judged by: tempered sequential Monte Carlo on every pixel.

Particles are drawn from the prior and weighted with the pixels' likelihood, raised to a power that grows from zero to
one, each time so far that the effective sample size falls to one half (Del Moral, Doucet, Jasra, Sequential Monte Carlo
samplers, J. R. Stat. Soc. B 68 (2006), section 3). They are then resampled and moved by Hamiltonian Monte Carlo with
their covariance as the inverse mass (Neal, MCMC using Hamiltonian dynamics, Handbook of Markov Chain Monte Carlo
(2011), section 5.3), and once by the difference of two other points, which may lead to another mode. A mixture of
Gaussians is fitted to them, and goes on to the next exposure.

It takes seconds an exposure. Its intervals may be too narrow where a bright spot vibrates fast and for long: compare
two seeds and two numbers of particles. Less of the path is left out than by other estimators; the nodes in time are
those of `profile`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple
from zlib import crc32

import numpy as np
from aolink.estimation.pixels.filter import MixtureFilter, MixtureUpdate
from scipy import optimize

from aolink.estimation import Estimator, make_estimator
from aolink.estimation.compiled import GROUPS, make_ready
from aolink.estimation.compiled.pixels import Pixels, information_of_row, path_of
from aolink.estimation.compiled.small import compiled
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.base import ExposureModel
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, log_sum, stacked_axes
from aolink.estimation.pixels.likelihood import PixelView, Reduction, reduction
from aolink.estimation.pixels.modes import find_modes, innovation, whitened, without_repeats
from aolink.estimation.pixels.profile import has_several
from aolink.numerics import batched
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.numerics.covariance import cholesky
from aolink.numerics.single_thread import by_one_thread
from aolink.optics.sensor import BaseSensor
from aolink.rig import Rig

NAME = "sampled"
Look = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Log-likelihoods (points,) of points (points, n), and their gradients (points, n)."""
# Rms of the path that is left out, in standard deviations of the kernel.
_LEFT_OUT = 0.05
_COMPONENTS = 8
# Searches for modes start at the means of so many, the heaviest.
_SEARCHED = 3
_EFFECTIVE = 0.5
_EM_PASSES = 25
# Least covariance of a component of the fit, as a share of that of all particles.
_LEAST_SPREAD = 1e-3
# Trajectories after each step of the power; how long they are, in standard deviations of the points, as far as so many
# steps lead there (on a plane, where a step takes several times as long, fewer); and which share is to be accepted.
_TRAJECTORIES = 2
_LENGTH = 1.5
_MOST_STEPS, _MOST_ON_A_PLANE = 16, 8
_ACCEPTED = 0.7
# Steps of different points differ by up to this share, so that no trajectory ends where it began.
_JITTER = 0.3
_FIRST_STEP, _LARGEST_STEP = 0.5, 1.2
# Products in the trajectories after each step of the power; how many more a point takes besides its light; and the
# numbers of points among which this budget decides.
_BUDGET, _BESIDES = 1.2e8, 2000
_FEWEST, _MOST = 500, 2000


def estimator(rig: Rig, name: str, *, particles: int | None = None, seed: int = 0) -> Estimator:
    """`make_estimator`, which knows `sampled` too, the one that ``particles`` and ``seed`` are for.

    The number of particles is 500 to 2000 by default, fewer where each is more work. The same seed gives the same
    estimates, bit for bit.
    """
    if name != NAME:
        return make_estimator(rig, name)
    make_ready(*GROUPS)
    made = Estimator(rig, name, MixtureFilter(rig.plant, rig.sensor, TemperedUpdater(particles, seed)))
    made.judge = None  # it is what the frames hold if the model fits
    return made


@dataclass(frozen=True, eq=False)
class TemperedUpdater:
    """An updater that draws the particles of one axis after another; a mixture of Gaussians is fitted to their end
    states."""

    particles: int | None = None
    seed: int = 0

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        return reduction(model, sensor, left_out=_LEFT_OUT)

    def update(self, view: PixelView, prior: GaussianMixture, unseen: Gaussian) -> MixtureUpdate:
        t, evidence = self.sample(view, prior)
        reduced, before = view.reduced, view.reduced.prior(prior.gaussian)
        mean = t.mean(axis=1)
        away = t - mean[:, None]
        with by_one_thread:
            after = Gaussian(mean, batched.matmul(batched.transpose(away), away) / (t.shape[1] - 1))
        fit = stacked_axes([fitted(points, reduced.end_rows, _COMPONENTS, self.seed) for points in t])
        # With one Gaussian as the prior: components of a mixture that overlap would count as modes of their own.
        starts = whitened(before, fit.ordered(_SEARCHED).mean)
        modes = without_repeats(find_modes(view, before, starts, reversals=True))
        new = innovation(view, before, modes)
        carried = fit.mapped(reduced.end_rows, reduced.end_remainder)
        return MixtureUpdate(fit, after, carried, new, evidence, has_several(modes), np.zeros(len(mean), dtype=bool))

    def sample(self, view: PixelView, prior: GaussianMixture) -> Particles:
        """Particles of the posterior from the prior of the start state; the noise coefficients have N(0, I).

        The seed, the axis and its pixels seed the random numbers, so that they do not depend on how many exposures came
        before.
        """
        keys = [(self.seed, axis, crc32(y.tobytes())) for axis, y in zip(view.axes.tolist(), view.y, strict=True)]
        count = self.particles or affordable(view)
        points, evidence = [], []
        for k, key in enumerate(keys):
            one = np.array([k])
            look = partial(log_likelihoods_and_gradients, view.part(one))
            rng = np.random.default_rng(key)
            start = _drawn(prior.part(one), rng, count, view.reduced.size)
            t, log_evidence = tempered(Hamiltonian(look, prior.part(one), start, rng, _most_steps(view)), rng)
            points.append(t)
            evidence.append(log_evidence)
        return Particles(np.stack(points), np.array(evidence))


class Particles(NamedTuple):
    """Equally likely points of a posterior."""

    points: FloatArray
    """(axes, count, n)"""
    log_evidence: FloatArray
    """Estimate of the frame's log-likelihood, up to a constant of the camera and the mask, (axes,):
    the sum over the steps of the power of the log of the points' mean weight."""


def tempered(moved: Hamiltonian, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Points of one axis's posterior (count, n), from those of its prior, and the log-evidence."""
    power, evidence = 0.0, 0.0
    while power < 1.0:
        power, before = _next_power(moved.log_likelihood, power), power
        most = moved.log_likelihood.max()
        weights = np.exp((power - before) * (moved.log_likelihood - most))
        evidence += (power - before) * float(most) + math.log(weights.mean())
        moved.resample(_resampled(weights, rng))
        moved.move(power)
    return moved.points, evidence


@by_one_thread
def fitted(points: FloatArray, rows: FloatArray, components: int, seed: int) -> GaussianMixture:
    """A mixture of Gaussians for equally likely points (points, n) of one axis, by expectation and maximisation.

    It is fitted to their projections rows @ point, with rows (k, n): few dimensions, so points suffice. The result is
    the mixture of the points themselves; its mean is theirs, and its covariance to a thousandth.
    """
    rng, seen = np.random.default_rng(seed), points @ rows.T
    k = seen.shape[1]
    white = np.linalg.solve(cholesky(np.cov(seen, rowvar=False).reshape(k, k)), (seen - seen.mean(axis=0)).T).T
    centres = _spread_centres(white, components, rng)
    share = np.eye(components)[np.argmin(((white[:, None] - white[centres]) ** 2).sum(axis=2), axis=1)]
    for _ in range(_EM_PASSES):
        logs = _with_shares(seen, share).component_log_densities(seen[None])[0]
        share = np.exp(logs - log_sum(logs, axis=0)).T
    return _with_shares(points, share)


def _with_shares(points: FloatArray, share: FloatArray) -> GaussianMixture:
    """Components with these shares of points, (points, components)."""
    mass = share.sum(axis=0) + 1e-300
    mean = (share.T @ points) / mass[:, None]
    away = points[:, None] - mean
    spread = np.einsum("kc,kci,kcj->cij", share, away, away, optimize=True) / mass[:, None, None]
    spread += _LEAST_SPREAD * np.cov(points, rowvar=False)
    with np.errstate(divide="ignore"):
        return GaussianMixture(np.log(mass / len(points))[None], mean[None], spread[None])


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


def _drawn(prior: GaussianMixture, rng: np.random.Generator, count: int, n: int) -> FloatArray:
    """Points of the prior: start states of the mixture of one axis, standard normal numbers after them."""
    weights, states = np.exp(prior.log_weight[0]), prior.mean.shape[2]
    component = rng.choice(len(weights), size=count, p=weights / weights.sum())
    t = rng.standard_normal((count, n))
    root = cholesky(prior.covariance[0])
    t[:, :states] = prior.mean[0, component] + (root[component] @ t[:, :states, None])[..., 0]
    return t


@by_one_thread
def _next_power(log_likelihood: FloatArray, power: float) -> float:
    """The largest power up to 1 that leaves the required effective sample size.

    By one thread: of 10,000 numbers and more, BLAS would share a scalar product among threads.
    """
    away = log_likelihood - log_likelihood.max()

    def excess(more: float) -> float:
        w = np.exp(more * away)
        return float(w.sum() ** 2 / (w @ w) / len(w)) - _EFFECTIVE

    if excess(1.0 - power) >= 0:
        return 1.0
    return power + float(optimize.brentq(excess, 0.0, 1.0 - power, xtol=1e-300, rtol=1e-6))


def _resampled(weights: FloatArray, rng: np.random.Generator) -> Indices:
    """Systematic resampling."""
    count = len(weights)
    places = (rng.random() + np.arange(count)) / count
    total = np.cumsum(weights)
    return np.minimum(np.searchsorted(total / total[-1], places), count - 1)


def affordable(view: PixelView) -> int:
    """Number of points that `Hamiltonian` moves within its budget of work."""
    a_point = _TRAJECTORIES * _most_steps(view) * (view.work + _BESIDES)
    return int(np.clip(_BUDGET / a_point, _FEWEST, _MOST))


def _most_steps(view: PixelView) -> int:
    return _MOST_STEPS if view.on_line else _MOST_ON_A_PLANE


class _Place(NamedTuple):
    points: FloatArray
    """(count, n)"""
    log_prior: FloatArray
    """(count,)"""
    log_likelihood: FloatArray
    """(count,)"""
    prior_slope: FloatArray
    """Gradient of ``log_prior``, (count, n)."""
    slope: FloatArray
    """Gradient of ``log_likelihood``, (count, n)."""


class Hamiltonian:
    """Points of one axis that are moved so that a tempered posterior, prior times a power of the likelihood, stays.

    A bright spot that swings has a posterior that is a thin shell or several, of which the points' covariance says
    little: random walks would hardly leave where they began.
    """

    def __init__(
        self, look: Look, prior: GaussianMixture, points: FloatArray, rng: np.random.Generator, most_steps: int
    ) -> None:
        self._look, self._prior, self._rng = look, prior, rng
        self._step, self._most_steps = _FIRST_STEP, most_steps
        self._now = self._at(points)

    @property
    def points(self) -> FloatArray:
        """(count, n)"""
        return self._now.points

    @property
    def log_likelihood(self) -> FloatArray:
        """(count,)"""
        return self._now.log_likelihood

    def _at(self, t: FloatArray) -> _Place:
        log_prior, prior_slope = with_noise_and_gradient(self._prior, t)
        log_likelihood, slope = self._look(t)
        return _Place(t, log_prior, log_likelihood, prior_slope, slope)

    def resample(self, chosen: Indices) -> None:
        """Take these points in place of all, (count,)."""
        self._now = _Place(*(each[chosen] for each in self._now))

    def move(self, power: float) -> None:
        """Move the points so that their distribution, with the likelihood raised to a power, stays."""
        root, count = _root(self.points), len(self.points)
        for _ in range(_TRAJECTORIES):
            taken = self._follow(power, root)
            self._step = min(_LARGEST_STEP, self._step * math.exp(taken.mean() - _ACCEPTED))
        first, second = self._rng.integers(0, count, (2, count))
        self._take(power, self._at(self.points + self.points[first] - self.points[second]), np.zeros(count))

    def _follow(self, power: float, root: FloatArray) -> BoolArray:
        """Follow one trajectory from each point, by leapfrog steps, to a point that may be taken."""
        rng, place = self._rng, self._now
        momentum = rng.standard_normal(place.points.shape)
        energy = 0.5 * np.add.reduce(momentum * momentum, axis=1)
        step = self._step * rng.uniform(1 - _JITTER, 1 + _JITTER, (len(momentum), 1))
        kick = 0.5 * step  # half a step at both ends
        for _ in range(min(self._most_steps, math.ceil(_LENGTH / self._step))):
            momentum = momentum + kick * ((place.prior_slope + power * place.slope) @ root)
            place, kick = self._at(place.points + step * (momentum @ root.T)), step
        momentum = momentum + 0.5 * step * ((place.prior_slope + power * place.slope) @ root)
        return self._take(power, place, energy - 0.5 * np.add.reduce(momentum * momentum, axis=1))

    def _take(self, power: float, there: _Place, more: FloatArray) -> BoolArray:
        """Take new points by Metropolis' rule; ``more`` is what the log of the ratio is besides the posterior's. Gives
        where they were taken, (count,)."""
        now = self._now
        gain = there.log_prior - now.log_prior + power * (there.log_likelihood - now.log_likelihood) + more
        taken = np.log(self._rng.random(len(gain))) < gain  # not where a trajectory has left all numbers
        for old, new in zip(now, there, strict=True):
            old[taken] = new[taken]
        return np.asarray(taken)


def _root(points: FloatArray) -> FloatArray:
    """Root of the covariance of points (count, n)."""
    n = points.shape[1]
    return cholesky(np.cov(points, rowvar=False).reshape(n, n))


def with_noise_and_gradient(prior: GaussianMixture, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log-densities (points,) of t = (start state, standard normal noise coefficients), (points, n), and gradients."""
    states, gradient = prior.mean.shape[2], -t
    logs = prior.component_log_densities(t[None, :, :states])[0]
    density = log_sum(logs, axis=0)
    away = prior.mean[0][:, None] - t[:, :states]
    pulls = np.linalg.solve(prior.covariance[0], away.swapaxes(1, 2)).swapaxes(1, 2)
    gradient[:, :states] = np.einsum("cp,cpi->pi", np.exp(logs - density), pulls)
    rest = t[:, states:]
    return density - 0.5 * (rest * rest).sum(axis=1) - 0.5 * rest.shape[1] * math.log(2 * math.pi), gradient


def log_likelihoods_and_gradients(view: PixelView, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log-likelihoods (points,) of many points of one axis, (points, n), and their gradients, (points, n)."""
    out, gradients = np.empty(len(t)), np.zeros_like(t)
    _look(view.seen, np.ascontiguousarray(t), out, gradients)
    return out, gradients


@compiled
def _look(seen: Pixels, t: FloatArray, out: FloatArray, gradients: FloatArray) -> None:
    n, (outputs, _, nodes) = t.shape[1], seen.basis.shape
    path, information = np.empty((outputs, nodes)), np.zeros((n, n))  # the latter adds up, and is not asked for
    for k in range(len(t)):
        for each in range(outputs):
            path_of(seen.inputs[0, each], seen.basis[each], t[k], path[each])
        out[k], _ = information_of_row(seen, 0, path, seen.basis, information, gradients[k])
