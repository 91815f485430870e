"""Gaussian mixtures, one for each axis: the batch axis first, the components second."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled import mixtures as compiled_mixtures
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.numerics.arrays import FloatArray, Indices

_LEAST_LOG_WEIGHT = math.log(1e-12)


class GaussianMixture(NamedTuple):
    """A mixture of Gaussians for each axis."""

    log_weight: FloatArray
    """(axes, components), normalised; minus infinity for a component that is not there."""
    mean: FloatArray
    """(axes, components, n)"""
    covariance: FloatArray
    """(axes, components, n, n)"""

    def part(self, axes: slice | Indices) -> GaussianMixture:
        """The part of these axes."""
        return GaussianMixture(*(each[axes] for each in self))

    def copy(self) -> GaussianMixture:
        """A copy, each of whose arrays is contiguous in memory."""
        return GaussianMixture(*(np.array(each, order="C") for each in self))

    def weighted(self, share: float | FloatArray) -> GaussianMixture:
        """The mixture with its weights multiplied by a share, one for all axes or one each."""
        with np.errstate(divide="ignore"):
            return self._replace(log_weight=self.log_weight + np.log(share)[..., None])

    @property
    def gaussian(self) -> Gaussian:
        """Mean and covariance of the mixture."""
        axes, _, n = self.mean.shape
        out = Gaussian(np.empty((axes, n)), np.empty((axes, n, n)))
        compiled_mixtures.moments(*self.contiguous, out.mean, out.covariance)
        return out

    def mapped(self, rows: FloatArray, remainder: FloatArray) -> GaussianMixture:
        """The mixture of M t + e: M is ``rows`` (m, n), e independent of t with covariance ``remainder`` (m, m)."""
        after = Gaussian(self.mean, self.covariance).mapped(rows, remainder)
        return GaussianMixture(self.log_weight, after.mean, after.covariance)

    @property
    def contiguous(self) -> list[FloatArray]:
        """Log-weights, means and covariances, each contiguous in memory, as compiled code takes them."""
        return [np.ascontiguousarray(each) for each in self]

    def reduced(self, most: int, free: float = 0.0) -> GaussianMixture:
        """The mixture reduced to ``most`` components, or fewer if mergers cost less than ``free``.

        Repeatedly, the two components whose merger costs least are merged. The cost is Runnalls' bound on the
        Kullback-Leibler divergence, in nats; a merger keeps mean and covariance. Runnalls, Kullback-Leibler approach to
        Gaussian mixture reduction, IEEE Trans. AES 43 (2007), (21).

        Components of a weight below 1e-12 are dropped. On an unstable plant their means move away without end, and the
        farther away they are the more their merger costs, so that they would stay.
        """
        merged = self.copy()
        merged.log_weight[merged.log_weight < _LEAST_LOG_WEIGHT] = -np.inf
        compiled_mixtures.merge(*merged.contiguous, most, free)
        return merged.ordered(most)

    def moved(self, by: FloatArray) -> GaussianMixture:
        """The mixture with all components moved by a vector of each axis, (axes, n)."""
        return self._replace(mean=self.mean + by[:, None])

    @classmethod
    def stacked(cls, mixtures: Sequence[GaussianMixture]) -> GaussianMixture:
        """Mixtures of different axes, one after the other."""
        most = max(each.mean.shape[1] for each in mixtures)
        return cls(*map(np.concatenate, zip(*(each.with_components(most) for each in mixtures), strict=True)))

    def with_components(self, count: int) -> GaussianMixture:
        """The mixture with ``count`` components, those after its own with weight zero."""
        more = count - self.mean.shape[1]
        if more <= 0:
            return self
        log_weight = np.concatenate([self.log_weight, np.full((len(self.mean), more), -np.inf)], axis=1)
        mean, covariance = (
            np.concatenate([each, np.repeat(each[:, :1], more, axis=1)], axis=1)
            for each in (self.mean, self.covariance)
        )
        return GaussianMixture(log_weight, mean, covariance)

    def replaced(self, axes: Indices, by: GaussianMixture) -> GaussianMixture:
        """The mixtures with those of these axes replaced."""
        if not len(axes):
            return self
        count = max(self.mean.shape[1], by.mean.shape[1])
        out, new = self.with_components(count).copy(), by.with_components(count)
        for room, each in zip(out, new, strict=True):
            room[axes] = each
        return out

    def ordered(self, most: int | None = None) -> GaussianMixture:
        """The mixture with the heaviest components first, and without columns in which all weights are zero."""
        order = np.argsort(-self.log_weight, axis=1, kind="stable")[:, :most]
        rows = np.arange(len(order))[:, None]
        kept = self.log_weight[rows, order]
        count = max(1, int(np.isfinite(kept).sum(axis=1).max(initial=1)))
        order = order[:, :count]
        return GaussianMixture(kept[:, :count], self.mean[rows, order], self.covariance[rows, order])


def single(gaussian: Gaussian) -> GaussianMixture:
    """A mixture of one component."""
    return GaussianMixture(np.zeros((len(gaussian.mean), 1)), gaussian.mean[:, None], gaussian.covariance[:, None])


def log_sum(values: FloatArray, axis: int) -> FloatArray:
    """log sum exp along an axis; minus infinity where all are."""
    top = np.maximum.reduce(values, axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        # One after the other, so that terms of weight zero change no bit.
        total = np.take(np.add.accumulate(np.exp(values - top), axis=axis), -1, axis=axis)
        return np.asarray(np.log(total) + np.squeeze(top, axis=axis))
