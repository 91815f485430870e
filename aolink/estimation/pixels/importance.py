"""Adaptive multiple importance sampling: points drawn from a Gaussian mixture, weighted by posterior over proposal.

After a round the mixture is fitted to the weighted points (one EM step), and the next round is drawn from that, until
the effective sample size is enough: a mode that no search started near is found by the few points that fall there. The
points of all rounds are weighted against all their densities together (Veach's balance heuristic; in this use Cornuet
et al., Adaptive multiple importance sampling, Scand. J. Stat. 39 (2012)). The points are quasi-random (Sobol) and the
same for every axis and frame.

Where several vibrations are free in phase and the spot is bright, the modes may be more than a search finds, and the
effective sample size of points about those that it found does not show the others: the fit is then too narrow.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy import special

from aolink.estimation.compiled import mixtures as compiled_mixtures
from aolink.estimation.pixels.constants import PROFILE
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, joined, log_sum
from aolink.estimation.pixels.likelihood import PixelView
from aolink.numerics.arrays import BoolArray, FloatArray


def proposed(modes: GaussianMixture, wide: GaussianMixture) -> GaussianMixture:
    """Modes, flattened a little, and the wide Gaussians of windowed moments about them, to draw points from."""
    weight = PROFILE.evidence * (modes.log_weight - np.maximum.reduce(modes.log_weight, axis=1, keepdims=True))
    weight += math.log(1 - PROFILE.wide) - log_sum(weight, axis=1)[:, None]
    narrow = GaussianMixture(weight, modes.mean, modes.covariance * PROFILE.inflation)
    return joined(narrow, wide.weighted(PROFILE.wide))


def posterior(
    view: PixelView, prior: GaussianMixture, proposal: GaussianMixture, wide: GaussianMixture, share: float
) -> tuple[GaussianMixture, BoolArray]:
    """A mixture that fits the posterior of t by importance sampling, and where too few points count for it, (axes,).

    Each round has this ``share`` of the usual number of points, and the effective sample size to reach is the same
    share of the usual one. Where it is less, modes may have been missed, so a part of the posterior is the ``wide``
    Gaussians of windowed moments: they count as many points as there are coefficients, times what is missing.
    """
    wanted, n = np.full(len(prior.mean), share * PROFILE.enough), view.reduced.size
    fit, effective = importance_corrected(view, prior, proposal, share, wanted)
    part = n / (n + effective) * np.maximum(0.0, 1 - effective / wanted)
    return joined(fit.weighted(1 - part), wide.weighted(part)), np.asarray(effective < PROFILE.too_few * wanted)


def importance_corrected(
    view: PixelView, prior: GaussianMixture, proposal: GaussianMixture, share: float, enough: FloatArray
) -> tuple[GaussianMixture, FloatArray]:
    """A mixture fitted to weighted points, and their effective sample size, (axes,), which is to reach ``enough``."""
    n = view.reduced.size
    numbers = [quasi_random(points_of_round(view, share), n, k) for k in range(PROFILE.rounds)]
    fit = proposal.copy()
    effective = np.empty(len(prior.mean))
    compiled_mixtures.correct_by_importance(
        view.seen, *prior.contiguous, *fit.contiguous, np.stack([u for u, _ in numbers]),
        np.stack([e for _, e in numbers]), enough, PROFILE.least_effective, PROFILE.halvings, n * PROFILE.prior_points,
        n * PROFILE.last_prior_points, PROFILE.tightened, PROFILE.loosened, PROFILE.negligible, effective,
    )  # fmt: skip
    return fit, effective


def points_of_round(view: PixelView, share: float) -> int:
    """Points that each round has: this share of the usual number for so many coefficients, a power of two."""
    wanted = max(PROFILE.fewest_of_a_share, share * max(PROFILE.fewest_points, PROFILE.points * view.reduced.size**2))
    most = min(PROFILE.most_points, max(PROFILE.fewest_points, PROFILE.work / view.work))
    return min(1 << math.ceil(math.log2(wanted)), 1 << int(math.log2(most)))


@lru_cache(maxsize=32)
def quasi_random(count: int, n: int, number: int) -> tuple[FloatArray, FloatArray]:
    """Sobol's points, shifted: one uniform number and n normal ones for each, (count,) and (count, n)."""
    from scipy.stats import qmc  # a third of what it takes to start, for this alone

    points = qmc.Sobol(n + 1, scramble=False).random(count)
    points = (points + np.random.default_rng(number).random(n + 1)) % 1.0
    return points[:, 0], np.asarray(special.ndtri(np.clip(points[:, 1:], 1e-12, 1 - 1e-12)))
