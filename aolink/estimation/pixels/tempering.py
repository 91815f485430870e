"""Tempered sequential Monte Carlo: particles of a posterior that no Gaussian mixture describes.

Particles are drawn from the prior and weighted with the pixels' likelihood, raised to a power that grows from zero to
one, each time so far that the effective sample size falls to one half. They are then resampled and moved
(`aolink.estimation.pixels.moves`).

Del Moral, Doucet, Jasra, Sequential Monte Carlo samplers, J. R. Stat. Soc. B 68 (2006), section 3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize

from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, log_sum
from aolink.estimation.pixels.likelihood import PixelView
from aolink.estimation.pixels.moves import Hamiltonian
from aolink.numerics.arrays import FloatArray, Indices
from aolink.numerics.covariance import cholesky
from aolink.numerics.single_thread import by_one_thread

_EFFECTIVE = 0.5
_EM_PASSES = 25
# Least covariance of a component of the fit, as a share of that of all particles.
_LEAST_SPREAD = 1e-3


class Particles(NamedTuple):
    """Equally likely points of a posterior."""

    points: FloatArray
    """(axes, count, n)"""
    log_evidence: FloatArray
    """Estimate of the frame's log-likelihood, up to a constant of the camera and the mask, (axes,):
    the sum over the steps of the power of the log of the points' mean weight."""


def tempered_points(view: PixelView, prior: GaussianMixture, count: int, keys: Sequence[tuple[int, ...]]) -> Particles:
    """Points of the posterior; the same key, the seed of an axis, gives the same points.

    ``prior`` is that of the start state; the noise coefficients have N(0, I).
    """
    each = (np.array([axis]) for axis in range(len(keys)))
    found = [_of_axis(view.part(a), prior.part(a), count, key) for a, key in zip(each, keys, strict=True)]
    return Particles(np.stack([points for points, _ in found]), np.array([evidence for _, evidence in found]))


def _of_axis(view: PixelView, prior: GaussianMixture, count: int, key: tuple[int, ...]) -> tuple[FloatArray, float]:
    """`tempered_points` of one axis: points (count, n) and the log-evidence."""
    rng = np.random.default_rng(key)
    moved = Hamiltonian(view, prior, _drawn(prior, rng, count, view.reduced.size), rng)
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
