"""Modes of the posterior of all pixels by Levenberg and Marquardt's method, from several starts; Laplace's evidence.

The objective is -log p(t | pixels) with t whitened by its prior, s = L^-1 (t - m): |s|^2 / 2 minus the pixels'
log-likelihood, with Fisher's information instead of the Hessian. At a mode its inverse is the covariance, and
(Laplace) the log-evidence is log p(y | s) - |s|^2 / 2 - log |H| / 2.

A search starts at the posterior of windowed moments, and others start from there along the directions in which that
leaves the path most uncertain: a path and its reversal in time give the same blur.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from aolink.estimation.compiled import modes as compiled_modes
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.pixels.gaussian_mixture import log_sum
from aolink.estimation.pixels.levenberg_marquardt import FIRST_DAMPING, FREE_DAMPING, LARGEST_DAMPING
from aolink.estimation.pixels.likelihood import PixelView
from aolink.numerics.arrays import BoolArray, FloatArray, Indices

WIDE_PATH = 0.5
"""Variance of the path, in variances of the kernel, above which a search starts along more than one direction."""
DIRECTIONS = 3
"""Most directions: those that leave the path most uncertain."""
START_REACH = 1.3
"""Distance of a start from the mean, in standard deviations: near enough to be likely, far enough to lead to another
mode."""
REVERSED_TO = 0.2
"""A start for a reversed path fits it to this many standard deviations of the kernel, if the prior allows."""
PASSES = 16
"""Most steps of a search, which bounds the work."""
CONVERGED = 0.03
"""Nats by which the objective still changes at a mode."""
APART = 0.7
"""Modes that are nearer to each other than this many standard deviations count as one."""


class Modes(NamedTuple):
    """Modes of the posterior, (axes, starts, ...)."""

    mean: FloatArray
    covariance: FloatArray
    log_evidence: FloatArray
    """Laplace's log-evidence, without the prior weight, (axes, starts); minus infinity for a mode that is not there."""
    total: FloatArray
    """The pixels' chi-square plus |s|^2, the squared distance from the prior, (axes, starts)."""
    residual: FloatArray
    """The pixels' chi-square plus the number of coefficients that they determine, n - tr(H^-1), (axes, starts): on
    average the number of pixels."""
    objective: FloatArray
    """-log p(s, y) up to a constant, (axes, starts)."""

    @classmethod
    def none(cls, axes: int, count: int, n: int) -> Modes:
        """Room for a number of modes, none of which is there yet."""
        nothing, never = np.zeros((axes, count)), np.full((axes, count), np.inf)
        return cls(np.zeros((axes, count, n)), np.zeros((axes, count, n, n)), -never, nothing, nothing.copy(), never)

    @property
    def total_evidence(self) -> FloatArray:
        """Log-evidence of all modes together, (axes,)."""
        return log_sum(self.log_evidence, axis=1)

    @property
    def best(self) -> Indices:
        """Index of the mode of least objective, (axes,)."""
        return np.asarray(np.argmin(self.objective, axis=1))


def find_modes(
    view: PixelView, prior: Gaussian, starts: FloatArray, of_axis: Indices | None = None, *, reversals: bool = False
) -> Modes:
    """The mode that each start, in whitened coordinates, (axes, starts, n), leads to, with this prior of each axis.

    ``of_axis`` says how many of the starts count, (axes,); None for all. With ``reversals``, three more searches begin
    where the path has the same blur as that of the best mode: reversed in time, mirrored about its mean, and both; an
    axis of one start has none.
    """
    axes, count, n = starts.shape
    of_axis = np.full(axes, count) if of_axis is None else of_axis
    precision = precision_of_reversal(view) if reversals else 0.0
    found = Modes.none(axes, count + (3 if reversals else 0), n)
    compiled_modes.find_modes(
        view.seen, np.ascontiguousarray(prior.mean), np.ascontiguousarray(prior.covariance),
        np.ascontiguousarray(starts), of_axis, view.whole_nodes, precision, PASSES, FIRST_DAMPING,
        LARGEST_DAMPING, FREE_DAMPING, CONVERGED, *found,
    )  # fmt: skip
    return found


def modes_of(view: PixelView, prior: Gaussian, by_moments: Gaussian, at_length: BoolArray) -> Modes:
    """The modes of a posterior; ``by_moments`` is the posterior of windowed moments, from which searches start.

    A search starts at its mean and, where it is to be ``at_length``, (axes,), at points on both sides of it
    (`spread_starts`). After their modes come those that the best mode's reversal and mirror images lead to.
    """
    starts, squares = spread_starts(view, prior, by_moments)
    many = at_length & (squares[:, 0] > WIDE_PATH * view.kernel_variance)
    of_axis = np.where(many, starts.shape[1], np.where(at_length, 3, 1))
    return find_modes(view, prior, starts, of_axis, reversals=True)


def without_repeats(modes: Modes) -> Modes:
    """The modes without those that an earlier start has led to; the remaining ones come first."""
    mean, covariance, *rest = kept = [each.copy() for each in modes]
    most = compiled_modes.drop_repeats(mean, covariance, APART, *rest)
    return Modes(*(each[:, : max(most, 1)] for each in kept))


def spread_starts(view: PixelView, prior: Gaussian, by_moments: Gaussian) -> tuple[FloatArray, FloatArray]:
    """The mean of that posterior and points on both sides of it along the path's most uncertain directions.

    They are (axes, 1 + 2 directions, n), in coordinates in which the prior is N(0, I): the mean, and a pair for each
    direction. The second result is the mean square of the path along each direction at one standard deviation, the
    largest first, (axes, n).
    """
    axes, n = by_moments.mean.shape
    starts, squares = np.empty((axes, 1 + 2 * min(DIRECTIONS, n), n)), np.empty((axes, n))
    gaussians = (prior.mean, prior.covariance, by_moments.mean, by_moments.covariance)
    compiled_modes.spread_starts(
        *map(np.ascontiguousarray, gaussians), view.gram, START_REACH, starts, squares,
    )  # fmt: skip
    return starts, squares


def precision_of_reversal(view: PixelView) -> float:
    """Precision with which a path is fitted to the reversal of another, one over slope units squared."""
    return 1 / (REVERSED_TO**2 * view.kernel_variance)
