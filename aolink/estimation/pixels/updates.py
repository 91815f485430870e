"""The estimators `profile` and `mixture`: the posterior of the pixels is a Gaussian mixture, which is carried from
exposure to exposure.

Modes are not Gaussian: the blur determines how much a path moves but not in which direction, and such a posterior is
curved. So the modes, and the wide Gaussians of windowed moments about them, only make the proposal density; the
posterior comes from importance weights (`aolink.estimation.pixels.importance`).

Where that is not enough (`aolink.estimation.pixels.importance`), points are tempered, as many for an axis as ``points``
says. So they are, by an updater that ``tempers_several``, wherever a posterior has several modes and the rig is one
where importance sampling is too sure without showing it (`aolink.estimation.assumptions.importance_is_too_sure`); where
missed modes stay lost there, `profile` is `mixture` (`aolink.estimation.filters`). If ``points`` is none, the fit stays
as wide as its few effective points make it.

Some hundred points miss modes as well, and more of them the more coefficients there are. So a share of the posterior
remains the Gaussians of the windowed moments, whose covariance is wide enough. Each has the weight of the prior's
component that it comes from, or, where the frame may rule it out, of the points about it. With as many points as pairs
of coefficients, or fewer, this share is one, and no point is tempered; nor, where importance sampling is too sure and
missed modes stay lost, with fewer than twice as many. Importance sampling about the points then weighs the modes that
they have found; where its effective sample size is enough, a quarter of that share is left. Where modes that were
missed would stay lost for long (`aolink.estimation.assumptions.modes_stay_lost`), `profile` leaves half of it, and
`mixture`, whose share is half as large, all. Points at which the fit has nearly no density keep their share of the
posterior. This is not done where importance sampling is too sure.

A mode that was lost is found again: a thousandth of the prior is the prediction without any measurement. Its modes are
searched for where the NIS is larger than chance explains.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.base import ExposureModel
from aolink.estimation.moments.windowed import MOST_MEMORY, error_memory, slowest
from aolink.estimation.pixels.filter import MixtureUpdate
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, joined, log_sum, single
from aolink.estimation.pixels.importance import beside_points, posterior, proposed, scattered, tempered, with_missed
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
from aolink.numerics import batched
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.optics.sensor import BaseSensor

# Share of the prior that is the prediction without any measurement; and the probability by chance of searching its
# modes.
_DOUBT = 1e-3
_DOUBTED = 1e-3
# A posterior has several modes if a second one has this share of it. From a tenth of that many points are drawn, since
# the evidence of modes is rough.
_LEAST_SHARE = 0.05
_LEAST_DOUBTED_SHARE = 0.005
# Posteriors are not tempered for having several modes if the windowed moments would have this share of them; nor are
# others where importance sampling is too sure and missed modes stay lost.
_MOST_MISSED = 0.5
# Share of the posterior that importance sampling about tempered points may have missed, relative to what the points
# alone may have, where missed modes are soon found again.
_LEFT = 0.25


@dataclass(frozen=True)
class ImportanceUpdater:
    """Updates a Gaussian mixture by importance sampling about the modes of the posterior."""

    carried: int
    """Most components that are carried from exposure to exposure."""
    free: float
    """Components are merged further while a merger costs less than this, in nats."""
    share: float
    """Share of the usual number of points, and of the usual effective sample size, where the posterior has one mode."""

    points: int
    """Tempered points of an axis where the usual points are not enough; 0 for none."""
    several: float = 1.0
    """The same share where the posterior has several modes: with fewer points, random errors of the modes' weights
    would add up from exposure to exposure."""
    left_lost: float = 1.0
    """Share of the posterior that importance sampling about tempered points may have missed, relative to what the
    points alone may have, where modes stay lost."""
    enough: float = 100.0
    """The usual effective sample size: with less than half of it, points are tempered."""
    tempers_several: bool = False
    """Whether points are tempered wherever there are several modes, on a rig where importance sampling is often too
    sure."""
    too_sure: bool = False
    """Whether the rig is such a one."""
    stay_lost: bool = False
    """Whether modes that were missed stay lost for long on the rig."""

    def within(self, points: int | None, share: float, *, too_sure: bool, stay_lost: bool) -> ImportanceUpdater:
        """The same with another number of tempered points, if not None, and a share of the others, for a rig where
        importance sampling is often too sure, or another one, and where modes that were missed stay lost, or not."""
        points = self.points if points is None else points
        several, share = share * self.several, share * self.share
        return replace(self, points=points, share=share, several=several, too_sure=too_sure, stay_lost=stay_lost)

    @property
    def left(self) -> float:
        """Share of what tempered points may have missed that importance sampling about them may have missed too."""
        return self.left_lost if self.stay_lost else _LEFT

    def _hands_over(self, reduced: Reduction) -> bool:
        """Whether all posteriors with several modes are tempered: where there are points enough for that."""
        return self.too_sure and self.tempers_several and self._missed(reduced) < _MOST_MISSED

    def _tempers(self, reduced: Reduction) -> bool:
        """Whether there are enough points for tempering to be better than windowed moments."""
        return self._missed(reduced) < (_MOST_MISSED if self.too_sure and self.stay_lost else 1.0)

    def remarks(self, several: BoolArray, poor: BoolArray, reduced: Reduction) -> Iterator[tuple[BoolArray, str]]:
        yield poor, self._when_poor(reduced)
        if self.too_sure:
            missed = "another path may have been missed, as often on this rig: intervals may be too narrow"
            yield several & ~poor, missed

    def _when_poor(self, reduced: Reduction) -> str:
        """Its action where importance sampling is not enough."""
        missed = self._missed(reduced)
        if not self.points:
            what = "the estimate is wider for it, and may still miss a path"
        elif self._tempers(reduced):
            at_most = "up to " if self.left < 1 and not self.too_sure else ""
            what = (
                f"{self.points} others were sought at length (tempered), and {at_most}{missed:.0%} of the estimate is"
                " as wide as that of moments, in case they miss one"
            )
        else:
            what = "the estimate is as wide as that of moments"
        enough = "the usual search for paths is not enough on this rig"
        return f"{enough if self._hands_over(reduced) else 'too few of the paths tried fit the blur'}: {what}"

    def _missed(self, reduced: Reduction) -> float:
        """The share of a posterior that tempered points may have missed: the number of pairs of coefficients for each
        point."""
        return reduced.size**2 / self.points if self.points else 1.0

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        return reduction(model, sensor)

    def update(self, view: PixelView, prior: GaussianMixture, unseen: Gaussian, number: int) -> MixtureUpdate:
        reduced = view.reduced
        modes, proposal = explored(view, prior)
        own = reduced.prior(prior.gaussian)
        new = innovation(view, own, modes)
        wide = _wide_part(proposal, prior)
        lost = scattered(view, wide)
        if self._hands_over(reduced):
            lost |= has_several(modes, _LEAST_DOUBTED_SHARE)
        doubted = np.flatnonzero(new.nis > 2 * special.gammainccinv(new.value.shape[1] / 2, _DOUBTED))
        if len(doubted):
            anew = single(unseen.part(doubted))
            _, more = explored(view.part(doubted), anew)
            proposal = proposal.replaced(doubted, joined(proposal.part(doubted), more))
            wide = wide.replaced(doubted, joined(wide.part(doubted), _wide_part(more, anew)))
        rest = prior._replace(log_weight=prior.log_weight + math.log1p(-_DOUBT))
        before = joined(rest, single(unseen).weighted(_DOUBT))
        usual = np.flatnonzero(~lost | (self.points == 0))
        after, poor = proposal, lost.copy()
        several = has_several(modes, _LEAST_DOUBTED_SHARE)[usual]
        for which, share in ((usual[~several], self.share), (usual[several], self.several)):
            if len(which):
                fit, good = posterior(view.part(which), before.part(which), proposal.part(which), share, self.enough)
                after = after.replaced(which, fit)
                poor[which] |= ~good & new.within_gate[which]
        few = np.flatnonzero(poor)
        if len(few) and self.points:
            some = view.part(few)
            if self._tempers(reduced):
                # Where the spot is bright, a frame rules most of the wide Gaussians out. But one about which no point
                # lies may be that of a mode that was missed: where that would stay lost, it keeps the prior's weight.
                by_share = np.flatnonzero((self._hands_over(reduced) and not self.stay_lost) | np.isin(few, doubted))
                fit, best = self._tempered(some, before.part(few), proposal.part(few), wide.part(few), by_share, number)
                # The search may have missed the mode that fits.
                starts = whitened(own.part(few), best)
                modes = without_repeats(with_more(modes, few, find_modes(some, own.part(few), starts)))
                new = innovation(view, own, modes)
            else:
                fit = _remembering(some, prior.part(few), wide.part(few))
            after = after.replaced(few, fit)
        carried = after.mapped(reduced.end_rows, reduced.end_remainder).reduced(self.carried, self.free)
        return MixtureUpdate(after, after.gaussian, carried, new, modes.total_evidence, has_several(modes), poor)

    def _tempered(
        self, view: PixelView, prior: GaussianMixture, proposal: GaussianMixture, wide: GaussianMixture,
        by_share: Indices, number: int,
    ) -> tuple[GaussianMixture, FloatArray]:  # fmt: skip
        """The posterior by tempered points, and a share of the wide Gaussians, which have weights of their own on the
        axes ``by_share``; and the most likely point, (axes, 1, n)."""
        points = tempered(view, prior, self.points, number)
        wide = wide.replaced(by_share, _by_share_of(points.fit.part(by_share), wide.part(by_share)))
        missed = self._missed(view.reduced)
        fit = joined(points.fit.weighted(1 - missed), wide.weighted(missed))
        if not self.too_sure:
            weighed, good = posterior(view, prior, beside_points(proposal, points.fit), 1.0, self.enough)
            weighed = with_missed(weighed, points, view.reduced.end_rows)
            missed *= self.left
            better = joined(weighed.weighted(1 - missed), wide.weighted(missed))
            fit = fit.replaced(np.flatnonzero(good), better.part(np.flatnonzero(good)))
        return fit, points.best


PROFILE = ImportanceUpdater(carried=12, free=0.01, share=0.25, points=600, left_lost=0.5)
MIXTURE = ImportanceUpdater(carried=12, free=1e-3, share=1.0, points=1200, tempers_several=True)


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


def _remembering(view: PixelView, prior: GaussianMixture, wide: GaussianMixture) -> GaussianMixture:
    """The wide Gaussians, those of the prior's components computed again with errors that the plant remembers.

    Where they are the whole posterior, the errors of their linearisation are alike from exposure to exposure, and count
    as in `aolink.estimation.moments.windowed`.
    """
    there = np.nonzero(np.isfinite(prior.log_weight))
    seen, own = view.part(there[0]), view.reduced.prior(Gaussian(prior.mean[there], prior.covariance[there]))
    rows, n = view.reduced.end_rows, prior.mean.shape[2]
    rho = np.repeat(slowest(rows[None, :, :n]), len(own.mean))
    first = broad(seen, own, error_memory(rho, MOST_MEMORY))
    kept = batched.matmul(first.covariance, batched.inverse(own.covariance))[:, :, :n]  # I - K H
    goes_on = slowest(batched.matmul(np.broadcast_to(rows, (len(kept), *rows.shape)), kept))
    after, found = broad(seen, own, error_memory(np.sqrt(rho * goes_on), MOST_MEMORY)), wide.copy()
    found.mean[there], found.covariance[there] = after.mean, after.covariance
    return found


def _by_share_of(points: GaussianMixture, wide: GaussianMixture) -> GaussianMixture:
    """The wide Gaussians, each weighted by the share of the points' mixture that lies nearest to it.

    This is for axes of which a frame may rule some of the wide Gaussians out, as where the prior is in doubt.
    """
    there = np.isfinite(wide.log_weight)
    covariance = np.where(there[..., None, None], wide.covariance, np.eye(wide.mean.shape[2]))
    logs = wide._replace(covariance=covariance).component_log_densities(points.mean)
    share = np.exp(logs - log_sum(logs, axis=1)[:, None]) * np.exp(points.log_weight)[:, None]
    with np.errstate(divide="ignore"):
        return wide._replace(log_weight=np.log(share.sum(axis=2)))
