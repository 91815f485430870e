"""Mixtures of Gaussians, compiled: fewer components, and weighted points of the posterior of a line sensor's pixels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.compiled.line import Line, log_likelihoods_of_row
from aolink.estimation.compiled.small import cholesky, compiled, log_sum, lower_inverse

FloatArray = NDArray[np.float64]

_LOG_2PI = math.log(2 * math.pi)
# Logarithm of what adds nothing to one.
_NOTHING = -38.0


@compiled
def merge(log_weight: FloatArray, mean: FloatArray, covariance: FloatArray, most: int, free: float) -> None:
    """Components (axes, components, ...) merged by Runnalls' bound, in place; those that are gone weigh nothing.

    As `Hypotheses.reduced`: until there are no more than ``most``, and as long as a merger costs less than ``free``.
    """
    axes, count, n = mean.shape
    logs, cost = np.empty(count), np.empty((count, count))
    root, merged = np.empty((n, n)), np.empty((n, n))
    for axis in range(axes):
        w, x, P = log_weight[axis], mean[axis], covariance[axis]
        there = 0
        for j in range(count):
            if w[j] > -math.inf:
                there += 1
                logs[j] = _log_determinant(P[j], root)
        for i in range(count):
            for j in range(i + 1, count):
                cost[i, j] = _cost(w, x, P, logs, i, j, merged, root)
        while there > 1:
            first, second, least = -1, -1, math.inf
            for i in range(count):
                for j in range(i + 1, count):
                    if w[i] > -math.inf and w[j] > -math.inf and cost[i, j] < least:
                        first, second, least = i, j, cost[i, j]
            if first < 0 or (there <= most and least > free):
                break
            total = _merged(w, x, P, first, second, merged)
            share = math.exp(w[second]) / math.exp(total)
            for k in range(n):
                x[first, k] += share * (x[second, k] - x[first, k])
            P[first] = merged
            w[first], w[second] = total, -math.inf
            there -= 1
            logs[first] = _log_determinant(P[first], root)
            for j in range(count):
                i, k = min(first, j), max(first, j)
                if i < k:
                    cost[i, k] = _cost(w, x, P, logs, i, k, merged, root)


@compiled
def _log_determinant(P: FloatArray, root: FloatArray) -> float:
    cholesky(P, root)
    total = 0.0
    for i in range(len(P)):
        total += 2 * math.log(root[i, i])
    return total


@compiled
def _merged(w: FloatArray, x: FloatArray, P: FloatArray, i: int, j: int, out: FloatArray) -> float:
    """Covariance of two components together, and their log-weight."""
    top = max(w[i], w[j])
    total = top + math.log(math.exp(w[i] - top) + math.exp(w[j] - top))
    share = math.exp(w[j] - total)
    n = x.shape[1]
    for k in range(n):
        for m in range(n):
            away = (x[j, k] - x[i, k]) * (x[j, m] - x[i, m])
            out[k, m] = (1 - share) * P[i, k, m] + share * P[j, k, m] + share * (1 - share) * away
    return float(total)


@compiled
def _cost(
    w: FloatArray, x: FloatArray, P: FloatArray, logs: FloatArray, i: int, j: int, merged: FloatArray, root: FloatArray
) -> float:
    if w[i] == -math.inf or w[j] == -math.inf:
        return math.inf
    total = _merged(w, x, P, i, j, merged)
    apart = math.exp(w[i]) * logs[i] + math.exp(w[j]) * logs[j]
    return float(0.5 * (math.exp(total) * _log_determinant(merged, root) - apart))


@compiled
def _roots(
    log_weight: FloatArray, covariance: FloatArray, root: FloatArray, inverse: FloatArray, constant: FloatArray
) -> None:
    """Roots of the components' covariances, the roots' inverses, and the logs of their densities' peaks."""
    n = covariance.shape[1]
    for c in range(len(log_weight)):
        if log_weight[c] == -math.inf:
            continue
        cholesky(covariance[c], root[c])
        lower_inverse(root[c], inverse[c])
        constant[c] = log_weight[c] - 0.5 * n * _LOG_2PI
        for i in range(n):
            constant[c] -= math.log(root[c, i, i])


