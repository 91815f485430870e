"""Gaussian mixtures, compiled: Runnalls' reduction, and adaptive importance sampling of the pixels."""

from __future__ import annotations

import math

import numpy as np

from aolink.estimation.compiled.pixels import Pixels, log_likelihoods_of_row
from aolink.estimation.compiled.small import cholesky_into, compiled, compiled_sums, decay, inlined, lower_inverse_into
from aolink.numerics.arrays import FloatArray

_LOG_2PI = math.log(2 * math.pi)


@compiled
def moments(
    log_weight: FloatArray, mean: FloatArray, covariance: FloatArray, out_mean: FloatArray, out_covariance: FloatArray
) -> None:
    """Means (axes, n) and covariances of mixtures with components (axes, components, ...)."""
    axes, count, n = mean.shape
    for axis in range(axes):
        for i in range(n):
            out_mean[axis, i] = 0.0
            for j in range(n):
                out_covariance[axis, i, j] = 0.0
        for c in range(count):
            if log_weight[axis, c] > -math.inf:
                w = math.exp(log_weight[axis, c])
                for i in range(n):
                    out_mean[axis, i] += w * mean[axis, c, i]
        for c in range(count):
            if log_weight[axis, c] > -math.inf:
                w = math.exp(log_weight[axis, c])
                for i in range(n):
                    away = mean[axis, c, i] - out_mean[axis, i]
                    for j in range(i + 1):
                        beside = away * (mean[axis, c, j] - out_mean[axis, j])
                        out_covariance[axis, i, j] += w * (covariance[axis, c, i, j] + beside)
        for i in range(n):
            for j in range(i):
                out_covariance[axis, j, i] = out_covariance[axis, i, j]


@compiled
def merge(log_weight: FloatArray, mean: FloatArray, covariance: FloatArray, most: int, free: float) -> None:
    """Components (axes, components, ...) merged by Runnalls' bound, in place; merged ones get weight zero.

    As `GaussianMixture.reduced`: until there are no more than ``most``, and while a merger costs less than ``free``.
    """
    axes, count, n = mean.shape
    logs, cost = np.empty(count), np.empty((count, count))
    root, merged = np.empty((n, n)), np.empty((n, n))
    for axis in range(axes):
        w, x, P = log_weight[axis], mean[axis], covariance[axis]
        # Components of weight above zero come first.
        begun = 0
        for j in range(count):
            if w[j] > -math.inf:
                if begun < j:
                    x[begun], P[begun] = x[j], P[j]
                    w[begun], w[j] = w[j], -math.inf
                logs[begun] = _log_determinant(P[begun], root)
                begun += 1
        for i in range(begun):
            for j in range(i + 1, begun):
                cost[i, j] = _cost(w, x, P, logs, i, j, merged, root)
        there = begun
        while there > 1:
            first, second, least = -1, -1, math.inf
            for i in range(begun):
                for j in range(i + 1, begun):
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
            for j in range(begun):
                i, k = min(first, j), max(first, j)
                if i < k:
                    cost[i, k] = _cost(w, x, P, logs, i, k, merged, root)


@inlined
def _log_determinant(P: FloatArray, root: FloatArray) -> float:
    cholesky_into(P, root)
    total = 0.0
    for i in range(len(P)):
        total += 2 * math.log(root[i, i])
    return total


@inlined
def _merged(w: FloatArray, x: FloatArray, P: FloatArray, i: int, j: int, out: FloatArray) -> float:
    """Covariance of two merged components, and their log-weight."""
    top = max(w[i], w[j])
    total = top + math.log(math.exp(w[i] - top) + math.exp(w[j] - top))
    share = math.exp(w[j] - total)
    n = x.shape[1]
    for k in range(n):
        for m in range(n):
            away = (x[j, k] - x[i, k]) * (x[j, m] - x[i, m])
            out[k, m] = (1 - share) * P[i, k, m] + share * P[j, k, m] + share * (1 - share) * away
    return float(total)


@inlined
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
        cholesky_into(covariance[c], root[c])
        lower_inverse_into(root[c], inverse[c])
        constant[c] = log_weight[c] - 0.5 * n * _LOG_2PI
        for i in range(n):
            constant[c] -= math.log(root[c, i, i])


