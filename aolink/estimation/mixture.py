"""The posterior as a mixture of Gaussians: the modes that `profile` finds, weighted, corrected and carried on.

Modes are not Gaussian: the blur fixes how much a path moves and leaves open which way, and such a posterior is
bent. So the modes, and the wide Gaussians of windowed moments about them, are where points are drawn from only;
what counts is the points' weights, prior times likelihood over the density that they were drawn from. After a first
round the mixture is fitted to the weighted points, and a second round is drawn from that. All points of both are
weighted against both densities together (Veach's balance heuristic; in this use Cornuet et al., Adaptive multiple
importance sampling, Scand. J. Stat. 39 (2012)). The points are quasi-random and the same for every axis and frame.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import special

from aolink.estimation import stacked
from aolink.estimation.exposure_model import ExposureModel
from aolink.estimation.hypotheses import Hypotheses, cholesky, joined, log_sum
from aolink.estimation.hypothesis_filter import Update
from aolink.estimation.observation import Belief
from aolink.estimation.pixels import PixelView, Reduction, reduction
from aolink.estimation.profile import (
    LEAST_SHARE,
    Modes,
    broad,
    find_modes,
    innovation,
    spread_starts,
    whitened,
    with_reversals,
    without_repeats,
)
from aolink.sensor import BaseSensor

FloatArray = NDArray[np.float64]

_ROUNDS = 2
# Points that count at least when the mixture for the next round is fitted, and steps of the search for the power.
_LEAST_EFFECTIVE = 64.0
_HALVINGS = 10
_CARRIED = 6
# Points of a round for each coefficient; as many as the next power of two.
_POINTS = 32
_MOST_POINTS = 1024
_START_DIRECTIONS = 1
_START_REACH = 1.3
# Share of the points that come from the wide Gaussians.
_WIDE = 0.3
# Modes are flattened by this much: tails that are too thin cost more than ones that are too thick.
_INFLATION = 1.5
# A component's covariance counts as so many points beside those that it is fitted to.
_PRIOR_POINTS = 8.0


class MixtureUpdates:
    """A mixture in, a mixture out."""

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        """The coefficients that it works with."""
        return reduction(model, sensor)

    def update(self, view: PixelView, prior: Hypotheses, number: int) -> Update:
        """The posterior of axes with a prior of their start states."""
        reduced = view.reduced
        modes, proposal = explored(view, prior)
        after, _ = importance_corrected(view, prior, proposal)
        new = innovation(view, reduced.prior(prior.belief), modes)
        end = reduced.end(Belief(after.mean, after.covariance))
        carried = Hypotheses(after.log_weight, end.mean, end.covariance).reduced(_CARRIED)
        share = np.exp(modes.log_evidence - log_sum(modes.log_evidence, axis=1)[:, None])
        return Update(after.belief, carried, new, (share > LEAST_SHARE).sum(axis=1) > 1)


def explored(view: PixelView, prior: Hypotheses) -> tuple[Modes, Hypotheses]:
    """The modes that each component of a prior of the start state leads to, and a mixture to draw points from.

    The modes' log-evidence has the weights of the components in it.
    """
    before = view.reduced.prior(Belief(prior.mean, prior.covariance))
    axes, count, n = before.mean.shape
    rows = view.part(np.repeat(np.arange(axes), count))
    each = Belief(before.mean.reshape(-1, n), before.covariance.reshape(-1, n, n))
    wide = broad(rows, each)
    starts = spread_starts(rows, wide, _START_DIRECTIONS, _START_REACH)
    found = with_reversals(rows, each, find_modes(rows, each, whitened(each, starts)))
    shape = (axes, count * found.mean.shape[1])
    evidence = found.log_evidence.reshape(shape) + np.repeat(prior.log_weight, found.mean.shape[1], axis=1)
    modes = without_repeats(
        Modes(
            found.mean.reshape(*shape, n), found.covariance.reshape(*shape, n, n), evidence,
            found.distance.reshape(shape), found.objective.reshape(shape),
        )
    )  # fmt: skip
    evidence = modes.log_evidence
    narrow = Hypotheses(
        evidence - log_sum(evidence, axis=1)[:, None] + math.log(1 - _WIDE), modes.mean, modes.covariance * _INFLATION
    )
    flat = Hypotheses(
        prior.log_weight + math.log(_WIDE),
        wide.mean.reshape(axes, count, n),
        wide.covariance.reshape(axes, count, n, n),
    )
    return modes, joined(narrow, flat)


def importance_corrected(
    view: PixelView, prior: Hypotheses, proposal: Hypotheses, *, rounds: int = _ROUNDS
) -> tuple[Hypotheses, FloatArray]:
    """The posterior of t as the mixture that fits it, and the effective number of points, (axes,)."""
    proposals: list[Hypotheses] = []
    t = np.zeros((len(prior.mean), 0, view.reduced.size))
    target = np.zeros(t.shape[:2])
    points = min(_MOST_POINTS, 2 ** math.ceil(math.log2(_POINTS * view.reduced.size)))
    for k in range(rounds):
        new = _drawn(proposal, points, k)
        proposals.append(proposal)
        t = np.concatenate([t, new], axis=1)
        target = np.concatenate(
            [target, _log_prior(prior, new) + view.log_likelihood(view.predicted_of_many(new))], axis=1
        )
        log_weight = target - log_sum(np.stack([q.log_density(t) for q in proposals], axis=1), axis=1)
        log_weight -= log_sum(log_weight, axis=1)[:, None]
        last = k == rounds - 1
        weight = log_weight if last else _tempered(log_weight, _LEAST_EFFECTIVE)
        proposal = _refitted(proposal, t, weight)
    return proposal, np.exp(-log_sum(2 * log_weight, axis=1))


def _tempered(log_weight: FloatArray, least: float) -> FloatArray:
    """Weights raised to the largest power up to one at which so many points, or half of all, count."""
    least = min(least, log_weight.shape[1] / 2)
    low, high = np.zeros(len(log_weight)), np.ones(len(log_weight))
    power = high
    for _ in range(_HALVINGS):
        w = power[:, None] * log_weight
        enough = -log_sum(2 * (w - log_sum(w, axis=1)[:, None]), axis=1) >= math.log(least)
        low, high = np.where(enough, power, low), np.where(enough, high, power)
        power = (low + high) / 2
        power = np.where(low == 1, 1.0, power)
    w = np.where(low == 1, 1.0, low)[:, None] * log_weight
    return w - log_sum(w, axis=1)[:, None]


def _drawn(proposal: Hypotheses, count: int, number: int) -> FloatArray:
    """Points of a mixture, (axes, count, n); those of each round have a number."""
    axes, _, n = proposal.mean.shape
    u, e = _quasi_random(count, n, number)
    total = np.cumsum(np.exp(proposal.log_weight), axis=1)
    component = np.minimum((total[:, None] < u[:, None] * total[:, -1:, None]).sum(axis=2), total.shape[1] - 1)
    rows = np.arange(axes)[:, None]
    root = cholesky(proposal.covariance)[rows, component]
    return np.asarray(proposal.mean[rows, component] + np.add.reduce(root * e[:, None], axis=-1))


@lru_cache(maxsize=32)
def _quasi_random(count: int, n: int, number: int) -> tuple[FloatArray, FloatArray]:
    """Sobol's points, shifted: one uniform number and n normal ones for each, (count,) and (count, n)."""
    from scipy.stats import qmc  # a third of what it takes to start, for this alone

    points = qmc.Sobol(n + 1, scramble=False).random(count)
    points = (points + np.random.default_rng(number).random(n + 1)) % 1.0
    return points[:, 0], np.asarray(special.ndtri(np.clip(points[:, 1:], 1e-12, 1 - 1e-12)))


