"""The estimator `sampled`: tempered sequential Monte Carlo. It is slow, for offline use; the limit of all other
estimators.

Less of the path is left out than for the others; the nodes in time are those of `profile`.
"""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np

from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.base import ExposureModel
from aolink.estimation.pixels.filter import MixtureUpdate
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, stacked_axes
from aolink.estimation.pixels.likelihood import PixelView, Reduction, reduction
from aolink.estimation.pixels.modes import find_modes, innovation, whitened, without_repeats
from aolink.estimation.pixels.moves import affordable
from aolink.estimation.pixels.profile import has_several
from aolink.estimation.pixels.tempering import Particles, fitted, tempered_points
from aolink.numerics import batched
from aolink.numerics.single_thread import by_one_thread
from aolink.optics.sensor import BaseSensor

# Rms of the path that is left out, in standard deviations of the kernel.
_LEFT_OUT = 0.05
_COMPONENTS = 8
# Searches for modes start at the means of so many, the heaviest.
_SEARCHED = 3


@dataclass(frozen=True, eq=False)
class TemperedUpdater:
    """An updater that draws the particles of one axis after another; a mixture of Gaussians is fitted to their end
    states."""

    particles: int | None = None
    seed: int = 0

    def reduction(self, model: ExposureModel, sensor: BaseSensor) -> Reduction:
        return reduction(model, sensor, left_out=_LEFT_OUT)

    def update(self, view: PixelView, prior: GaussianMixture, unseen: Gaussian) -> MixtureUpdate:
        t, evidence = self.sample(view, prior)
        reduced, before = view.reduced, view.reduced.prior(prior.gaussian)
        mean = t.mean(axis=1)
        away = t - mean[:, None]
        with by_one_thread:
            after = Gaussian(mean, batched.matmul(batched.transpose(away), away) / (t.shape[1] - 1))
        fit = stacked_axes([fitted(points, reduced.end_rows, _COMPONENTS, self.seed) for points in t])
        # With one Gaussian as the prior: components of a mixture that overlap would count as modes of their own.
        starts = whitened(before, fit.ordered(_SEARCHED).mean)
        modes = without_repeats(find_modes(view, before, starts, reversals=True))
        new = innovation(view, before, modes)
        carried = fit.mapped(reduced.end_rows, reduced.end_remainder)
        return MixtureUpdate(fit, after, carried, new, evidence, has_several(modes), np.zeros(len(mean), dtype=bool))

    def sample(self, view: PixelView, prior: GaussianMixture) -> Particles:
        """Particles of the posterior from the prior of the start state; the noise coefficients have N(0, I).

        The estimator's seed, the axis and its pixels seed the random numbers, so that they do not depend on how many
        exposures came before.
        """
        keys = [(self.seed, axis, crc32(y.tobytes())) for axis, y in zip(view.axes.tolist(), view.y, strict=True)]
        rough = view.rough()
        return tempered_points(rough, prior, self.particles or affordable(rough), keys)
