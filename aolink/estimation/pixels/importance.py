"""Adaptive multiple importance sampling: points drawn from a Gaussian mixture, weighted by posterior over proposal.

After a round the mixture is fitted to the weighted points (one EM step), and the next round is drawn from that, until
the effective sample size is enough: a mode that no search started near is found by the few points that fall there. The
points of all rounds are weighted against all their densities together (Veach's balance heuristic; in this use Cornuet
et al., Adaptive multiple importance sampling, Scand. J. Stat. 39 (2012)). The points are quasi-random (Sobol) and the
same for every axis and frame.

Some posteriors cannot be approximated by such a mixture. Where a spot hardly moves and there is little noise, the blur
fixes the sum of many squares, and the posterior is a shell. Where several vibrations are free in phase, one search
finds few of the modes, and the effective sample size of points about those does not show the others: the uncertainty
that the windowed moments leave decides (`scattered`). In both cases tempered sequential Monte Carlo draws the points
(`aolink.estimation.pixels.tempering`), and their mixture is a part of the proposal density of another
importance sampling, which weighs the modes more exactly than the number of points in each; where its effective sample
size is not enough, the tempered points are the posterior. A fit may have nearly no density where some of the points
lie, and its effective sample size does not show that; such points keep their share of the posterior (`with_missed`). On
some rigs neither shows that the fit is too narrow (`aolink.estimation.assumptions.importance_is_too_sure`); there the
tempered points always are the posterior.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import special

from aolink.estimation.compiled import mixtures as compiled_mixtures
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, joined, log_sum, stacked_axes, with_noise
from aolink.estimation.pixels.likelihood import PixelView
from aolink.estimation.pixels.moves import Metropolis
from aolink.estimation.pixels.tempering import fitted, tempered_points
from aolink.numerics.arrays import BoolArray, FloatArray

# Most rounds.
ROUNDS = 4
# If less than this share of it is reached, points are tempered: number of components fitted to their end states.
_TOO_FEW = 0.5
_COMPONENTS = 6
# A fit misses a tempered point where its density, relative to the posterior's, is less by this many nats than at most
# points. Fewer than the second share of all points, or than twice as many as coefficients, may be so by chance.
# Number of components fitted to them. Points that are less likely than the best one by the last number of nats are
# stuck: no posterior has points there.
_MISSED = 3.0
_LEAST_MISSED = 1 / 30
_COMPONENTS_OF_MISSED = 2
_STUCK = 100.0
# Modes are scattered if the windowed moments leave the path uncertain by a variance of this many variances of the
# kernel.
_SCATTERED = 2.5
# Least effective sample size when a mixture is fitted; weights are raised to a power below one to reach it, since a fit
# to a handful of points is too sure. And steps of the search for that power.
LEAST_EFFECTIVE = 128.0
HALVINGS = 6
# Points of a round for each pair of coefficients, rounded up to a power of two. For one or two coefficients that would
# be too few. And the fewest, whatever share of them is asked for.
_POINTS = 14
_FEWEST_POINTS = 128
_FEWEST_OF_A_SHARE = 32
_MOST_POINTS = 2048
# Share of the points that are drawn from the wide Gaussians.
_WIDE = 0.3
# The modes' covariances are multiplied by this: tails that are too thin cost more than ones that are too thick. And
# their log-evidence by this: Laplace's evidence of a mode that is bent is rough.
_INFLATION = 1.5
_EVIDENCE = 0.5
# Share of a proposal density that is the mixture of tempered points, where there are any.
_BESIDE = 0.5
# In a fit, a component's old covariance counts as this many points for each coefficient. Between rounds few, so that a
# component soon finds its place; in the last fit more, with old covariances that a fit has made widened by the last
# number: a covariance of few points is too narrow. (Twice as wide is too much: with twenty coefficients, where the old
# covariances count as sixty points, intervals of 95 % held 98 to 99 %.) Those of a first round, which no fit has made,
# are wide already: the inflation is taken back.
PRIOR_POINTS = 2.0
LAST_PRIOR_POINTS = 3.0
TIGHTENED = 1 / _INFLATION
LOOSENED = 1.2
# A component of the prior has to have this weight for its modes to count as scattered.
_HEAVY = 0.05
# A component of less than this weight is dropped.
NEGLIGIBLE = 1e-3


def proposed(modes: GaussianMixture, wide: GaussianMixture) -> GaussianMixture:
    """Modes, flattened a little, and the wide Gaussians of windowed moments about them, to draw points from."""
    weight = _EVIDENCE * (modes.log_weight - np.maximum.reduce(modes.log_weight, axis=1, keepdims=True))
    weight += math.log(1 - _WIDE) - log_sum(weight, axis=1)[:, None]
    narrow = GaussianMixture(weight, modes.mean, modes.covariance * _INFLATION)
    return joined(narrow, wide.weighted(_WIDE))


def beside_points(proposal: GaussianMixture, points: GaussianMixture) -> GaussianMixture:
    """A proposal density with the mixture of tempered points, flattened a little, beside it."""
    flat = points._replace(covariance=points.covariance * _INFLATION)
    return joined(proposal.weighted(1 - _BESIDE), flat.weighted(_BESIDE))


def posterior(
    view: PixelView, prior: GaussianMixture, proposal: GaussianMixture, share: float, enough: float
) -> tuple[GaussianMixture, BoolArray]:
    """A mixture that fits the posterior of t by importance sampling, and where it can be relied on, (axes,).

    Each round has this ``share`` of the usual number of points, and the effective sample size to reach is the same
    share of ``enough``. A fit to less than half of that cannot be relied on: its weights are flattened, so that it
    is wide.
    """
    wanted = np.full(len(prior.mean), share * enough)
    fit, effective = importance_corrected(view, prior, proposal, share, wanted)
    return fit, np.asarray(effective >= _TOO_FEW * wanted)


class Tempered(NamedTuple):
    """Tempered points, and a mixture fitted to them."""

    points: FloatArray
    """(axes, points, n), equally likely."""
    log_posterior: FloatArray
    """Of each point, up to a constant, (axes, points)."""
    fit: GaussianMixture

    @property
    def best(self) -> FloatArray:
        """The most likely point, (axes, 1, n)."""
        best = np.argmax(self.log_posterior, axis=1)
        return np.asarray(self.points[np.arange(len(best)), best][:, None])


def tempered(view: PixelView, prior: GaussianMixture, count: int, number: int) -> Tempered:
    """A number of tempered points, in the exposure of this number."""
    points, _ = tempered_points(view, prior, count, [(number, axis) for axis in view.axes.tolist()], Metropolis)
    rows = view.reduced.end_rows
    fit = stacked_axes([fitted(each, rows, _COMPONENTS, 0) for each in points])
    return Tempered(points, with_noise(prior, points) + view.log_likelihoods(points), fit)


def with_missed(fit: GaussianMixture, tempered: Tempered, rows: FloatArray) -> GaussianMixture:
    """A fit to the posterior, and beside it a mixture of those tempered points that it misses, by their share of all.

    The points' projections ``rows`` @ point are what components are fitted to, as in `tempered`.
    """
    away = tempered.log_posterior - fit.log_density(tempered.points)
    stuck = tempered.log_posterior < tempered.log_posterior.max(axis=1, keepdims=True) - _STUCK
    missed = (away > np.median(away, axis=1, keepdims=True) + _MISSED) & ~stuck
    _, count, n = tempered.points.shape
    found = fit
    for axis in np.flatnonzero(missed.sum(axis=1) >= max(_LEAST_MISSED * count, 2 * n)):
        those, share = tempered.points[axis, missed[axis]], missed[axis].mean()
        more = fitted(those, rows, _COMPONENTS_OF_MISSED, 0).weighted(share)
        which = np.array([axis])
        found = found.replaced(which, joined(fit.part(which).weighted(1 - share), more))
    return found


def scattered(view: PixelView, wide: GaussianMixture) -> BoolArray:
    """Whether a search about the windowed moments' Gaussians finds too few of the modes, (axes,).

    Components of small weight do not count.
    """
    variance = np.einsum("ij,acij->ac", view.gram, wide.covariance) / view.outputs
    heavy = wide.log_weight > math.log(_HEAVY)
    return np.asarray((heavy & (variance > _SCATTERED * view.kernel_variance)).any(axis=1))


def importance_corrected(
    view: PixelView, prior: GaussianMixture, proposal: GaussianMixture, share: float, enough: FloatArray
) -> tuple[GaussianMixture, FloatArray]:
    """A mixture fitted to weighted points, and their effective sample size, (axes,), which is to reach ``enough``."""
    n = view.reduced.size
    numbers = [quasi_random(points_of_round(n, share), n, k) for k in range(ROUNDS)]
    fit = proposal.copy()
    effective = np.empty(len(prior.mean))
    compiled_mixtures.correct_by_importance(
        view.seen, *prior.contiguous, *fit.contiguous, np.stack([u for u, _ in numbers]),
        np.stack([e for _, e in numbers]), enough, LEAST_EFFECTIVE, HALVINGS, n * PRIOR_POINTS,
        n * LAST_PRIOR_POINTS, TIGHTENED, LOOSENED, NEGLIGIBLE, effective,
    )  # fmt: skip
    return fit, effective


def points_of_round(n: int, share: float) -> int:
    """Points that each round has for n coefficients: this share of the usual number, to a power of two."""
    wanted = max(_FEWEST_OF_A_SHARE, share * max(_FEWEST_POINTS, _POINTS * n**2))
    return min(_MOST_POINTS, 1 << math.ceil(math.log2(wanted)))


@lru_cache(maxsize=32)
def quasi_random(count: int, n: int, number: int) -> tuple[FloatArray, FloatArray]:
    """Sobol's points, shifted: one uniform number and n normal ones for each, (count,) and (count, n)."""
    from scipy.stats import qmc  # a third of what it takes to start, for this alone

    points = qmc.Sobol(n + 1, scramble=False).random(count)
    points = (points + np.random.default_rng(number).random(n + 1)) % 1.0
    return points[:, 0], np.asarray(special.ndtri(np.clip(points[:, 1:], 1e-12, 1 - 1e-12)))
