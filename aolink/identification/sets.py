"""Confidence sets: for each parameter a set that holds the truth with a probability of 95 %, in one or more pieces.

The set is that of the values whose profile log-likelihood, the highest with that value, is below the highest of all by
less than 1.92 a. With the true likelihood a = 1 (Wilks). `likelihood` treats dependent exposures as independent and
some distributions that are not Gaussian as Gaussian, so that a is the ratio of the parameter's true variance, H^-1 J
H^-1, to the H^-1 that the curvature H shows (Kent, Biometrika 69 (1982)); J is the covariance of the gradient at the
maximum over recordings that the model makes (`simulate`). An alias is a maximum of its own, far from the highest: it is
in the set as well if recordings that it makes itself put it as far below the highest one in a twentieth of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aolink.identification.likelihood import Likelihood
from aolink.identification.readings import Readings
from aolink.identification.search import SHORT_RUN, Maximum, Space
from aolink.identification.simulate import simulated
from aolink.numerics.arrays import FloatArray

QUANTILE = 3.841
"""Quantile of chi-square with one degree of freedom, at 95 %."""
_DRAWS = 96
_MOST = 8
"""The most local maxima that are considered."""
_BELOW = 12.0
"""The most by which they are lower than the given first one, nats."""
_STEP = 0.02
_WIDEST = 3.0
"""Longest single step along a profile, in the logarithm of the parameter."""
_SIDES = 12
_NEWTON = 5
_CLOSE = 0.1
"""Accuracy to which an end of a piece is found, nats."""


@dataclass(frozen=True)
class Piece:
    """An interval of a set."""

    low: float
    high: float
    best: float
    """The value in it with the highest likelihood."""
    open_low: bool
    """Whether ``low`` is the limit of what was searched, not an end of the set."""
    open_high: bool


@dataclass(frozen=True)
class Identified:
    """The set of one parameter."""

    name: str
    best: float
    pieces: tuple[Piece, ...]
    """The pieces from low to high; more than one where the exposures leave aliases."""
    factor: float
    """The factor a."""

    def holds(self, value: float) -> bool:
        """Whether the set has a value."""
        return any(
            (each.low <= value or each.open_low) and (value <= each.high or each.open_high) for each in self.pieces
        )

    def within(self, intervals: Sequence[tuple[float, float]]) -> Identified:
        """The part of the set that lies in these intervals, which may overlap; the whole set where none of it does."""
        pieces = [
            Piece(
                low, high, min(max(each.best, low), high), each.open_low and low == each.low,
                each.open_high and high == each.high,
            )
            for each in self.pieces
            for low, high in ((max(each.low, low), min(each.high, high)) for low, high in intervals)
            if low <= high
        ]  # fmt: skip
        return replace(self, pieces=_joined(pieces) or self.pieces)

    def at(self, value: float) -> Identified:
        """The set with another best value, which the pixels prefer; its nearest piece is extended to hold it."""
        distances = [max(each.low - value, value - each.high) for each in self.pieces]
        nearest = distances.index(min(distances))
        pieces = tuple(
            replace(each, low=min(each.low, value), high=max(each.high, value), best=value) if k == nearest else each
            for k, each in enumerate(self.pieces)
        )
        return replace(self, best=value, pieces=pieces)


def identified(
    space: Space, found: Sequence[Maximum], seen: Sequence[Readings], tell: Callable[[int], None] | None = None
) -> tuple[Identified, ...]:
    """The sets of all parameters, from the local maxima, the best first: the highest, or the one that the pixels prefer
    (`pixels`)."""
    of = [Likelihood(each, SHORT_RUN) for each in seen]
    top = found[0]
    curvature = _curvature(space, top, of)
    factors = _factors(space, top, seen, curvature)
    found = [each for each in found[:_MOST] if each.log_likelihood > top.log_likelihood - _BELOW]
    allowed = [0.0, *(_allowed(space, top, each, seen) for each in found[1:])]
    curvatures, own = [curvature], [factors]
    for number, each in enumerate(found[1:], 1):
        near = top.log_likelihood - each.log_likelihood < max(QUANTILE / 2 * factors.max(), allowed[number])
        curvatures.append(_curvature(space, each, of) if near else curvature)
        own.append(_factors(space, each, seen, curvatures[-1]) if near else factors)
    out = []
    for k, name in enumerate(space.names):
        if tell:
            tell(k)
        pieces = []
        for number, each in enumerate(found):
            least = top.log_likelihood - max(QUANTILE / 2 * factors[k], allowed[number])
            if each.log_likelihood > least:
                # An alias that may be the truth is as uncertain as its own curvature and factor make it.
                least = min(least, each.log_likelihood - QUANTILE / 2 * own[number][k])
                pieces.append(_piece(space, each, k, least, of, curvatures[number]))
        out.append(Identified(name, math.exp(top.x[k]), _joined(pieces), float(factors[k])))
    return tuple(out)


def _allowed(space: Space, top: Maximum, other: Maximum, seen: Sequence[Readings]) -> float:
    """The most by which ``other`` is below the highest maximum if it is the truth, nats, except in 1 of 20 cases."""
    below = np.zeros(_DRAWS)
    for number, each in enumerate(seen):
        likelihood = _drawn(space, other.x, each, number)
        for sign, at in ((1, top), (-1, other)):
            below += sign * _of_draws(space, at.x, likelihood, at.nodes)
    return float(np.quantile(below, 0.95))


def _drawn(space: Space, x: FloatArray, seen: Readings, seed: int) -> Likelihood:
    """The likelihood of `_DRAWS` recordings like ``seen`` that a model makes."""
    own = replace(seen, response=space.response(x, seen))
    return Likelihood(simulated(own, space.model(x), _DRAWS, seed, space.sensor(x)), SHORT_RUN)


def _of_draws(space: Space, x: FloatArray, drawn: Likelihood, nodes: int) -> FloatArray:
    """Log-likelihood of a model in each of these recordings, (draws,)."""
    values = space.driven(x, drawn, _DRAWS).of_outputs(space.model(x), space.sensor(x), nodes)
    return np.asarray(values.reshape(_DRAWS, -1).sum(axis=1))


def _curvature(space: Space, at: Maximum, of: Sequence[Likelihood]) -> FloatArray:
    """H, minus the matrix of second derivatives, made positive."""
    n = len(at.x)
    steps = _STEP * np.eye(n)
    # Steps of about half a nat: below, rounding shows; above, the curvature changes.
    for k in range(n):
        drop = at.log_likelihood - _value(space, at, at.x + steps[k], of)
        steps[k] *= float(np.clip(math.sqrt(0.5 / max(drop, 1e-6)), 0.02, 10))
    value = {}

    def log_likelihood(*moves: int) -> float:
        key = tuple(sorted(moves))
        if key not in value:
            value[key] = _value(space, at, at.x + sum(math.copysign(1, m) * steps[abs(m) - 1] for m in moves), of)
        return value[key]

    H = np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            a, b = i + 1, j + 1
            if i == j:
                left = log_likelihood(a) + log_likelihood(-a) - 2 * at.log_likelihood
                H[i, i] = -left / steps[i, i] ** 2
            else:
                left = log_likelihood(a, b) + log_likelihood(-a, -b) - log_likelihood(a, -b) - log_likelihood(-a, b)
                H[i, j] = H[j, i] = -left / (4 * steps[i, i] * steps[j, j])
    return _positive(H)


def _value(space: Space, at: Maximum, x: FloatArray, of: Sequence[Likelihood]) -> float:
    inside = np.clip(x, *np.array(space.bounds).T)
    value = space.log_likelihood(inside, of, at.nodes)
    return value if math.isfinite(value) else at.log_likelihood - 1e3


def _positive(H: FloatArray) -> FloatArray:
    """H with its eigenvalues that are not positive, or hardly known, raised to a curvature that carries as little
    information."""
    scale = np.sqrt(np.maximum(np.abs(np.diagonal(H)), 1e-2))
    values, vectors = np.linalg.eigh((H + H.T) / 2 / np.outer(scale, scale))
    return np.asarray((vectors * np.maximum(values, 1e-3)) @ vectors.T * np.outer(scale, scale))


def _factors(space: Space, top: Maximum, seen: Sequence[Readings], H: FloatArray) -> FloatArray:
    """The factor a of each parameter, at least one."""
    n = len(top.x)
    low, high = np.array(space.bounds).T
    J = np.zeros((n, n))
    for number, each in enumerate(seen):
        likelihood = _drawn(space, top.x, each, number)
        scores = np.empty((n, _DRAWS))
        for k in range(n):
            h = 0.1 / math.sqrt(H[k, k])
            ends = [np.clip(top.x + sign * h * np.eye(n)[k], low, high) for sign in (1, -1)]
            two = [_of_draws(space, x, likelihood, top.nodes) for x in ends]
            scores[k] = (two[0] - two[1]) / (ends[0][k] - ends[1][k])
        J += np.atleast_2d(np.cov(np.nan_to_num(scores)))
    inverse = np.linalg.inv(H)
    ratio = np.diagonal(inverse @ J @ inverse) / np.diagonal(inverse)
    return np.maximum(ratio, 1.0)


def _piece(space: Space, at: Maximum, k: int, least: float, of: Sequence[Likelihood], H: FloatArray) -> Piece:
    """The interval of parameter ``k`` about a local maximum in which the profile is above ``least``."""
    others = [j for j in range(len(at.x)) if j != k]
    follow = -np.linalg.solve(H[np.ix_(others, others)], H[others, k]) if others else np.zeros(0)
    sd = math.sqrt(np.linalg.inv(H)[k, k])
    low, high = space.bounds[k]
    ends, opens = [], []
    for sign, bound in ((-1, low), (1, high)):
        x, depth = at.x.copy(), at.log_likelihood - least
        # Along a profile the root of the loss is nearly a straight line.
        inside, step = 0.0, min(sd * math.sqrt(2 * depth), _WIDEST)
        loss_inside, outside = 0.0, math.inf
        moved, opened = 0.0, False
        for _ in range(_SIDES):
            moved = min(inside + step, abs(bound - at.x[k]))
            start = x.copy()
            start[k] = at.x[k] + sign * moved
            start[others] = np.clip(x[others] + follow * (start[k] - x[k]), *np.array(space.bounds)[others].T)
            there, value = _highest(space, at, start, others, H, of)
            loss = at.log_likelihood - value
            if abs(loss - depth) < _CLOSE:
                break
            if loss < depth:
                inside, loss_inside, x = moved, max(loss, 0.0), there
                if moved >= abs(bound - at.x[k]):
                    opened = True
                    break
                if outside < math.inf:
                    step = (outside - inside) / 2
                else:
                    slope = math.sqrt(loss_inside) / max(inside, 1e-12)
                    step = min(max(math.sqrt(depth) / max(slope, 1e-12) - inside, 0.2 * inside), 2 * inside, _WIDEST)
            else:
                outside = moved
                slope = (math.sqrt(loss) - math.sqrt(loss_inside)) / (outside - inside)
                step = (math.sqrt(depth) - math.sqrt(loss_inside)) / slope
                step = float(np.clip(step, 0.1 * (outside - inside), 0.9 * (outside - inside)))
        ends.append(math.exp(at.x[k] + sign * moved))
        opens.append(opened)
    return Piece(ends[0], ends[1], math.exp(at.x[k]), *opens)


def _highest(
    space: Space, at: Maximum, start: FloatArray, others: list[int], H: FloatArray, of: Sequence[Likelihood]
) -> tuple[FloatArray, float]:
    """The maximum of the likelihood over the other parameters, and its value, by Newton's method with curvature H."""
    x, value = start, _value(space, at, start, of)
    if not others:
        return x, value
    low, high = np.array(space.bounds)[others].T
    inside = H[np.ix_(others, others)]
    for _ in range(_NEWTON):
        g = np.empty(len(others))
        for j, k in enumerate(others):
            h = 0.1 / math.sqrt(H[k, k]) * (1 if x[k] < at.x[k] or x[k] - 1 < low[j] else -1)
            beside = x.copy()
            beside[k] += h
            g[j] = (_value(space, at, beside, of) - value) / h + 0.5 * H[k, k] * h
        move = np.linalg.solve(inside, g)
        gain = 0.5 * float(g @ move)
        if gain < _CLOSE / 2:
            return x, value + gain
        new = x.copy()
        new[others] = np.clip(x[others] + move, low, high)
        there = _value(space, at, new, of)
        for _ in range(_NEWTON):
            if there > value:
                break
            new[others] = (new[others] + x[others]) / 2
            there = _value(space, at, new, of)
        if there < value + _CLOSE / 4:
            return (new, there) if there > value else (x, value)
        x, value = new, there
    return x, value


def _joined(pieces: Sequence[Piece]) -> tuple[Piece, ...]:
    """Pieces from low to high, with overlapping ones joined; ``best`` is that of the one among them that was given
    first."""
    out: list[tuple[int, Piece]] = []
    for rank, piece in sorted(enumerate(pieces), key=lambda each: each[1].low):
        if out and piece.low <= out[-1][1].high:
            first, last = out.pop()
            high, open_high = max((last.high, last.open_high), (piece.high, piece.open_high), key=lambda end: end[0])
            best = min((first, last.best), (rank, piece.best))[1]
            rank, piece = min(first, rank), Piece(last.low, high, best, last.open_low, open_high)
        out.append((rank, piece))
    return tuple(piece for _, piece in out)
