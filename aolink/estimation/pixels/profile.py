"""The estimator `profile`: the posterior of the pixels is a Gaussian mixture, which is carried from exposure to
exposure.

In words: the modes of the posterior are searched for, points are drawn about them and weighted by importance sampling
(`aolink.estimation.pixels.importance`), the weights are flattened until enough of the points count, and at most four
Gaussians that fit them go on to the next exposure. The fewer points count, the larger is the part of the posterior that
remains the wide Gaussians of windowed moments. Modes alone are not enough, since they are not Gaussian: the blur
determines how much a path moves but not in which direction, and such a posterior is curved. The work for an axis and
exposure is bounded, and `aolink.estimation.pixels.constants` has all numbers.

A mode that was lost is found again: a thousandth of the prior is the prediction without any measurement. Its modes are
searched for where the NIS is larger than chance explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.base import ExposureModel
from aolink.estimation.pixels.constants import PROFILE
from aolink.estimation.pixels.filter import MixtureUpdate
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, joined, log_sum, single
from aolink.estimation.pixels.importance import posterior, proposed
from aolink.estimation.pixels.likelihood import PixelView, Reduction, reduction
from aolink.estimation.pixels.modes import Modes, broad, innovation, modes_of, without_repeats
from aolink.numerics.arrays import BoolArray
from aolink.optics.sensor import BaseSensor


@dataclass(frozen=True)
class ProfileUpdater:
    """Updates a Gaussian mixture by importance sampling about the modes of the posterior."""

    draws: float = 1.0
    """Share of the usual number of points, and of the usual effective sample size."""

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        return reduction(model, sensor)

    def update(self, view: PixelView, prior: GaussianMixture, unseen: Gaussian) -> MixtureUpdate:
        reduced = view.reduced
        modes, after = explored(view, prior)
        new = innovation(view, reduced.prior(prior.gaussian), modes)
        doubted = np.flatnonzero(new.nis > 2 * special.gammainccinv(new.value.shape[1] / 2, PROFILE.doubted))
        wide = _wide_part(after, prior)
        if len(doubted):
            anew = single(unseen.part(doubted))
            _, more = explored(view.part(doubted), anew)
            after = after.replaced(doubted, joined(after.part(doubted), more))
            wide = wide.replaced(doubted, joined(wide.part(doubted), _wide_part(more, anew)))
        before = joined(prior.weighted(1 - PROFILE.doubt), single(unseen).weighted(PROFILE.doubt))
        several, poor = has_several(modes, PROFILE.least_doubted_share), np.zeros(len(prior.mean), dtype=bool)
        for which, share in ((~several, PROFILE.share_of_one_mode), (several, 1.0)):
            if len(rows := np.flatnonzero(which)):
                fit, poor[rows] = posterior(
                    view.part(rows), before.part(rows), after.part(rows), wide.part(rows), self.draws * share
                )
                after = after.replaced(rows, fit)
        carried = after.mapped(reduced.end_rows, reduced.end_remainder).reduced(PROFILE.carried, PROFILE.free)
        return MixtureUpdate(
            after, after.gaussian, carried, new, modes.total_evidence, has_several(modes), poor & new.within_gate
        )


def has_several(modes: Modes, least: float = PROFILE.least_share) -> BoolArray:
    """Whether a second mode has at least this share of the posterior, (axes,)."""
    share = np.exp(modes.log_evidence - log_sum(modes.log_evidence, axis=1)[:, None])
    return np.asarray((share > least).sum(axis=1) > 1)


def explored(view: PixelView, prior: GaussianMixture) -> tuple[Modes, GaussianMixture]:
    """The modes for each component of the start state's prior, and the proposal density: a mixture to draw points from.

    The heaviest component is searched at length, the others from one start each. The modes' log-evidence includes the
    weights of the components.
    """
    before = view.reduced.prior(Gaussian(prior.mean, prior.covariance))
    axes, count, _ = before.mean.shape
    there = np.nonzero(np.isfinite(prior.log_weight))
    rows, own = view.part(there[0]), Gaussian(before.mean[there], before.covariance[there])
    wide = broad(rows, own)
    heaviest = np.argmax(prior.log_weight, axis=1)[there[0]] == there[1]
    found = modes_of(rows, own, wide, heaviest)
    found = found._replace(log_evidence=found.log_evidence + prior.log_weight[there][:, None])
    modes = Modes.none(axes, count * found.mean.shape[1], found.mean.shape[2])
    for room, each in zip(modes, found, strict=True):
        room.reshape(axes, count, *each.shape[1:])[there] = each
    modes = without_repeats(modes)
    flat = GaussianMixture(prior.log_weight, np.zeros_like(before.mean), np.zeros_like(before.covariance))
    flat.mean[there], flat.covariance[there] = wide.mean, wide.covariance
    return modes, proposed(GaussianMixture(modes.log_evidence, modes.mean, modes.covariance), flat)


def _wide_part(proposal: GaussianMixture, prior: GaussianMixture) -> GaussianMixture:
    """The Gaussians of windowed moments, the last ones of a proposal density, with the weights of the prior's."""
    count = prior.mean.shape[1]
    return GaussianMixture(prior.log_weight, proposal.mean[:, -count:], proposal.covariance[:, -count:])