@compiled
def _log_densities(
    log_weight: FloatArray, mean: FloatArray, inverse: FloatArray, constant: FloatArray, t: FloatArray,
    logs: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Of components at points (points, n), (components, points), and of the whole mixture, (points,)."""
    points, n = t.shape
    out[:] = -math.inf
    for c in range(len(log_weight)):
        if log_weight[c] == -math.inf:
            continue
        for k in range(points):
            distance = 0.0
            for i in range(n):
                white = 0.0
                for j in range(i + 1):
                    white += inverse[c, i, j] * (t[k, j] - mean[c, j])
                distance += white * white
            logs[c, k] = constant[c] - 0.5 * distance
            out[k] = max(out[k], logs[c, k])
    for k in range(points):
        total = 0.0
        for c in range(len(log_weight)):
            if log_weight[c] > -math.inf and logs[c, k] - out[k] > _NOTHING:
                total += math.exp(logs[c, k] - out[k])
        out[k] += math.log(total)


@compiled
def importance_corrected(
    line: Line, prior_weight: FloatArray, prior_mean: FloatArray, prior_covariance: FloatArray, log_weight: FloatArray,
    mean: FloatArray, covariance: FloatArray, uniform: FloatArray, normal: FloatArray, enough: float,
    least_effective: float, halvings: int, prior_points: float, last_prior_points: float, loosened: float,
    negligible: float, effective: FloatArray,
) -> None:  # fmt: skip
    """The proposal (axes, components, ...) becomes the mixture that fits the posterior, in place.

    As `aolink.estimation.importance.importance_corrected`; ``uniform`` (rounds, points) and ``normal`` (rounds,
    points, n) are the points' random numbers.
    """
    axes, count, n = mean.shape
    states = prior_mean.shape[2]
    rounds, points = uniform.shape
    many = rounds * points
    prior_root, prior_inverse = np.empty(prior_covariance.shape[1:]), np.empty(prior_covariance.shape[1:])
    prior_constant, prior_logs = np.empty(prior_mean.shape[1]), np.empty((prior_mean.shape[1], points))
    root, inverse, constant = np.empty((count, n, n)), np.empty((count, n, n)), np.empty(count)
    t, target, prior_density = np.empty((many, n)), np.empty(many), np.empty(points)
    logs, drawn = np.empty((count, many)), np.empty((rounds, many))
    weight, tempered = np.empty(many), np.empty(many)
    old_mean, old_inverse = np.empty((rounds, count, n)), np.empty((rounds, count, n, n))
    old_weight, old_constant = np.empty((rounds, count)), np.empty((rounds, count))
    for axis in range(axes):
        w, x, P = log_weight[axis], mean[axis], covariance[axis]
        _roots(prior_weight[axis], prior_covariance[axis], prior_root, prior_inverse, prior_constant)
        for r in range(rounds):
            _roots(w, P, root, inverse, constant)
            old_weight[r], old_mean[r], old_inverse[r], old_constant[r] = w, x, inverse, constant
            begin, end = r * points, (r + 1) * points
            new = t[begin:end]
            _draw(w, x, root, uniform[r], normal[r], new)
            log_likelihoods_of_row(line, axis, new, target[begin:end])
            _log_densities(
                prior_weight[axis], prior_mean[axis], prior_inverse, prior_constant, new[:, :states], prior_logs,
                prior_density,
            )  # fmt: skip
            for k in range(points):
                square = (n - states) * _LOG_2PI
                for i in range(states, n):
                    square += new[k, i] * new[k, i]
                target[begin + k] += prior_density[k] - 0.5 * square
            for q in range(r):
                _log_densities(
                    old_weight[q], old_mean[q], old_inverse[q], old_constant[q], new, logs, drawn[q, begin:end]
                )
            _log_densities(w, x, inverse, constant, t[:end], logs, drawn[r, :end])
            effective[axis] = _weigh(target[:end], drawn[: r + 1], weight[:end])
            _temper(weight[:end], effective[axis], least_effective, halvings, tempered[:end])
            last = r + 1 == rounds or effective[axis] >= enough
            if last and r > 0:
                P *= loosened
            beside = last_prior_points if last else prior_points
            _refit(w, x, P, t[:end], tempered[:end], logs, drawn[r], beside, negligible)
            if last:
                break


@compiled
def _draw(
    log_weight: FloatArray, mean: FloatArray, root: FloatArray, uniform: FloatArray, normal: FloatArray, t: FloatArray
) -> None:
    count, n = mean.shape
    total = np.empty(count)
    so_far = 0.0
    last = 0
    for c in range(count):
        if log_weight[c] > -math.inf:
            so_far += math.exp(log_weight[c])
            last = c
        total[c] = so_far
    for k in range(len(t)):
        c = 0
        while c < last and total[c] < uniform[k] * so_far:
            c += 1
        for i in range(n):
            t[k, i] = mean[c, i]
            for j in range(i + 1):
                t[k, i] += root[c, i, j] * normal[k, j]


@compiled
def _weigh(target: FloatArray, drawn: FloatArray, log_weight: FloatArray) -> float:
    """Normalised weights of points over all the densities, (rounds, points), that they are from; how many count."""
    top = -math.inf
    for k in range(len(target)):
        most = drawn[0, k]
        for q in range(1, len(drawn)):
            most = max(most, drawn[q, k])
        log_weight[k] = target[k] - most
        if len(drawn) > 1:
            total = 0.0
            for q in range(len(drawn)):
                total += math.exp(drawn[q, k] - most)
            log_weight[k] -= math.log(total)
        top = max(top, log_weight[k])
    one = two = 0.0
    for k in range(len(target)):
        each = math.exp(log_weight[k] - top)
        one += each
        two += each * each
    log_weight -= top + math.log(one)
    return one * one / two


@compiled
def _temper(log_weight: FloatArray, effective: float, least: float, halvings: int, out: FloatArray) -> None:
    """Weights raised to the largest power up to one at which so many points, or half of all, count."""
    enough = min(least, len(log_weight) / 2)
    out[:] = log_weight
    if effective >= enough:
        return
    low, high = 0.0, 1.0
    for _ in range(1, halvings):
        power = (low + high) / 2
        one = two = 0.0
        for x in log_weight:
            each = math.exp(power * x)
            one += each
            two += each * each
        if one * one >= enough * two:
            low = power
        else:
            high = power
    out *= low
    out -= log_sum(out)


@compiled
def _refit(
    log_weight: FloatArray, mean: FloatArray, covariance: FloatArray, t: FloatArray, weight: FloatArray,
    logs: FloatArray, density: FloatArray, prior_points: float, negligible: float,
) -> None:  # fmt: skip
    """One step of expectation and maximisation with weighted points, in place.

    ``logs`` (components, points) are the components' log-densities at the points, ``density`` (points,) their sum's.
    """
    count, n = mean.shape
    away, whole = np.empty(n), 0.0
    share, spread, new = np.empty(len(t)), np.empty((n, n)), np.empty(count)
    for c in range(count):
        new[c] = 0.0
        if log_weight[c] == -math.inf:
            continue
        mass = square = 0.0
        for k in range(len(t)):
            share[k] = math.exp(logs[c, k] - density[k] + weight[k])
            mass += share[k]
            square += share[k] * share[k]
        new[c] = mass
        whole += mass
        per_mass = 1.0 / max(mass, 1e-300)
        if mass > 1e-9:
            mean[c] = 0.0
            for k in range(len(t)):
                for i in range(n):
                    mean[c, i] += share[k] * per_mass * t[k, i]
        spread[:] = 0.0
        for k in range(len(t)):
            if share[k] * per_mass < 1e-12:
                continue
            for i in range(n):
                away[i] = t[k, i] - mean[c, i]
            for i in range(n):
                x = share[k] * per_mass * away[i]
                for j in range(i + 1):
                    spread[i, j] += x * away[j]
        effective = mass * mass / max(square, 1e-300)
        trust = effective / (effective + prior_points)
        for i in range(n):
            for j in range(i + 1):
                fitted = trust * spread[i, j] + (1 - trust) * covariance[c, i, j]
                covariance[c, i, j] = covariance[c, j, i] = fitted
    left = 0.0
    for c in range(count):
        left += new[c] if new[c] > negligible * whole else 0.0
    for c in range(count):
        log_weight[c] = math.log(new[c] / left) if new[c] > negligible * whole else -math.inf
