"""Modes of the posterior of all pixels by Levenberg and Marquardt's method, from several starts; Laplace's evidence.

The objective is -log p(t | pixels) with t whitened by its prior, s = L^-1 (t - m): |s|^2 / 2 minus the pixels'
log-likelihood, with Fisher's information instead of the Hessian. At a mode its inverse is the covariance, and
(Laplace) the log-evidence is log p(y | s) - |s|^2 / 2 - log |H| / 2.

A search starts at the posterior of windowed moments, and others start from there along the directions in which that
leaves the path most uncertain: a path and its reversal in time give the same blur. Where the path moves by more than
the kernel is wide a mode is not Gaussian, so mean and covariance are those of points drawn about the modes
(`importance`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from aolink.estimation.compiled import modes as compiled_modes
from aolink.estimation.frames.frame_data import Profile
from aolink.estimation.kalman.filter import GATE_PROBABILITY
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.update import joseph_update
from aolink.estimation.moments.lines import updated
from aolink.estimation.pixels.constants import PROFILE
from aolink.estimation.pixels.filter import Innovation
from aolink.estimation.pixels.gaussian_mixture import log_sum
from aolink.estimation.pixels.levenberg_marquardt import FIRST_DAMPING, FREE_DAMPING, LARGEST_DAMPING
from aolink.estimation.pixels.likelihood import PixelView
from aolink.numerics import batched
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.numerics.covariance import cholesky, lower_inverse

_NO_NOISE = 1e-14


class Modes(NamedTuple):
    """Modes of the posterior, (axes, starts, ...)."""

    mean: FloatArray
    covariance: FloatArray
    log_evidence: FloatArray
    """Laplace's log-evidence, without the prior weight, (axes, starts); minus infinity for a mode that is not there."""
    distance: FloatArray
    """|s|^2, squared distance from the prior, (axes, starts)."""
    objective: FloatArray
    """-log p(s, y) up to a constant, (axes, starts)."""

    @classmethod
    def none(cls, axes: int, count: int, n: int) -> Modes:
        """Room for a number of modes, none of which is there yet."""
        nothing, never = np.zeros((axes, count)), np.full((axes, count), np.inf)
        return cls(np.zeros((axes, count, n)), np.zeros((axes, count, n, n)), -never, nothing, never)

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
        np.ascontiguousarray(starts), of_axis, view.whole_nodes, precision, PROFILE.passes, FIRST_DAMPING,
        LARGEST_DAMPING, FREE_DAMPING, PROFILE.converged, *found,
    )  # fmt: skip
    return found


def modes_of(view: PixelView, prior: Gaussian, wide: Gaussian, at_length: BoolArray) -> Modes:
    """The modes of a posterior; ``wide`` is the posterior of windowed moments, from which searches start.

    A search starts at its mean and, where it is to be ``at_length``, (axes,), at points on both sides of it
    (`spread_starts`). After their modes come those that the best mode's reversal and mirror images lead to.
    """
    starts, squares = spread_starts(view, prior, wide)
    many = at_length & (squares[:, 0] > PROFILE.wide_path * view.kernel_variance)
    of_axis = np.where(many, starts.shape[1], np.where(at_length, 3, 1))
    return find_modes(view, prior, starts, of_axis, reversals=True)


def without_repeats(modes: Modes) -> Modes:
    """The modes without those that an earlier start has led to; the remaining ones come first."""
    mean, covariance, *rest = kept = [each.copy() for each in modes]
    most = compiled_modes.drop_repeats(mean, covariance, PROFILE.apart, *rest)
    return Modes(*(each[:, : max(most, 1)] for each in kept))


def broad(view: PixelView, prior: Gaussian) -> Gaussian:
    """The prior of t updated with windowed moments: wide where the posterior has several modes."""
    if view.on_line:
        assert isinstance(view.measured, Profile)
        return updated(
            view.optics.profile, view.nodes, prior, view.measured, np.ones(len(prior.mean)), PROFILE.broad_passes
        )
    about = prior
    for _ in range(PROFILE.broad_passes):
        y, noise, fit = view.moments(about)
        innovation = y - fit.expected - batched.matvec(fit.slope, prior.mean - about.mean)
        # A window without a pixel that can be used has neither moments nor noise.
        spread = noise + fit.remainder + _NO_NOISE * np.eye(y.shape[1])
        about = joseph_update(prior, innovation, fit.slope, spread).posterior
    return about


def spread_starts(view: PixelView, prior: Gaussian, wide: Gaussian) -> tuple[FloatArray, FloatArray]:
    """The mean of a wide Gaussian and points on both sides of it along the path's most uncertain directions.

    They are (axes, 1 + 2 directions, n), in coordinates in which the prior is N(0, I): the mean, and a pair for each
    direction. The second result is the mean square of the path along each direction at one standard deviation, the
    largest first, (axes, n).
    """
    axes, n = wide.mean.shape
    starts, squares = np.empty((axes, 1 + 2 * min(PROFILE.directions, n), n)), np.empty((axes, n))
    compiled_modes.spread_starts(
        *(np.ascontiguousarray(each) for each in (prior.mean, prior.covariance, wide.mean, wide.covariance)),
        view.gram, PROFILE.start_reach, starts, squares,
    )  # fmt: skip
    return starts, squares


def precision_of_reversal(view: PixelView) -> float:
    """Precision with which a path is fitted to the reversal of another, one over slope units squared."""
    return 1 / (PROFILE.reversed_to**2 * view.kernel_variance)


def whitened(prior: Gaussian, points: FloatArray) -> FloatArray:
    """Points (axes, k, n) in coordinates in which the prior is N(0, I)."""
    inverse = lower_inverse(cholesky(prior.covariance))
    return batched.matmul(points - prior.mean[:, None], batched.transpose(inverse))


def innovation(view: PixelView, prior: Gaussian, modes: Modes) -> Innovation:
    """Innovation of the pixels linearised at the best mode, in units of their noise.

    With A = R^(-1/2) J L = U S V', the pixels' innovation has variance 1 + S^2 along U's columns, and 1 elsewhere.
    """
    rows = np.arange(len(modes.mean)), modes.best
    t, distance = modes.mean[rows], modes.distance[rows]
    axes, n = t.shape
    k = min(PROFILE.new_directions * view.outputs, n)
    u, values, nis, square = np.empty((axes, k)), np.empty((axes, k)), np.empty(axes), np.empty(axes)
    compiled_modes.innovations(
        view.seen, np.ascontiguousarray(prior.mean), np.ascontiguousarray(prior.covariance), t,
        PROFILE.no_information, u, values, nis, square,
    )  # fmt: skip
    # At the truth this is chi-square of all pixels and coefficients, and where the objective is least it is less.
    total = square + distance
    degrees = np.add.reduce(view.mask, axis=1) + n
    within_gate = total <= 2 * special.gammainccinv(degrees / 2, GATE_PROBABILITY)
    covariance = (1 + values)[..., None] * np.eye(k)
    return Innovation(u, covariance, nis, within_gate & np.isfinite(nis))
