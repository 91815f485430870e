"""The likelihood of a recording's readings under a model of the disturbance.

A path theta = r + b + d has the known response r to the inputs, an unknown constant b for each output, and the
disturbance d, a Gaussian process. With y the means of the path over the exposures and s its mean squares about c, as
measured, p(y, s) = p(y) p(s | y).

p(y) is Gaussian, exactly, and taken over long runs of exposures. Given y of a block of consecutive exposures the path
is Gaussian, with mean m and covariance S, and s is a quadratic form of it: E s_j = mean of ((m - c)^2 + diag S), and
Cov(s_j, s_k) = 2 mean of S^2 + 4 mean of (m - c) S (m - c), over both exposures' steps; the third cumulant is as exact.
p(s | y) is taken as gamma distributions of these cumulants, with the pixels' noise, joined by the Gaussian copula of
their covariance: where a spot swings several times in an exposure, its mean square is an exponential variable. That,
and that s of a block depends on y of that block alone, is all that is not exact. What it costs is found by simulation
(`sets`), and the sets allow for it.

Sums over the steps of an exposure are Gauss's quadrature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, special

from aolink.estimation.model.quadrature import blocks, gauss
from aolink.identification.models import ProcessSum
from aolink.identification.readings import Readings
from aolink.numerics.arrays import BoolArray, FloatArray, Indices

_FEWEST_NODES = 12
_NODES_PER_CYCLE = 3.2
"""Nodes in an exposure for each cycle of the fastest process in it, beside half of the fewest."""
_WALK_START = 4.0
"""Variance of where a random walk starts in a block, in squares of half the field."""
_RUN = 128
"""Exposures whose means are taken together."""
_CELLS = np.linspace(0.0, 1.0, 41) ** 1.5
_SPAN = 5.0
"""Standard deviations that the cells of a gamma distribution reach to on the lower side; 1.6 times as far above."""
_LEAST_SKEWNESS, _MOST_SKEWNESS = 0.05, 2.8
_SMOOTH = 0.05
"""Of a gamma distribution, in standard deviations: where it begins it is not so right as it is steep."""
_RARE, _WIDE = 1e-3, 3.0
"""Share of a Gaussian so many times as wide that is in every distribution."""
_AT_ONCE = 128
"""Blocks that are computed together: what they need stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Readings cut into blocks, (blocks, L); blocks of one pattern of usable exposures."""

    usable: BoolArray
    """(L,)"""
    mean: FloatArray
    square: FloatArray
    square_noise: FloatArray
    centre: FloatArray
    response: FloatArray
    """At the nodes, (blocks, L, nodes)."""
    output: np.ndarray[tuple[int], np.dtype[np.int64]]
    """Which output each block is of."""


class Likelihood:
    """Log-likelihood of readings, for many models one after the other.

    Parameters
    ----------
    seen:
        The readings; those of all outputs have one model, each output being a draw of its own.
    length:
        Exposures in a block.
    """

    def __init__(self, seen: Readings, length: int) -> None:
        self.seen, self.length = seen, min(length, seen.slots)
        self._blocks: dict[int, list[Blocks]] = {}
        self._means: dict[int, list[tuple[BoolArray, Indices, FloatArray]]] = {}
        good = seen.usable
        self.mean_noise = float(seen.mean_noise[good].mean())
        """Variance of a mean by the pixels' noise, that of all exposures."""
        self.exposure_s = seen.n_steps * seen.step_s

    def with_response(self, response: FloatArray) -> Likelihood:
        """The same readings with another response to the inputs, (outputs, slots, N + 1)."""
        return Likelihood(replace(self.seen, response=response), self.length)

    def __call__(self, model: ProcessSum, noise: float = 1.0, wider: float = 0.0, nodes: int | None = None) -> float:
        """Log-likelihood, -inf where the model's covariance is none.

        Parameters
        ----------
        noise:
            Factor of the pixels' noise variance.
        wider:
            By how much the kernel's variance is larger than the rig file's, slope units squared.
        nodes:
            Nodes in an exposure; `nodes` of the model where None.
        """
        return float(self.of_outputs(model, noise, wider, nodes).sum())

    def of_outputs(
        self, model: ProcessSum, noise: float = 1.0, wider: float = 0.0, nodes: int | None = None
    ) -> FloatArray:
        """The log-likelihood of each output, (outputs,)."""
        nodes = nodes or self.nodes(model)
        out = np.zeros(len(self.seen.mean))
        try:
            constants = self._of_means(model, nodes, noise, out)
            for each in self._groups(nodes):
                joint = self._joint(model, nodes, each.usable, noise)
                np.add.at(out, each.output, joint.log_densities(each, constants[each.output], noise, wider))
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
        rule = blocks(n, n) if nodes >= n else gauss(n, nodes)
        return rule.rows, rule.weights

    def _groups(self, nodes: int) -> list[Blocks]:
        if nodes not in self._blocks:
            rows, _ = self._rule(nodes)
            seen, L = self.seen, self.length
            response = seen.response[:, :, :-1] @ rows.T
            patterns: dict[bytes, list[tuple[int, slice]]] = {}
            for o in range(len(seen.mean)):
                for first in range(0, seen.slots, L):
                    some = slice(first, min(first + L, seen.slots))
                    if seen.usable[o, some].any():
                        patterns.setdefault(seen.usable[o, some].tobytes(), []).append((o, some))
            self._blocks[nodes] = [
                Blocks(
                    usable=seen.usable[where[0]],
                    mean=_taken(seen.mean, where),
                    square=_taken(seen.square, where),
                    square_noise=_taken(seen.square_noise, where),
                    centre=_taken(seen.centre, where),
                    response=_taken(response, where),
                    output=np.array([o for o, _ in where]),
                )
                for where in patterns.values()
            ]
        return self._blocks[nodes]

    def _of_means(self, model: ProcessSum, nodes: int, noise: float, out: FloatArray) -> FloatArray:
        """Add the log-density of each output's means to ``out``; the constants of the outputs that make it largest."""
        rows, weights = self._rule(nodes)
        seen = self.seen
        at = np.asarray(rows @ np.arange(float(seen.n_steps))) * seen.step_s
        run = min(_RUN, seen.slots)
        begin = np.arange(float(run)) * (seen.period_steps * seen.step_s)
        table = np.zeros(run)
        for process in model.processes:
            if process.is_stationary:
                table[1:] += process.covariance_of_means(begin[1:], at, weights)
                table[0] += weights @ process.covariance(np.abs(at[:, None] - at)) @ weights
        sigma = linalg.toeplitz(table)
        if walk := _walk(model):
            inside = walk * (np.minimum(at[:, None], at) @ weights @ weights - weights @ at)
            sigma += walk * (np.minimum(begin[:, None], begin) + weights @ at) + _WALK_START * seen.reach**2
            sigma[np.diag_indices(run)] += inside
        top, count = np.zeros(len(out)), np.zeros(len(out))
        whitened = []
        for usable, output, y in self._runs(nodes, run):
            n = np.flatnonzero(usable)
            root = linalg.cholesky(
                sigma[np.ix_(n, n)] + noise * self.mean_noise * np.eye(len(n)), lower=True, check_finite=False
            )
            both = np.concatenate([y.T, np.ones((len(n), 1))], axis=1)
            both = linalg.solve_triangular(root, both, lower=True, check_finite=False)
            white, ones = both[:, :-1], both[:, -1]
            np.add.at(top, output, ones @ white)
            np.add.at(count, output, ones @ ones)
            scale = np.log(np.diagonal(root)).sum() + 0.5 * len(n) * math.log(2 * math.pi)
            whitened.append((output, white, ones, scale))
        constants = np.asarray(top / np.maximum(count, 1e-300))
        for output, white, ones, scale in whitened:
            left = white - ones[:, None] * constants[output]
            np.add.at(out, output, -0.5 * (left**2).sum(axis=0) - scale)
        return constants

    def _runs(self, nodes: int, run: int) -> list[tuple[BoolArray, Indices, FloatArray]]:
        """The means without the inputs' response in long runs: usable (run,), outputs (runs,), means (runs, good)."""
        if nodes not in self._means:
            rows, weights = self._rule(nodes)
            seen = self.seen
            y = seen.mean + seen.centre - (seen.response[:, :, :-1] @ rows.T) @ weights
            patterns: dict[bytes, list[tuple[int, slice]]] = {}
            for o in range(len(y)):
                for first in range(0, seen.slots, run):
                    some = slice(first, min(first + run, seen.slots))
                    if seen.usable[o, some].any():
                        patterns.setdefault(seen.usable[o, some].tobytes(), []).append((o, some))
            self._means[nodes] = [
                (seen.usable[where[0]], np.array([o for o, _ in where]),
                 np.array([y[each][seen.usable[each]] for each in where]))
                for where in patterns.values()
            ]  # fmt: skip
        return self._means[nodes]

    def _joint(self, model: ProcessSum, nodes: int, usable: BoolArray, noise: float) -> _Joint:
        rows, weights = self._rule(nodes)
        seen = self.seen
        at = np.asarray(rows @ np.arange(float(seen.n_steps))) * seen.step_s
        slots = np.arange(float(len(usable)))
        period = seen.period_steps * seen.step_s
        # Of equal lags only one each, then spread over all pairs of exposures.
        table = _stationary(model, slots * period, at)
        apart = (slots[:, None] - slots).astype(np.intp)
        C = table[np.abs(apart)]
        C = np.where((apart >= 0)[:, :, None, None], C, C.swapaxes(2, 3)).swapaxes(1, 2)
        if walk := _walk(model):
            times = (slots[:, None] * period + at).ravel()
            from_walk = walk * np.minimum(times[:, None], times) + _WALK_START * seen.reach**2
            C = C + from_walk.reshape(C.shape)
        return _Joint(np.ascontiguousarray(C), weights, usable, noise * self.mean_noise)


