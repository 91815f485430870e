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
from aolink.estimation.compiled.line import Line
from aolink.estimation.frames.frame_data import Profile
from aolink.estimation.kalman.filter import GATE_PROBABILITY
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.update import joseph_update
from aolink.estimation.moments.lines import updated
from aolink.estimation.pixels.constants import PROFILE
from aolink.estimation.pixels.filter import Innovation
from aolink.estimation.pixels.gaussian_mixture import log_sum
from aolink.estimation.pixels.levenberg_marquardt import FIRST_DAMPING, FREE_DAMPING, LARGEST_DAMPING, Points, minimise
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

    @property
    def best_mean(self) -> FloatArray:
        """That mode, (axes, 1, n)."""
        return np.asarray(self.mean[np.arange(len(self.mean)), self.best][:, None])


def find_modes(view: PixelView, prior: Gaussian, starts: FloatArray) -> Modes:
    """The mode that each start, in whitened coordinates, (axes, starts, n), leads to, with this prior of each axis."""
    axes, count, n = starts.shape
    if (line := view.line) is not None:
        return found_compiled(line, prior, starts, np.full(axes, count), 0, 0.0)
    rows = view.part(np.repeat(np.arange(axes), count))
    m, L = np.repeat(prior.mean, count, axis=0)[:, None], cholesky(np.repeat(prior.covariance, count, axis=0))

    def at(s: FloatArray, which: Indices) -> Points:
        return _at(rows.part(which), m[which], L[which], s)

    s, found = minimise(at, starts.reshape(-1, n), PROFILE.passes, PROFILE.converged)
    covariance = batched.congruence(L, batched.symmetric(np.asarray(np.linalg.inv(found.hessian), dtype=np.float64)))
    _, log_H = np.linalg.slogdet(found.hessian)
    evidence = -found.objective - 0.5 * log_H
    mean = m[:, 0] + batched.matvec(L, s)
    shape = (axes, count)
    return Modes(
        mean.reshape(*shape, n), batched.symmetric(covariance).reshape(*shape, n, n), evidence.reshape(shape),
        batched.dot(s, s).reshape(shape), found.objective.reshape(shape),
    )  # fmt: skip


def found_compiled(
    line: Line, prior: Gaussian, starts: FloatArray, of_axis: Indices, whole: int, reversed_precision: float
) -> Modes:
    """`find_modes` for line sensors, in compiled code."""
    axes, count, n = starts.shape
    count += 3 if reversed_precision else 0
    found = Modes.none(axes, count, n)
    compiled_modes.find_modes_of_lines(
        line, np.ascontiguousarray(prior.mean), np.ascontiguousarray(prior.covariance), np.ascontiguousarray(starts),
        of_axis, whole, reversed_precision, PROFILE.passes, FIRST_DAMPING, LARGEST_DAMPING, FREE_DAMPING,
        PROFILE.converged, *found,
    )  # fmt: skip
    return found


def modes_of(view: PixelView, prior: Gaussian, wide: Gaussian, at_length: BoolArray) -> Modes:
    """The modes of a posterior; ``wide`` is the posterior of windowed moments, from which searches start.

    A search starts at its mean and, where it is to be ``at_length``, (axes,), at points on both sides of it
    (`spread_starts`). After their modes come those that the best mode's reversal and mirror images lead to.
    """
    starts, squares = spread_starts(view, prior, wide)
    many = at_length & (squares[:, 0] > PROFILE.wide_path * view.kernel_variance)
    if (line := view.line) is not None:
        of_axis = np.where(many, starts.shape[1], np.where(at_length, 3, 1))
        return found_compiled(line, prior, starts, of_axis, view.whole_nodes, precision_of_reversal(view))
    found = find_modes(view, prior, starts[:, :1])
    for which, some in ((at_length, starts[:, 1:3]), (many, starts[:, 3:])):
        if len(rows := np.flatnonzero(which)):
            found = with_more(found, rows, find_modes(view.part(rows), prior.part(rows), some[rows]))
    if len(rows := np.flatnonzero(at_length)):
        back = reversed_starts(view.part(rows), prior.part(rows), found.best_mean[rows])
        found = with_more(found, rows, find_modes(view.part(rows), prior.part(rows), back))
    return found


def with_reversals(view: PixelView, prior: Gaussian, found: Modes) -> Modes:
    """Modes, and after them those that the best one's reversal and mirror images lead to."""
    back = reversed_starts(view, prior, found.best_mean)
    return with_more(found, slice(None), find_modes(view, prior, back))


