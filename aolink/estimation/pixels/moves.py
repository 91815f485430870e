"""Markov chain moves that leave a tempered posterior unchanged: prior times a power of the pixels' likelihood.

They need gradients of the likelihood, two to three times the work a point, and are worth it: where a bright spot
swings, the posterior is a thin shell or several, of which the points' covariance says little. There random walks would
take steps of a twentieth of the posterior's width, and hardly leave where they began.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, with_noise_and_gradient
from aolink.estimation.pixels.likelihood import PixelView
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.numerics.covariance import cholesky

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
    """Points of one axis that are moved by Hamiltonian Monte Carlo with their covariance as the inverse mass (Neal,
    MCMC using Hamiltonian dynamics, Handbook of Markov Chain Monte Carlo (2011), section 5.3), and once by the
    difference of two other points, which may lead to another mode."""

    def __init__(
        self, view: PixelView, prior: GaussianMixture, points: FloatArray, rng: np.random.Generator
    ) -> None:  # fmt: skip
        self._view, self._prior, self._rng = view, prior, rng
        self._step, self._most_steps = _FIRST_STEP, _most_steps(view)
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
        log_prior, prior_slope = with_noise_and_gradient(self._prior, t[None])
        log_likelihood, slope = self._view.log_likelihoods_and_gradients(t[None])
        return _Place(t, log_prior[0], log_likelihood[0], prior_slope[0], slope[0])

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
