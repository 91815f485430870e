"""Modes of the posterior of a line sensor's pixels: the search, and which of them are one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.compiled.line import Line, fisher_information, linearised_light, path_of
from aolink.estimation.compiled.small import cholesky, compiled, lower_inverse, solve, times

FloatArray = NDArray[np.float64]

# Squared distance from a mode, in its standard deviations, at which a search ends there.
_NEXT_TO = 0.05


@compiled
def linear_fits(
    line: Line, mean: FloatArray, roots: FloatArray, s: FloatArray, H: FloatArray, pull: FloatArray, square: FloatArray
) -> None:
    """In coordinates t = mean + root s, at s (rows, n): J' I J, J' score, and the sum of score^2 / I."""
    n, nodes = line.basis.shape
    width = line.y.shape[1] + 2 * line.table.shape[2]
    path, rest, B = np.empty(nodes), np.empty(nodes), np.empty((n, nodes))
    f, J = np.empty(width), np.empty((n, width))
    for row in range(len(s)):
        times(roots[row].T, line.basis, B)
        path_of(line.inputs[row], line.basis, mean[row], rest)
        path_of(rest, B, s[row], path)
        linearised_light(line, path, B, f, J)
        _, square[row] = fisher_information(line, row, f, J, H[row], pull[row])
        for i in range(n):
            for j in range(i):
                H[row, j, i] = H[row, i, j]


@compiled
def find_modes(
    line: Line, mean: FloatArray, roots: FloatArray, starts: FloatArray, passes: int, first_damping: float,
    largest_damping: float, free_damping: float, converged: float, out_mean: FloatArray, out_covariance: FloatArray,
    out_evidence: FloatArray, out_distance: FloatArray, out_objective: FloatArray,
) -> None:  # fmt: skip
    """Where starts (rows, starts, n), whitened, lead by Levenberg and Marquardt's method.

    As `aolink.estimation.modes.find_modes`; ``mean`` and ``roots`` are the prior's, (rows, n) and (rows, n, n).
    """
    n, nodes = line.basis.shape
    width = line.y.shape[1] + 2 * line.table.shape[2]
    path, rest, B = np.empty(nodes), np.empty(nodes), np.empty((n, nodes))
    f, J = np.empty(width), np.empty((n, width))
    s, there, step = np.empty(n), np.empty(n), np.empty(n)
    H, pull, other, its_pull = np.empty((n, n)), np.empty(n), np.empty((n, n)), np.empty(n)
    damped, root, inverse = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    ends, their_H = np.empty(starts.shape[1:]), np.empty((starts.shape[1], n, n))
    for row in range(starts.shape[0]):
        times(roots[row].T, line.basis, B)
        path_of(line.inputs[row], line.basis, mean[row], rest)
        for start in range(starts.shape[1]):
            s[:] = starts[row, start]
            now = _at(line, row, rest, B, s, path, f, J, H, pull)
            damping, twin = first_damping, -1
            for _ in range(passes):
                for i in range(n):
                    for j in range(i + 1):
                        damped[i, j] = H[i, j]
                    damped[i, i] += damping * H[i, i]
                    step[i] = pull[i]
                cholesky(damped, root)
                solve(root, step)
                decrement = 0.0
                for i in range(n):
                    there[i] = s[i] + step[i]
                    decrement += step[i] * pull[i]
                objective = _at(line, row, rest, B, there, path, f, J, other, its_pull)
                gain, before = now - objective, damping
                better = gain > 0
                if better:
                    now = objective
                    s[:] = there
                    H[:] = other
                    pull[:] = its_pull
                    damping = damping / 8
                    twin = _near(s, ends[:start], their_H[:start])
                    if twin >= 0:
                        break
                else:
                    damping = max(damping, 1e-3) * 8
                if before <= free_damping and ((better and gain < converged) or decrement < converged):
                    break
                if damping > largest_damping:
                    break
            ends[start] = s
            their_H[start] = H
            if twin >= 0:
                ends[start], their_H[start] = ends[twin], their_H[twin]
                out_mean[row, start], out_covariance[row, start] = out_mean[row, twin], out_covariance[row, twin]
                out_evidence[row, start], out_distance[row, start] = out_evidence[row, twin], out_distance[row, twin]
                out_objective[row, start] = out_objective[row, twin]
                continue
            cholesky(H, root)
            log_H = 0.0
            for i in range(n):
                log_H += 2 * math.log(root[i, i])
            lower_inverse(root, inverse)
            # Covariance L H^-1 L' = W W' with W = L R^-T.
            distance = 0.0
            for i in range(n):
                distance += s[i] * s[i]
                out_mean[row, start, i] = mean[row, i]
                for j in range(n):
                    total = 0.0
                    for k in range(n):
                        total += roots[row, i, k] * inverse[j, k]
                    damped[i, j] = total
                    out_mean[row, start, i] += roots[row, i, j] * s[j]
            for i in range(n):
                for j in range(i + 1):
                    total = 0.0
                    for k in range(n):
                        total += damped[i, k] * damped[j, k]
                    out_covariance[row, start, i, j] = out_covariance[row, start, j, i] = total
            out_evidence[row, start] = -now - 0.5 * log_H
            out_distance[row, start] = distance
            out_objective[row, start] = now


@compiled
def _near(s: FloatArray, ends: FloatArray, H: FloatArray) -> int:
    """A mode that s is on its way to, next to it already, or -1; their informations' lower halves, (modes, n, n)."""
    n = len(s)
    away = np.empty(n)
    for m in range(len(ends)):
        distance = 0.0
        for i in range(n):
            away[i] = s[i] - ends[m, i]
            for j in range(i):
                distance += 2.0 * away[i] * H[m, i, j] * away[j]
            distance += away[i] * H[m, i, i] * away[i]
        if distance < _NEXT_TO:
            return m
    return -1


@compiled
def _at(
    line: Line, row: int, rest: FloatArray, B: FloatArray, s: FloatArray, path: FloatArray, f: FloatArray,
    J: FloatArray, H: FloatArray, pull: FloatArray,
) -> float:  # fmt: skip
    """Information, downward pull and objective at whitened coordinates s."""
    n = len(s)
    path_of(rest, B, s, path)
    linearised_light(line, path, B, f, J)
    log_likelihood, _ = fisher_information(line, row, f, J, H, pull)
    square = 0.0
    for i in range(n):
        H[i, i] += 1.0
        pull[i] -= s[i]
        square += s[i] * s[i]
    return float(0.5 * square - log_likelihood)


@compiled
def mark_repeats(mean: FloatArray, covariance: FloatArray, apart: float, evidence: FloatArray) -> None:
    """Log-evidence (rows, modes) becomes minus infinity for modes that an earlier one is, too."""
    rows, count, n = mean.shape
    root, inverse = np.empty((n, n)), np.empty((n, n))
    for row in range(rows):
        for j in range(1, count):
            if evidence[row, j] == -math.inf:
                continue
            cholesky(covariance[row, j], root)
            lower_inverse(root, inverse)
            for other in range(j):
                if evidence[row, other] == -math.inf:
                    continue
                distance = 0.0
                for i in range(n):
                    white = 0.0
                    for k in range(i + 1):
                        white += inverse[i, k] * (mean[row, other, k] - mean[row, j, k])
                    distance += white * white
                if distance < apart * apart:
                    evidence[row, j] = -math.inf
                    break