def _at(rows: PixelView, m: FloatArray, L: FloatArray, s: FloatArray) -> Points:
    """Information, gradient and objective at whitened coordinates, one start a row."""
    f, J = rows.linearised(m + batched.matvec(L, s)[:, None])
    score, information = rows.information(f)
    J = batched.long_matmul(J[:, 0], L)
    H = batched.long_matmul(batched.transpose(J) * information, J) + np.eye(s.shape[1])
    g = batched.matvec(batched.transpose(J), score[:, 0]) - s
    return Points(0.5 * batched.dot(s, s) - rows.log_likelihood(f)[:, 0], g, batched.symmetric(H))


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
    if view.on_line:
        starts, squares = np.empty((axes, 1 + 2 * min(PROFILE.directions, n), n)), np.empty((axes, n))
        compiled_modes.spread_starts_of_lines(
            *(np.ascontiguousarray(each) for each in (prior.mean, prior.covariance, wide.mean, wide.covariance)),
            view.gram, PROFILE.start_reach, starts, squares,
        )  # fmt: skip
        return starts, squares
    L = cholesky(wide.covariance)
    values, V = np.linalg.eigh(batched.symmetric(batched.matmul(batched.transpose(L), batched.matmul(view.gram, L))))
    V = batched.transpose(V[:, :, ::-1])
    along = batched.matmul(V[:, : PROFILE.directions], batched.transpose(L)) * PROFILE.start_reach
    mean = wide.mean[:, None]
    pairs = np.stack([mean + along, mean - along], axis=2).reshape(axes, -1, n)
    return whitened(prior, np.concatenate([mean, pairs], axis=1)), values[:, ::-1]


def precision_of_reversal(view: PixelView) -> float:
    """Precision with which a path is fitted to the reversal of another, one over slope units squared."""
    return 1 / (PROFILE.reversed_to**2 * view.kernel_variance)


def reversed_starts(view: PixelView, prior: Gaussian, points: FloatArray) -> FloatArray:
    """Whitened coordinates of paths with the same blur as those of points, (axes, k, n) -> (axes, 3 k, n).

    The paths are reversed in time, which gives the same blur; mirrored about their mean, which gives the same blur
    where it is symmetric, as that of a vibration is; and both.
    """
    L, m = cholesky(prior.covariance), prior.mean
    nodes, outputs = view.whole_nodes, view.outputs
    rows = view.rows.reshape(outputs, -1, view.reduced.size)[:, :nodes].reshape(outputs * nodes, -1)
    weights = view.nodes.weights[:nodes] / view.nodes.weights[:nodes].sum()
    precision = np.tile(weights, outputs) * precision_of_reversal(view)
    B = batched.matmul(np.broadcast_to(rows, (len(L), *rows.shape)), L)
    path = view.paths(points)[..., :nodes]
    mirrored = 2 * (path @ weights)[..., None] - path
    like = np.concatenate([path[..., ::-1], mirrored, mirrored[..., ::-1]], axis=1)
    back = like.reshape(len(like), -1, outputs * nodes)
    away = back - view.paths(m[:, None])[..., :nodes].reshape(-1, 1, outputs * nodes)
    weighted = B * precision[:, None]
    H = batched.matmul(batched.transpose(weighted), B) + np.eye(B.shape[-1])
    right = batched.matmul(away, weighted)
    return np.asarray(np.linalg.solve(H, batched.transpose(right)).swapaxes(-1, -2))


def with_more(modes: Modes, axes: slice | Indices, more: Modes) -> Modes:
    """The same modes, and after them those that more starts of some axes led to."""
    spread = Modes.none(len(modes.mean), *more.mean.shape[1:])
    for room, new in zip(spread, more, strict=True):
        room[axes] = new
    return Modes(*(np.concatenate(each, axis=1) for each in zip(modes, spread, strict=True)))


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
    if (line := view.line) is not None:
        u, values, nis, square = np.empty((axes, k)), np.empty((axes, k)), np.empty(axes), np.empty(axes)
        compiled_modes.innovations_of_lines(
            line, np.ascontiguousarray(prior.mean), np.ascontiguousarray(prior.covariance), t,
            PROFILE.no_information, u, values, nis, square,
        )  # fmt: skip
    else:
        u, values, nis, square = _innovations(view, prior, t, k)
    # At the truth this is chi-square of all pixels and coefficients, and where the objective is least it is less.
    total = square + distance
    degrees = np.add.reduce(view.mask, axis=1) + n
    within_gate = total <= 2 * special.gammainccinv(degrees / 2, GATE_PROBABILITY)
    covariance = (1 + values)[..., None] * np.eye(k)
    return Innovation(u, covariance, nis, within_gate & np.isfinite(nis))


def _innovations(
    view: PixelView, prior: Gaussian, t: FloatArray, k: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Innovations at points t (axes, n) in k directions: values, S^2, NIS, and e'e with e = R^(-1/2) (y - f)."""
    L, s = cholesky(prior.covariance), whitened(prior, t[:, None])[:, 0]
    f, J = view.linearised(t[:, None])
    score, information = (each[:, 0] for each in view.information(f))
    root = np.sqrt(information)
    A = batched.matmul(J[:, 0] * root[..., None], L)
    e = score / np.where(root > 0, root, 1.0)
    values, V = np.linalg.eigh(batched.matmul(batched.transpose(A), A))
    values, V = np.maximum(values[:, ::-1][:, :k], 0.0), V[:, :, ::-1][:, :, :k]
    S = np.sqrt(values)
    # The innovation is zero in a direction about which the pixels have no information.
    tells = values > PROFILE.no_information * values[:, :1]
    pull = batched.matvec(batched.transpose(batched.matmul(A, V)), e)
    u = np.where(tells, pull / np.where(tells, S, 1.0), 0.0) + S * batched.matvec(batched.transpose(V), s)
    return u, values, np.add.reduce(u * u / (1 + values), axis=1), batched.dot(e, e)
