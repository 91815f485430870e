"""The posterior as a mixture of Gaussians: the modes that `profile` finds, weighted, corrected and carried on.

Modes are not Gaussian: the blur fixes how much a path moves and leaves open which way, and such a posterior is
bent. So the modes, and the wide Gaussians of windowed moments about them, are where points are drawn from only;
what counts is the points' weights (`aolink.estimation.importance`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.exposure_model import ExposureModel
from aolink.estimation.hypotheses import Hypotheses, log_sum
from aolink.estimation.hypothesis_filter import Update
from aolink.estimation.importance import posterior, proposed
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

_CARRIED = 6
# Mergers that lose less than this, in nats, cost nothing that matters.
_FREE = 1e-3
_START_DIRECTIONS = 1
_START_REACH = 1.3


class MixtureUpdates:
    """A mixture in, a mixture out."""

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        """The coefficients that it works with."""
        return reduction(model, sensor)

    def update(self, view: PixelView, prior: Hypotheses, number: int) -> Update:
        """The posterior of axes with a prior of their start states."""
        reduced = view.reduced
        modes, proposal = explored(view, prior)
        after = posterior(view, prior, proposal, number)
        new = innovation(view, reduced.prior(prior.belief), modes)
        end = reduced.end(Belief(after.mean, after.covariance))
        carried = Hypotheses(after.log_weight, end.mean, end.covariance).reduced(_CARRIED, _FREE)
        share = np.exp(modes.log_evidence - log_sum(modes.log_evidence, axis=1)[:, None])
        return Update(after.belief, carried, new, (share > LEAST_SHARE).sum(axis=1) > 1)


def explored(view: PixelView, prior: Hypotheses) -> tuple[Modes, Hypotheses]:
    """The modes that each component of a prior of the start state leads to, and a mixture to draw points from.

    The modes' log-evidence has the weights of the components in it.
    """
    before = view.reduced.prior(Belief(prior.mean, prior.covariance))
    axes, count, _ = before.mean.shape
    there = np.nonzero(np.isfinite(prior.log_weight))
    rows, each = view.part(there[0]), Belief(before.mean[there], before.covariance[there])
    wide = broad(rows, each)
    starts = spread_starts(rows, wide, _START_DIRECTIONS, _START_REACH)
    found = with_reversals(rows, each, find_modes(rows, each, whitened(each, starts)))
    of_each = found.mean.shape[1]
    found = replace(found, log_evidence=found.log_evidence + prior.log_weight[there][:, None])

    def placed(values: FloatArray, empty: float) -> FloatArray:
        out = np.full((axes, count, *values.shape[1:]), empty)
        out[there] = values
        return out.reshape(axes, count * of_each, *values.shape[2:])

    modes = without_repeats(
        Modes(
            placed(found.mean, 0.0), placed(found.covariance, 0.0), placed(found.log_evidence, -math.inf),
            placed(found.distance, 0.0), placed(found.objective, math.inf),
        )
    )  # fmt: skip
    flat = Belief(np.zeros_like(before.mean), np.zeros_like(before.covariance))
    flat.mean[there], flat.covariance[there] = wide.mean, wide.covariance
    return modes, proposed(modes.log_evidence, Belief(modes.mean, modes.covariance), prior.log_weight, flat)
