"""Gaussian mixtures, compiled: their moments, and Runnalls' reduction."""

from __future__ import annotations

import math

import numpy as np

from aolink.estimation.compiled.small import cholesky_into, compiled, inlined
from aolink.numerics.arrays import FloatArray


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
