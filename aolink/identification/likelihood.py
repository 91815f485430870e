"""The likelihood of a recording's readings under a model of the disturbance.

A path theta = r + b + d has the known response r to the inputs, an unknown constant b for each output, and the
disturbance d, a Gaussian process. With y the means of the path over the exposures and s its mean squares about c, as
measured, p(y, s) = p(y) p(s | y).

p(y) is Gaussian, exactly, and taken over long runs of exposures. Given y in a short run of exposures the path is
Gaussian, with mean m and covariance S, and each s_j is a quadratic form of it: its mean is that of (m - c)^2 + diag S
over the exposure's steps, its variance that of 2 S^2 + 4 (m - c) S (m - c) over pairs of them, and its third cumulant
is as exact. p(s | y) is taken as the product of gamma distributions of these cumulants, with the pixels' noise: where a
spot swings several times in an exposure, its mean square is an exponential variable. So it is a composite likelihood:
each factor is right or nearly so, but the dependence of the mean squares on each other, given y, is left out. The
effect of this is found by simulation (`sets`), and the sets allow for it.

Sums over the steps of an exposure are Gauss's quadrature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, special

from aolink.estimation.model.quadrature import equal_parts, gauss
from aolink.identification.models import ProcessSum
from aolink.identification.readings import Readings
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.numerics.single_thread import by_one_thread

_FEWEST_NODES = 12
_NODES_PER_CYCLE = 3.2
"""Nodes in an exposure for each cycle of the fastest process in it, beside half of the fewest."""
_WALK_START = 4.0
"""Variance of a random walk's start in a run of exposures, in squares of half the field."""
_LONG_RUN = 128
"""Exposures in a long run, whose means are taken together."""
_CELLS = np.linspace(0.0, 1.0, 41) ** 1.5
_SPAN = 5.0
"""Standard deviations that the cells of a gamma distribution reach to on the lower side; 1.6 times as far above."""
_LEAST_SKEWNESS, _MOST_SKEWNESS = 0.05, 2.8
_SMOOTH = 0.05
"""Smoothing of a gamma distribution, in standard deviations: at its lower end it is steep, but only an
approximation."""
_RARE, _WIDE = 1e-3, 3.0
"""The share of a wide Gaussian that is mixed into every distribution, and how many times as wide it is."""
_AT_ONCE = 128
"""Short runs that are computed together: their data stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class ShortRuns:
    """Readings divided into short runs of exposures, (runs, L), which all have the same pattern of usable exposures."""

    usable: BoolArray
    """(L,)"""
    output: np.ndarray[tuple[int], np.dtype[np.int64]]
    """The output of each run."""
    mean: FloatArray
    square: FloatArray
    square_noise: FloatArray
    centre: FloatArray
    response: FloatArray
    """Response to the inputs at the nodes, (runs, L, nodes)."""


class Likelihood:
    """Log-likelihood of readings, for many models one after the other, by equal short runs of at most ``length``
    exposures.

    All outputs of the readings have one model, of which each output is an independent draw.
    """

    def __init__(self, seen: Readings, length: int) -> None:
        self.seen, self.length = seen, -(-seen.slots // -(-seen.slots // length))
        self._short_runs: dict[int, list[ShortRuns]] = {}
        self._means: dict[int, list[tuple[BoolArray, Indices, FloatArray]]] = {}
        good = seen.usable
        self.mean_noise = float(seen.mean_noise[good].mean())
        """Variance of a mean by the pixels' noise, one value for all exposures."""
        self.exposure_s = seen.n_steps * seen.step_s

    def with_response(self, response: FloatArray) -> Likelihood:
        """The same readings with another response to the inputs, (outputs, slots, N + 1)."""
        return Likelihood(replace(self.seen, response=response), self.length)

    def __call__(self, model: ProcessSum, nodes: int | None = None) -> float:
        """Log-likelihood, -inf where the model gives no valid covariance.

        ``nodes`` is the number in an exposure; `nodes` of the model where None.
        """
        return float(self.of_outputs(model, nodes).sum())

    @by_one_thread
    def of_outputs(self, model: ProcessSum, nodes: int | None = None) -> FloatArray:
        """The log-likelihood of each output, (outputs,)."""
        nodes = nodes or self.nodes(model)
        out = np.zeros(len(self.seen.mean))
        try:
            constants = self._of_means(model, nodes, out)
            for each in self._in_short_runs(nodes):
                given = self._given_means(model, nodes, each.usable)
                np.add.at(out, each.output, given.log_densities(each, constants[each.output]))
        except linalg.LinAlgError:
            return np.full(len(out), -math.inf)
        return out if np.isfinite(out).all() else np.full(len(out), -math.inf)

    def nodes(self, model: ProcessSum) -> int:
        """Nodes in an exposure that the model's paths need."""
        fastest = max(float(np.abs(process.poles.imag).max()) for process in model.processes) / (2 * math.pi)
        wanted = math.ceil(_FEWEST_NODES / 2 + _NODES_PER_CYCLE * fastest * self.exposure_s)
        return min(max(_FEWEST_NODES, -(-wanted // 4) * 4), self.seen.n_steps)

    def _rule(self, nodes: int) -> tuple[FloatArray, FloatArray]:
        """Rows that give a path at the nodes, (nodes, N), and the nodes' weights."""
        n = self.seen.n_steps
        rule = equal_parts(n, n) if nodes >= n else gauss(n, nodes)
        return rule.rows, rule.weights

    def _in_short_runs(self, nodes: int) -> list[ShortRuns]:
        if nodes not in self._short_runs:
            seen, (rows, _) = self.seen, self._rule(nodes)
            response = seen.response[:, :, :-1] @ rows.T
            several = (seen.mean, seen.square, seen.square_noise, seen.centre, response)
            self._short_runs[nodes] = [
                ShortRuns(
                    seen.usable[w[0]], np.array([o for o, _ in w]), *(np.array([x[at] for at in w]) for x in several)
                )
                for w in self._alike(self.length)
            ]
        return self._short_runs[nodes]

    def _alike(self, length: int) -> list[list[tuple[int, slice]]]:
        """Runs of exposures, as output and slots, those with the same usable exposures together."""
        seen, patterns = self.seen, dict[bytes, list[tuple[int, slice]]]()
        for o in range(len(seen.mean)):
            for first in range(0, seen.slots, length):
                some = slice(first, min(first + length, seen.slots))
                if seen.usable[o, some].any():
                    patterns.setdefault(seen.usable[o, some].tobytes(), []).append((o, some))
        return list(patterns.values())

    def whitened_means(self, model: ProcessSum, nodes: int | None = None) -> list[FloatArray]:
        """The means of each long run of exposures as innovations: what the means before do not predict, over its
        standard deviation. White noise of variance one where the model is right; (good exposures,) each."""
        constants, runs = self._whitened(model, nodes or self.nodes(model))
        return [each for output, white, ones, _ in runs for each in (white - ones[:, None] * constants[output]).T]

    def _of_means(self, model: ProcessSum, nodes: int, out: FloatArray) -> FloatArray:
        """Add the log-density of each output's means to ``out``; the constants of the outputs that make it largest."""
        constants, runs = self._whitened(model, nodes)
        for output, white, ones, scale in runs:
            left = white - ones[:, None] * constants[output]
            np.add.at(out, output, -0.5 * (left**2).sum(axis=0) - scale)
        return constants

    def _whitened(
        self, model: ProcessSum, nodes: int
    ) -> tuple[FloatArray, list[tuple[Indices, FloatArray, FloatArray, float]]]:
        """The constants of the outputs that make the means' density largest; and of long runs that are alike the
        outputs, the whitened means (exposures, runs), whitened ones, and the logarithm of the densities' scale."""
        seen, (rows, weights) = self.seen, self._rule(nodes)
        at = np.asarray(rows @ np.arange(float(seen.n_steps))) * seen.step_s
        run = min(_LONG_RUN, seen.slots)
        begin = np.arange(float(run)) * (seen.period_steps * seen.step_s)
        table = np.zeros(run)
        for process in model.processes:
            if process.is_stationary:
                table[1:] += process.covariance_of_means(begin[1:], at, weights)
                table[0] += weights @ process.covariance(np.abs(at[:, None] - at)) @ weights
        sigma = linalg.toeplitz(table)
        if walk := _walk(model):
            within = walk * (np.minimum(at[:, None], at) @ weights @ weights - weights @ at)
            sigma += walk * (np.minimum(begin[:, None], begin) + weights @ at) + _WALK_START * seen.reach**2
            sigma[np.diag_indices(run)] += within
        top, count = np.zeros(len(seen.mean)), np.zeros(len(seen.mean))
        whitened = []
        for usable, output, y in self._in_long_runs(nodes, run):
            n = np.flatnonzero(usable)
            root = linalg.cholesky(
                sigma[np.ix_(n, n)] + self.mean_noise * np.eye(len(n)), lower=True, check_finite=False
            )
            both = np.concatenate([y.T, np.ones((len(n), 1))], axis=1)
            both = linalg.solve_triangular(root, both, lower=True, check_finite=False)
            white, ones = both[:, :-1], both[:, -1]
            np.add.at(top, output, ones @ white)
            np.add.at(count, output, ones @ ones)
            scale = np.log(np.diagonal(root)).sum() + 0.5 * len(n) * math.log(2 * math.pi)
            whitened.append((output, white, ones, scale))
        return np.asarray(top / np.maximum(count, 1e-300)), whitened

    def _in_long_runs(self, nodes: int, run: int) -> list[tuple[BoolArray, Indices, FloatArray]]:
        """The means without the inputs' response in long runs: usable (run,), outputs (runs,), means (runs, good)."""
        if nodes not in self._means:
            seen, (rows, weights) = self.seen, self._rule(nodes)
            y = seen.mean + seen.centre - (seen.response[:, :, :-1] @ rows.T) @ weights
            self._means[nodes] = [
                (seen.usable[where[0]], np.array([o for o, _ in where]),
                 np.array([y[each][seen.usable[each]] for each in where]))
                for where in self._alike(run)
            ]  # fmt: skip
        return self._means[nodes]

    def _given_means(self, model: ProcessSum, nodes: int, usable: BoolArray) -> _GivenMeans:
        seen, (rows, weights) = self.seen, self._rule(nodes)
        at = np.asarray(rows @ np.arange(float(seen.n_steps))) * seen.step_s
        begin = np.arange(float(len(usable))) * (seen.period_steps * seen.step_s)
        table = _stationary(model, begin, at)
        # Cov(y_i, path_j) depends on i - j alone, and on which of them is later.
        apart = np.arange(len(usable))[:, None] - np.arange(len(usable))
        earlier, later = (np.tensordot(weights, table, axes=(0, axis)) for axis in (2, 1))
        with_means = np.where((apart > 0)[:, :, None], later[np.abs(apart)], earlier[np.abs(apart)])
        inside = np.broadcast_to(table[0], (len(usable), *table.shape[1:]))
        if walk := _walk(model):
            times = begin[:, None] + at
            shared = np.minimum(times[:, :, None, None], times) + _WALK_START * seen.reach**2 / walk
            with_means = with_means + walk * np.tensordot(weights, shared, axes=(0, 1))
            inside = inside + walk * np.einsum("jajb->jab", shared)
        return _GivenMeans(with_means, inside, weights, usable, self.mean_noise)


def _stationary(model: ProcessSum, apart: FloatArray, at: FloatArray) -> FloatArray:
    """Covariances of the stationary processes at places ``at`` of an exposure with those of exposures ``apart``, s.

    ``apart`` (m,) begins with zero; (m, nodes, nodes), the later exposure's nodes first.
    """
    out = np.zeros((len(apart), len(at), len(at)))
    for process in model.processes:
        if process.is_stationary:
            out[0] += process.covariance(np.abs(at[:, None] - at))
            out[1:] += process.covariance_across(apart[1:], at)
    return out


def _walk(model: ProcessSum) -> float:
    """Sum of the intensities of a model's random walks."""
    return sum(process.walk for process in model.processes)


class _GivenMeans:
    """The path in a short run of exposures, given its means over them, from ``with_means``, Cov(y_i, path in exposure
    j), (L, L, nodes), and ``inside``, the covariance of the path in each exposure, (L, nodes, nodes)."""

    def __init__(
        self, with_means: FloatArray, inside: FloatArray, weights: FloatArray, usable: BoolArray, mean_noise: float
    ) -> None:
        self.weights, self.good = weights, np.flatnonzero(usable)
        over = with_means[np.ix_(self.good, self.good)]
        sigma = over @ weights
        sigma[np.diag_indices(len(sigma))] += mean_noise
        self.root = linalg.cholesky(sigma, lower=True, check_finite=False)
        flat = over.reshape(len(self.good), -1)
        gain = linalg.solve_triangular(self.root, flat, lower=True, check_finite=False)
        self.gain = gain.reshape(over.shape)
        S = inside[self.good] - np.einsum("ija,ijb->jab", self.gain, self.gain, optimize=True)
        root_w = np.sqrt(weights)
        self.S = S * root_w[:, None] * root_w
        """S of each exposure, multiplied by the square roots of the nodes' weights on both sides, (good, nodes,
        nodes)."""

    def log_densities(self, data: ShortRuns, constants: FloatArray) -> FloatArray:
        """Log-density of each run's mean squares, (runs,); ``constants`` b of each run."""
        good, w, S = self.good, self.weights, self.S
        y = data.mean - data.response @ w + data.centre - constants[:, None]
        white = linalg.solve_triangular(self.root, y[:, good].T, lower=True, check_finite=False)
        m = np.tensordot(white.T, self.gain, axes=1) + data.response[:, good]
        m = (m + (constants[:, None] - data.centre[:, good])[:, :, None]) * np.sqrt(w)
        pushed = np.matmul(S, m[..., None])[..., 0]
        first = (m * m).sum(axis=2) + np.einsum("jaa->j", S)
        second = 4 * (m * pushed).sum(axis=2) + 2 * (S * S).sum(axis=(1, 2))
        third = 24 * (pushed**2).sum(axis=2) + 8 * ((S @ S) * S).sum(axis=(1, 2))
        out = np.empty(len(first))
        for begin in range(0, len(out), _AT_ONCE):
            some = slice(begin, begin + _AT_ONCE)
            e = data.square[some][:, good] - first[some]
            out[some] = _shifted_gamma(e, second[some], third[some], data.square_noise[some][:, good]).sum(axis=1)
        return out


def _shifted_gamma(e: FloatArray, variance: FloatArray, third: FloatArray, read: FloatArray) -> FloatArray:
    """Log-density at e of a gamma variable, shifted to mean zero, with Gaussian noise of variance ``read``;
    ``variance`` and ``third`` are the gamma variable's second and third cumulant, the latter above zero."""
    sd = np.sqrt(variance)
    skewness = np.clip(third / (variance * sd), _LEAST_SKEWNESS, _MOST_SKEWNESS)
    k = 4 / skewness**2
    # Equal cells in standard deviations, beginning at the lower end of the gamma variable.
    low = -2 / skewness
    begin = np.maximum(low, -_SPAN)
    edges = begin[..., None] + (_SPAN * 1.6 - begin)[..., None] * _CELLS
    below = special.gammainc(k[..., None], np.maximum((edges - low[..., None]) * (2 / skewness)[..., None], 0.0))
    mass = np.diff(below, axis=-1)
    places = (edges[..., 1:] + edges[..., :-1]) / 2
    # A cell can be replaced by a Gaussian of its width.
    width = np.sqrt((read / variance + _SMOOTH**2)[..., None] + np.diff(edges, axis=-1) ** 2 / 12)
    u = (e / sd)[..., None] - places
    bell = np.exp(-0.5 * (u / width) ** 2)
    density = (mass * bell / width).sum(axis=-1) / math.sqrt(2 * math.pi)
    # Far outside it falls off as a Gaussian of the whole variance does, not to nothing.
    whole = 1 + read / variance
    apart, size = -0.5 * (e / sd) ** 2 / (_WIDE**2 * whole), np.sqrt(2 * math.pi * _WIDE**2 * whole)
    both = (1 - _RARE) * density + _RARE * np.exp(apart) / size
    # A density that is smaller than any double has a logarithm all the same.
    logarithm = np.where(both > 0, np.log(np.where(both > 0, both, 1.0)), np.log(_RARE / size) + apart)
    return np.asarray(logarithm - np.log(sd))
