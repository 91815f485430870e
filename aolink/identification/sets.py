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
from scipy import optimize

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
_NEWTON = 5
_CLOSE = 0.05
"""Accuracy to which a profile is found, nats, and an end of a piece, as a share of its distance."""


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
    """The pieces from low to high; more than one where the exposures leave aliases, none in a `contradiction`."""
    factor: float
    """The factor a."""

    @property
    def contradiction(self) -> str:
        """What a set without any piece means."""
        return (
            f"{self.name}: no value explains centroids and widths, so that no set is left: the"
            " model, the kernel or the noise is another than the rig file or --model says"
        )

    def holds(self, value: float) -> bool:
        """Whether the set has a value."""
        return any(
            (each.low <= value or each.open_low) and (value <= each.high or each.open_high) for each in self.pieces
        )


def identified(
    space: Space, found: Sequence[Maximum], seen: Sequence[Readings], tell: Callable[[int], None] | None = None
) -> tuple[Identified, ...]:
    """The sets of all parameters, from the local maxima, the best first: the highest, or the one that the pixels prefer
    (`pixels`)."""
    of, top = [Likelihood(each, SHORT_RUN) for each in seen], found[0]
    possible: list[tuple[Maximum, float, FloatArray, FloatArray]] = []
    for each in found[:_MOST]:
        below = top.log_likelihood - each.log_likelihood
        allowed = _allowed(space, top, each, seen) if possible and below < _BELOW else 0.0
        if not possible or below < max(allowed, QUANTILE / 2 * possible[0][3].max()):
            # An alias that may be the truth is as uncertain as its own curvature and factor make it.
            H = _curvature(space, each, of)
            possible.append((each, allowed, H, _factors(space, each, seen, H)))
    out = []
    for k, name in enumerate(space.names):
        if tell:
            tell(k)
        factor, pieces = float(possible[0][3][k]), []
        for each, allowed, H, factors in possible:
            least = top.log_likelihood - max(QUANTILE / 2 * factor, allowed)
            if each.log_likelihood > least:
                least = min(least, each.log_likelihood - QUANTILE / 2 * float(factors[k]))
                pieces.append(_piece(space, each, k, least, of, H))
        out.append(Identified(name, math.exp(top.x[k]), _joined(pieces), factor))
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
    return Likelihood(simulated(own, space.model(x), _DRAWS, seed), SHORT_RUN)


def _of_draws(space: Space, x: FloatArray, drawn: Likelihood, nodes: int) -> FloatArray:
    """Log-likelihood of a model in each of these recordings, (draws,)."""
    values = space.driven(x, drawn, _DRAWS).of_outputs(space.model(x), nodes)
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
    inverse, depth = np.linalg.inv(H), at.log_likelihood - least
    along, low, high = inverse[:, k] / inverse[k, k], *np.array(space.bounds).T
    ends, opens = [], []
    for sign, most in ((-1, at.x[k] - low[k]), (1, high[k] - at.x[k])):
        known = {0.0: (at.x, -math.sqrt(depth))}

        def beyond(moved: float, sign: int = sign, known: dict[float, tuple[FloatArray, float]] = known) -> float:
            """The root of the loss less that of the depth: along a profile the root is nearly a straight line."""
            if moved not in known:
                near = min(known, key=lambda each: abs(each - moved))
                start = np.clip(known[near][0] + sign * (moved - near) * along, low, high)
                x, value = _profiled(space, at, start, k, H, of)
                loss = max(at.log_likelihood - value, 0.0)
                known[moved] = x, math.sqrt(loss) - math.sqrt(depth)
            return known[moved][1]

        inside, outside = 0.0, min(math.sqrt(2 * depth * inverse[k, k]), _WIDEST, most)
        while beyond(outside) < 0 and outside < most:
            inside, outside = outside, min(2 * outside, outside + _WIDEST, most)
        opens.append(bool(beyond(outside) < 0))
        if not opens[-1]:
            outside = float(optimize.brentq(beyond, inside, outside, xtol=_CLOSE * outside, rtol=_CLOSE))
        ends.append(math.exp(at.x[k] + sign * outside))
    return Piece(ends[0], ends[1], math.exp(at.x[k]), *opens)


def _profiled(
    space: Space, at: Maximum, x: FloatArray, k: int, H: FloatArray, of: Sequence[Likelihood]
) -> tuple[FloatArray, float]:
    """The maximum over the parameters other than ``k``, and its value, by Newton's method with curvature H."""
    others = np.delete(np.arange(len(x)), k)
    curvature, value = H[np.ix_(others, others)], _value(space, at, x, of)
    low, high = np.array(space.bounds).T
    for _ in range(_NEWTON if len(others) else 0):
        steps = 0.1 / np.sqrt(np.diagonal(H))
        steps = np.diag(np.where(x + steps > high, -steps, steps))[others]
        gained = np.array([_value(space, at, x + step, of) for step in steps]) - value
        steps = steps.sum(axis=1)
        g = gained / steps + 0.5 * np.diagonal(curvature) * steps
        move = np.linalg.solve(curvature, g)
        if (gain := 0.5 * float(g @ move)) < _CLOSE:
            return x, value + gain
        for _ in range(_NEWTON):
            new = x.copy()
            new[others] = np.clip(x[others] + move, low[others], high[others])
            if (there := _value(space, at, new, of)) > value:
                break
            move = move / 2
        if there < value + _CLOSE:
            break
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