@compiled_sums
def _log_densities(
    log_weight: FloatArray, mean: FloatArray, inverse: FloatArray, constant: FloatArray, t: FloatArray, begin: int,
    end: int, white: FloatArray, logs: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Log-densities of the components, (components, points), and of the mixture, at points ``begin`` to ``end`` of t.

    t is (n, points).
    """
    n = mean.shape[1]
    for k in range(begin, end):
        out[k] = -math.inf
    there = 0
    for c in range(len(log_weight)):
        if log_weight[c] == -math.inf:
            continue
        there += 1
        for k in range(begin, end):
            logs[c, k] = 0.0
        for i in range(n):
            for k in range(begin, end):
                white[k] = inverse[c, i, i] * (t[i, k] - mean[c, i])
            for j in range(i):
                x, m = inverse[c, i, j], mean[c, j]
                for k in range(begin, end):
                    white[k] += x * (t[j, k] - m)
            for k in range(begin, end):
                logs[c, k] -= 0.5 * white[k] * white[k]
        for k in range(begin, end):
            logs[c, k] += constant[c]
            out[k] = max(out[k], logs[c, k])
    if there < 2:
        return
    for k in range(begin, end):
        white[k] = 0.0
    for c in range(len(log_weight)):
        if log_weight[c] > -math.inf:
            for k in range(begin, end):
                white[k] += decay(logs[c, k] - out[k])
    for k in range(begin, end):
        out[k] += math.log(white[k])


@compiled
def correct_by_importance(
    seen: Pixels, prior_weight: FloatArray, prior_mean: FloatArray, prior_covariance: FloatArray,
    log_weight: FloatArray, mean: FloatArray, covariance: FloatArray, uniform: FloatArray, normal: FloatArray,
    enough: FloatArray, least_effective: float, halvings: int, prior_points: float, last_prior_points: float,
    tightened: float, loosened: float, negligible: float, effective: FloatArray,
) -> None:  # fmt: skip
    """The proposal (axes, components, ...) becomes the mixture that fits the posterior, in place.

    By adaptive multiple importance sampling, as `aolink.estimation.pixels.importance` says. ``uniform`` (rounds,
    points) and ``normal`` (rounds, points, n) are the points' random numbers. Points, which are many, lie along the
    last dimension of every array here.
    """
    axes, count, n = mean.shape
    states = prior_mean.shape[2]
    rounds, points = uniform.shape
    many = rounds * points
    prior_root, prior_inverse = np.empty(prior_covariance.shape[1:]), np.empty(prior_covariance.shape[1:])
    prior_constant, prior_logs = np.empty(prior_mean.shape[1]), np.empty((prior_mean.shape[1], many))
    root, inverse, constant = np.empty((count, n, n)), np.empty((count, n, n)), np.empty(count)
    t, target, prior_density = np.empty((n, many)), np.empty(many), np.empty(many)
    logs, drawn, total = np.empty((count, many)), np.empty((rounds, many)), np.empty(count)
    weight, tempered, some, more = np.empty(many), np.empty(many), np.empty(many), np.empty(many)
    old_mean, old_inverse = np.empty((rounds, count, n)), np.empty((rounds, count, n, n))
    old_weight, old_constant = np.empty((rounds, count)), np.empty((rounds, count))
    for axis in range(axes):
        w, x, P = log_weight[axis], mean[axis], covariance[axis]
        _roots(prior_weight[axis], prior_covariance[axis], prior_root, prior_inverse, prior_constant)
        for r in range(rounds):
            _roots(w, P, root, inverse, constant)
            old_weight[r], old_mean[r], old_inverse[r], old_constant[r] = w, x, inverse, constant
            begin, end = r * points, (r + 1) * points
            _draw(w, x, root, uniform[r], normal[r], total, t, begin)
            log_likelihoods_of_row(seen, axis, t, begin, end, target)
            _log_densities(
                prior_weight[axis], prior_mean[axis], prior_inverse, prior_constant, t, begin, end, some, prior_logs,
                prior_density,
            )  # fmt: skip
            for k in range(begin, end):
                square = (n - states) * _LOG_2PI
                for i in range(states, n):
                    square += t[i, k] * t[i, k]
                target[k] += prior_density[k] - 0.5 * square
            for q in range(r):
                _log_densities(
                    old_weight[q], old_mean[q], old_inverse[q], old_constant[q], t, begin, end, some, logs, drawn[q]
                )
            _log_densities(w, x, inverse, constant, t, 0, end, some, logs, drawn[r])
            effective[axis] = _weigh(target, drawn, r + 1, end, some, weight)
            _temper(weight, end, effective[axis], least_effective, halvings, tempered)
            last = r + 1 == rounds or effective[axis] >= enough[axis]
            if last:
                P *= loosened if r else tightened
            beside = last_prior_points if last else prior_points
            _refit(w, x, P, t, end, tempered, logs, drawn[r], beside, negligible, some, more)
            if last:
                break


@compiled
def _draw(
    log_weight: FloatArray, mean: FloatArray, root: FloatArray, uniform: FloatArray, normal: FloatArray,
    total: FloatArray, t: FloatArray, begin: int,
) -> None:  # fmt: skip
    """Points of a mixture, t (n, points) from ``begin`` on."""
    count, n = mean.shape
    so_far = 0.0
    last = 0
    for c in range(count):
        if log_weight[c] > -math.inf:
            so_far += math.exp(log_weight[c])
            last = c
        total[c] = so_far
    for k in range(len(uniform)):
        c = 0
        while c < last and total[c] < uniform[k] * so_far:
            c += 1
        for i in range(n):
            place = mean[c, i]
            for j in range(i + 1):
                place += root[c, i, j] * normal[k, j]
            t[i, begin + k] = place


@compiled_sums
def _weigh(
    target: FloatArray, drawn: FloatArray, rounds: int, end: int, most: FloatArray, log_weight: FloatArray
) -> float:
    """Normalised log-weights of points drawn from all densities (rounds, points); returns the effective sample size."""
    for k in range(end):
        most[k] = drawn[0, k]
    for q in range(1, rounds):
        for k in range(end):
            most[k] = max(most[k], drawn[q, k])
    for k in range(end):
        log_weight[k] = target[k] - most[k]
    if rounds > 1:
        for k in range(end):
            total = 0.0
            for q in range(rounds):
                total += decay(drawn[q, k] - most[k])
            log_weight[k] -= math.log(total)
    top = -math.inf
    for k in range(end):
        top = max(top, log_weight[k])
    one = two = 0.0
    for k in range(end):
        each = decay(log_weight[k] - top)
        one += each
        two += each * each
    whole = top + math.log(one)
    for k in range(end):
        log_weight[k] -= whole
    return one * one / two


@compiled_sums
def _temper(log_weight: FloatArray, end: int, effective: float, least: float, halvings: int, out: FloatArray) -> None:
    """Weights raised to the largest power up to one at which the effective sample size is ``least``, or half of all."""
    enough = min(least, end / 2)
    for k in range(end):
        out[k] = log_weight[k]
    if effective >= enough:
        return
    top = -math.inf
    for k in range(end):
        top = max(top, log_weight[k])
    low, high, whole = 0.0, 1.0, float(end)
    for _ in range(1, halvings):
        power = (low + high) / 2
        one = two = 0.0
        for k in range(end):
            each = decay(power * (log_weight[k] - top))
            one += each
            two += each * each
        if one * one >= enough * two:
            low, whole = power, one
        else:
            high = power
    whole = math.log(whole)
    for k in range(end):
        out[k] = low * (log_weight[k] - top) - whole


@compiled_sums
def _refit(
    log_weight: FloatArray, mean: FloatArray, covariance: FloatArray, t: FloatArray, end: int, weight: FloatArray,
    logs: FloatArray, density: FloatArray, prior_points: float, negligible: float, share: FloatArray, away: FloatArray,
) -> None:  # fmt: skip
    """One step of expectation-maximisation (EM) with weighted points, in place.

    ``logs`` (components, points) are the components' log-densities at the points, ``density`` (points,) the mixture's.
    A component that is dropped gets the log-weight minus infinity.
    """
    count, n = mean.shape
    whole = 0.0
    for c in range(count):
        if log_weight[c] == -math.inf:
            continue
        mass = square = 0.0
        for k in range(end):
            share[k] = decay(logs[c, k] - density[k] + weight[k])
            mass += share[k]
            square += share[k] * share[k]
        log_weight[c] = mass
        whole += mass
        per_mass = 1.0 / max(mass, 1e-300)
        if mass > 1e-9:
            for i in range(n):
                total = 0.0
                for k in range(end):
                    total += share[k] * t[i, k]
                mean[c, i] = total * per_mass
        effective = mass * mass / max(square, 1e-300)
        trust = effective / (effective + prior_points)
        for i in range(n):
            for k in range(end):
                away[k] = share[k] * (t[i, k] - mean[c, i])
            for j in range(i + 1):
                total = 0.0
                for k in range(end):
                    total += away[k] * (t[j, k] - mean[c, j])
                fitted = trust * total * per_mass + (1 - trust) * covariance[c, i, j]
                covariance[c, i, j] = covariance[c, j, i] = fitted
    _normalise(log_weight, negligible * whole)


@compiled
def _normalise(weight: FloatArray, least: float) -> None:
    """Normalised logarithms of weights, in place; minus infinity for weights of no more than ``least``.

    Weights are summed one after the other, so that components of weight zero change no bit.
    """
    left = 0.0
    for each in weight:
        left += each if each > least else 0.0
    for c in range(len(weight)):
        weight[c] = math.log(weight[c] / left) if weight[c] > least else -math.inf