def _log_prior(prior: Hypotheses, t: FloatArray) -> FloatArray:
    """Of t = (start state, noise coefficients), (axes, points)."""
    states = prior.mean.shape[2]
    rest = t[..., states:]
    noise = -0.5 * np.add.reduce(rest * rest, axis=-1) - 0.5 * rest.shape[-1] * math.log(2 * math.pi)
    return np.asarray(prior.log_density(t[..., :states]) + noise)


def _refitted(mixture: Hypotheses, points: FloatArray, log_weight: FloatArray) -> Hypotheses:
    """One step of expectation and maximisation with weighted points."""
    logs = mixture.component_log_densities(points)
    share = np.exp(logs - log_sum(logs, axis=1)[:, None] + log_weight[:, None])  # (axes, components, points)
    mass = np.add.reduce(share, axis=2)
    effective = mass**2 / np.maximum(np.add.reduce(share * share, axis=2), 1e-300)
    safe = np.maximum(mass, 1e-300)[..., None]
    mean = stacked.long_matmul(share, points) / safe
    mean = np.where(mass[..., None] > 1e-9, mean, mixture.mean)
    away = points[:, None] - mean[:, :, None]
    spread = stacked.long_matmul(stacked.transpose(away * share[..., None]), away) / safe[..., None]
    trust = (effective / (effective + _PRIOR_POINTS))[..., None, None]
    covariance = stacked.symmetric(trust * spread + (1 - trust) * mixture.covariance)
    with np.errstate(divide="ignore"):
        return Hypotheses(np.log(mass / np.add.reduce(mass, axis=1)[:, None]), mean, covariance)
