"""The estimators `profile` and `mixture`: the posterior of the pixels as a Gaussian mixture that is carried on.

Modes are not Gaussian: the blur fixes how much a path moves and leaves open which way, and such a posterior is
bent. So the modes, and the wide Gaussians of windowed moments about them, only make the proposal density; the
posterior comes from importance weights (`aolink.estimation.pixels.importance`).

Where that is not enough (`aolink.estimation.pixels.importance`), points are tempered, as many for an axis as ``points``
says. If that is none, the fit stays as wide as its few effective points make it.

A mode that was lost is found again: a thousandth of the prior is the prediction without any measurement. Its modes are
searched where the NIS is larger than chance makes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.base import ExposureModel
from aolink.estimation.pixels.filter import MixtureUpdate
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, joined, log_sum, single
from aolink.estimation.pixels.importance import posterior, proposed, scattered, tempered
from aolink.estimation.pixels.likelihood import PixelView, Reduction, reduction
from aolink.estimation.pixels.modes import (
    Modes,
    broad,
    find_modes,
    innovation,
    modes_of,
    whitened,
    with_more,
    without_repeats,
)
from aolink.numerics.arrays import BoolArray
from aolink.optics.sensor import BaseSensor

# Share of the prior that is the prediction without any measurement; and how rarely chance makes it searched.
_DOUBT = 1e-3
_DOUBTED = 1e-3
# A posterior has several modes if a second one has this share of it. From a tenth of that many points are drawn, since
# the evidence of modes is rough.
_LEAST_SHARE = 0.05
_LEAST_DOUBTED_SHARE = 0.005


@dataclass(frozen=True)
class ImportanceUpdater:
    """Updates a Gaussian mixture by importance sampling about the modes of the posterior."""

    carried: int
    """Most components that are carried from exposure to exposure."""
    free: float
    """Components are merged further while a merger costs less than this, in nats."""
    share: float
    """Share of the usual number of points; and, where there is one mode, of the usual effective sample size."""

    points: int
    """Tempered points of an axis where the usual points are not enough; 0 for none."""

    def within(self, points: int | None) -> ImportanceUpdater:
        """The same with another number of tempered points, if not None."""
        return self if points is None else replace(self, points=points)

    @property
    def when_poor(self) -> str:
        """What it does where importance sampling is not enough, for the estimate's reason."""
        what = f"{self.points} points tempered" if self.points else "the estimate is wide"
        return f"too few importance weights count: {what}"

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        """The coefficients that it works with."""
        return reduction(model, sensor)

    def update(self, view: PixelView, prior: GaussianMixture, unseen: Gaussian, number: int) -> MixtureUpdate:
        """The posterior of axes with a prior of their start states."""
        reduced = view.reduced
        modes, proposal = explored(view, prior)
        own = reduced.prior(prior.gaussian)
        new = innovation(view, own, modes)
        lost = scattered(view, prior.log_weight, _wide_part(proposal, prior))
        doubted = np.flatnonzero(new.nis > 2 * special.gammainccinv(new.value.shape[1] / 2, _DOUBTED))
        if len(doubted):
            _, more = explored(view.part(doubted), single(unseen.part(doubted)))
            proposal = proposal.replaced(doubted, joined(proposal.part(doubted), more))
        rest = replace(prior, log_weight=prior.log_weight + math.log1p(-_DOUBT))
        doubt = replace(single(unseen), log_weight=np.full((len(unseen.mean), 1), math.log(_DOUBT)))
        before = joined(rest, doubt)
        usual = np.flatnonzero(~lost | (self.points == 0))
        after, poor = proposal, lost.copy()
        if len(usual):
            several = has_several(modes, _LEAST_DOUBTED_SHARE)
            if len(usual) == len(lost):
                after, good = posterior(view, before, proposal, self.share, several)
            else:
                some = view.part(usual)
                fit, good = posterior(some, before.part(usual), proposal.part(usual), self.share, several[usual])
                after = proposal.replaced(usual, fit)
            poor[usual] |= ~good & new.believed[usual]
        few = np.flatnonzero(poor)
        if len(few) and self.points:
            some = view.part(few)
            fit, best = tempered(some, before.part(few), self.points, number)
            after = after.replaced(few, fit)
            # The search may have missed the mode that fits.
            starts = whitened(own.part(few), best)
            modes = without_repeats(with_more(modes, few, find_modes(some, own.part(few), starts)))
            new = innovation(view, own, modes)
        carried = after.mapped(reduced.end_rows, reduced.end_remainder).reduced(self.carried, self.free)
        return MixtureUpdate(after.gaussian, carried, new, has_several(modes), poor)


PROFILE = ImportanceUpdater(carried=3, free=0.1, share=0.25, points=600)
MIXTURE = ImportanceUpdater(carried=6, free=1e-3, share=1.0, points=1200)


def has_several(modes: Modes, least: float = _LEAST_SHARE) -> BoolArray:
    """Whether a second mode has at least this share of the posterior, (axes,)."""
    share = np.exp(modes.log_evidence - log_sum(modes.log_evidence, axis=1)[:, None])
    return np.asarray((share > least).sum(axis=1) > 1)


def explored(view: PixelView, prior: GaussianMixture) -> tuple[Modes, GaussianMixture]:
    """The modes for each component of the start state's prior, and the proposal density: a mixture to draw points from.

    The modes' log-evidence includes the weights of the components.
    """
    before = view.reduced.prior(Gaussian(prior.mean, prior.covariance))
    axes, count, _ = before.mean.shape
    there = np.nonzero(np.isfinite(prior.log_weight))
    rows, own = view.part(there[0]), Gaussian(before.mean[there], before.covariance[there])
    wide = broad(rows, own)
    found = modes_of(rows, own, wide)
    found = replace(found, log_evidence=found.log_evidence + prior.log_weight[there][:, None])
    modes = Modes.none(axes, count * found.mean.shape[1], found.mean.shape[2])
    for room, each in zip(modes.arrays, found.arrays, strict=True):
        room.reshape(axes, count, *each.shape[1:])[there] = each
    modes = without_repeats(modes)
    flat = Gaussian(np.zeros_like(before.mean), np.zeros_like(before.covariance))
    flat.mean[there], flat.covariance[there] = wide.mean, wide.covariance
    return modes, proposed(modes.log_evidence, Gaussian(modes.mean, modes.covariance), prior.log_weight, flat)


def _wide_part(proposal: GaussianMixture, prior: GaussianMixture) -> Gaussian:
    """The Gaussians of windowed moments in a proposal density, the last ones: one for each component of the prior."""
    count = prior.mean.shape[1]
    return Gaussian(proposal.mean[:, -count:], proposal.covariance[:, -count:])