def _taken(values: FloatArray, where: Sequence[tuple[int, slice]]) -> FloatArray:
    """Stretches of equal lengths, each of an output, (stretches, ...)."""
    return np.array([values[at] for at in where])


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
    """Intensity of the random walks of a model together."""
    return sum(process["intensity"] for process in model.processes if not process.is_stationary)


class _Joint:
    """A block's path and readings as the model has them.

    Parameters
    ----------
    C:
        Covariance of the path at the nodes, (L, nodes, L, nodes).
    """

    def __init__(self, C: FloatArray, weights: FloatArray, usable: BoolArray, mean_noise: float) -> None:
        L, K = C.shape[:2]
        self.weights, self.good = weights, np.flatnonzero(usable)
        over = np.tensordot(weights, C, axes=(0, 1))[self.good]  # Cov(y_j, path), (good, L, K)
        sigma = (over @ weights)[:, self.good]
        sigma[np.diag_indices(len(sigma))] += mean_noise
        self.root = linalg.cholesky(sigma, lower=True, check_finite=False)
        flat = over.reshape(len(self.good), L * K)
        self.gain = linalg.solve_triangular(self.root, flat, lower=True, check_finite=False)
        self.S = C.reshape(L * K, L * K) - self.gain.T @ self.gain
        self.shape = (L, K)

    @cached_property
    def _from_variance(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """What S alone adds to the mean squares' mean (good,), covariance (good, good) and third cumulant (good,).

        Before the last: S of each exposure with itself, weighted, (good, nodes, nodes).
        """
        w, (L, K) = self.weights, self.shape
        diagonal = np.einsum("ii->i", self.S).reshape(L, K)[self.good] @ w
        squares = (self.S * self.S).reshape(L, K, L, K)
        spread = np.tensordot(np.tensordot(squares, w, axes=(3, 0)), w, axes=(1, 0))
        root_w = np.sqrt(w)
        own = self.S.reshape(L, K, L, K)[self.good, :, self.good] * root_w[:, None] * root_w
        cubes = 8 * np.einsum("jab,jba->j", own @ own, own)
        return diagonal, 2 * spread[np.ix_(self.good, self.good)], own, cubes

    def log_densities(self, data: Blocks, constants: FloatArray, noise: float, wider: float) -> FloatArray:
        """Log-density of each block's mean squares, given its means, (blocks,); ``constants`` b of each block."""
        good, w = self.good, self.weights
        y = data.mean - data.response @ w + data.centre - constants[:, None]
        white = linalg.solve_triangular(self.root, y[:, good].T, lower=True, check_finite=False)
        return self._squares(data, white, constants, noise, wider)

    def _squares(self, data: Blocks, white: FloatArray, b: FloatArray, noise: float, wider: float) -> FloatArray:
        L, K = self.shape
        good, w = self.good, self.weights
        m = (white.T @ self.gain).reshape(-1, L, K) + data.response + b[:, None, None] - data.centre[:, :, None]
        diagonal, spread, own, cubes = self._from_variance
        expected = (m[:, good] ** 2) @ w + diagonal + wider
        measured, read = data.square[:, good], noise * data.square_noise[:, good]
        out = np.empty(len(expected))
        S = self.S.reshape(L, K, L * K)[good]
        wm = (m * w)[:, good]
        root_w = np.sqrt(w)
        for first in range(0, len(out), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            rows = np.matmul(wm[some].swapaxes(0, 1), S).reshape(len(good), -1, L, K)[:, :, good]
            cross = np.einsum("jbkn,bkn->bjk", rows, wm[some], optimize=False)
            V = spread + 4 * cross
            variance = np.einsum("bjj->bj", V)
            pushed = np.matmul(own, (m[some][:, good] * root_w)[..., None])[..., 0]
            third = cubes + 24 * (pushed**2).sum(axis=2)
            density, z = _shifted_gamma(measured[some] - expected[some], variance, third, read[some])
            # Gaussian copula: the correlation of what is measured, noise and all.
            sd = np.sqrt(variance + read[some])
            C = V / (sd[:, :, None] * sd[:, None, :])
            C[:, np.arange(len(good)), np.arange(len(good))] = 1.0
            root = np.linalg.cholesky(C)
            left = np.linalg.solve(root, z[:, :, None])[..., 0]
            joint = -0.5 * (left**2).sum(axis=1) - np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
            out[some] = density.sum(axis=1) + joint + 0.5 * (z**2).sum(axis=1)
        return out


def _shifted_gamma(
    e: FloatArray, variance: FloatArray, third: FloatArray, read: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Log-density of a gamma variable, shifted to mean zero, with Gaussian noise; and the normal quantile of its value.

    Parameters
    ----------
    e:
        Values, any shape.
    variance, third:
        Second and third cumulant of the gamma variable, the latter above zero.
    read:
        Variance of the noise.
    """
    sd = np.sqrt(variance)
    skewness = np.clip(third / (variance * sd), _LEAST_SKEWNESS, _MOST_SKEWNESS)
    k = 4 / skewness**2
    # In standard deviations: from where the gamma variable begins, in equal cells.
    low = -2 / skewness
    begin = np.maximum(low, -_SPAN)
    edges = begin[..., None] + (_SPAN * 1.6 - begin)[..., None] * _CELLS
    below = special.gammainc(k[..., None], np.maximum((edges - low[..., None]) * (2 / skewness)[..., None], 0.0))
    mass = np.diff(below, axis=-1)
    places = (edges[..., 1:] + edges[..., :-1]) / 2
    # A cell is as good as a Gaussian of its width.
    width = np.sqrt((read / variance + _SMOOTH**2)[..., None] + np.diff(edges, axis=-1) ** 2 / 12)
    u = (e / sd)[..., None] - places
    bell = np.exp(-0.5 * (u / width) ** 2)
    density = (mass * bell / width).sum(axis=-1) / math.sqrt(2 * math.pi)
    share = (mass * special.ndtr(u / width)).sum(axis=-1) / mass.sum(axis=-1)
    # Far outside it falls off as a Gaussian of the whole variance does, not to nothing.
    whole = 1 + read / variance
    rare = _RARE * np.exp(-0.5 * (e / sd) ** 2 / (_WIDE**2 * whole)) / np.sqrt(2 * math.pi * _WIDE**2 * whole)
    z = special.ndtri(np.clip(share, 1e-6, 1 - 1e-6))
    return np.log((1 - _RARE) * density + rare) - np.log(sd), z
