"""Modes of the posterior of an axis's pixels by Levenberg and Marquardt's method, and which of them are one."""

from __future__ import annotations

import math

import numpy as np

from aolink.estimation.compiled.pixels import Pixels, information_of_row, path_of
from aolink.estimation.compiled.small import (
    cholesky_into,
    cholesky_solve,
    compiled,
    eigh,
    inlined,
    lower_inverse_into,
    lower_solve,
    times,
)
from aolink.numerics.arrays import FloatArray, Indices

# A search ends where its squared distance from a known mode, in that mode's standard deviations, is below this.
_NEXT_TO = 0.25


@compiled
def spread_starts(
    mean: FloatArray, covariance: FloatArray, broad_mean: FloatArray, broad_covariance: FloatArray, gram: FloatArray,
    reach: float, starts: FloatArray, squares: FloatArray,
) -> None:  # fmt: skip
    """Fills in the results of `aolink.estimation.pixels.modes.spread_starts`."""
    rows, count, n = starts.shape
    root, wide, product, turned = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    vectors, along = np.empty((n, n)), np.empty(n)
    for row in range(rows):
        cholesky_into(covariance[row], root)
        cholesky_into(broad_covariance[row], wide)
        times(gram, wide, product)
        times(wide.T, product, turned)
        eigh(turned, squares[row], vectors)
        for i in range(n):
            along[i] = broad_mean[row, i] - mean[row, i]
        lower_solve(root, along)
        starts[row] = along
        for d in range(count // 2):
            for i in range(n):
                along[i] = 0.0
                for j in range(i + 1):
                    along[i] += reach * wide[i, j] * vectors[d, j]
            lower_solve(root, along)
            for i in range(n):
                starts[row, 1 + 2 * d, i] += along[i]
                starts[row, 2 + 2 * d, i] -= along[i]


@compiled
def find_modes(
    seen: Pixels, mean: FloatArray, covariance: FloatArray, starts: FloatArray, of_row: Indices, whole: int,
    reversed_precision: float, passes: int, first_damping: float, largest_damping: float, free_damping: float,
    converged: float, out_mean: FloatArray, out_covariance: FloatArray, out_evidence: FloatArray,
    out_total: FloatArray, out_residual: FloatArray, out_objective: FloatArray,
) -> None:  # fmt: skip
    """Modes that the first ``of_row`` (rows,) of the whitened starts (rows, starts, n) lead to, then their reversals.

    As `pixels.modes.modes_of`; ``mean`` and ``covariance`` are the prior's. If ``reversed_precision`` is not zero,
    results have room for three more modes than there are starts; rows of one start have no reversals. Where there is no
    start, or it leads to the mode of an earlier one, they are left alone.
    """
    (rows, n), (outputs, _, nodes), room = mean.shape, seen.basis.shape, out_mean.shape[1]
    path, rest, B = np.empty((outputs, nodes)), np.empty((outputs, nodes)), np.empty((outputs, n, nodes))
    s, there, step = np.empty(n), np.empty(n), np.empty(n)
    H, pull, other, its_pull = np.empty((n, n)), np.empty(n), np.empty((n, n)), np.empty(n)
    root, damped, lower, inverse = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    begins, ends, their_H = np.empty((room, n)), np.empty((room, n)), np.empty((room, n, n))
    for row in range(rows):
        cholesky_into(covariance[row], root)
        for o in range(outputs):
            times(root.T, seen.basis[o], B[o])
            path_of(seen.inputs[row, o], seen.basis[o], mean[row], rest[o])
        count = of_row[row]
        for k in range(count):
            for i in range(n):
                begins[k, i] = starts[row, k, i]
        best = best_end = done = found = 0
        while done < count:
            twin = _near(begins[done], ends, their_H, found)
            if twin < 0:
                for i in range(n):
                    s[i] = begins[done, i]
                now, square = _at(seen, row, rest, B, s, path, H, pull)
                damping = first_damping
                for _ in range(passes):
                    for i in range(n):
                        for j in range(i + 1):
                            damped[i, j] = H[i, j]
                        damped[i, i] += damping * H[i, i]
                        step[i] = pull[i]
                    cholesky_into(damped, lower)
                    cholesky_solve(lower, step)
                    decrement = 0.0
                    for i in range(n):
                        there[i] = s[i] + step[i]
                        decrement += step[i] * pull[i]
                    objective, its_square = _at(seen, row, rest, B, there, path, other, its_pull)
                    decrease, before = now - objective, damping
                    better = decrease > 0
                    if better:
                        # Copied, not swapped: names that change arrays have their references counted.
                        now, square = objective, its_square
                        for i in range(n):
                            s[i], pull[i] = there[i], its_pull[i]
                            for j in range(i + 1):
                                H[i, j] = other[i, j]
                        damping = damping / 8
                        twin = _near(s, ends, their_H, found)
                        if twin >= 0:
                            break
                    else:
                        damping = max(damping, 1e-3) * 8
                    if before <= free_damping and ((better and decrease < converged) or decrement < converged):
                        break
                    if damping > largest_damping:
                        break
            if twin < 0:
                for i in range(n):
                    ends[found, i] = s[i]
                    for j in range(i + 1):
                        their_H[found, i, j] = H[i, j]
                found += 1
                cholesky_into(H, lower)
                log_H, total, free = 0.0, square, float(n)
                for i in range(n):
                    log_H += 2 * math.log(lower[i, i])
                    total += s[i] * s[i]
                lower_inverse_into(lower, inverse)
                for i in range(n):
                    for j in range(i + 1):
                        free -= inverse[i, j] * inverse[i, j]
                out_total[row, done], out_residual[row, done] = total, square + free
                # Covariance L H^-1 L' = W W' with W = L R^-T.
                for i in range(n):
                    place = mean[row, i]
                    for j in range(n):
                        product = 0.0
                        for k in range(i + 1):
                            product += root[i, k] * inverse[j, k]
                        damped[i, j] = product
                    for j in range(i + 1):
                        place += root[i, j] * s[j]
                        product = 0.0
                        for k in range(n):
                            product += damped[i, k] * damped[j, k]
                        out_covariance[row, done, i, j] = out_covariance[row, done, j, i] = product
                    out_mean[row, done, i] = place
                out_evidence[row, done] = -now - 0.5 * log_H
                out_objective[row, done] = now
                if done == 0 or now < out_objective[row, best]:
                    best, best_end = done, found - 1
            done += 1
            if done == of_row[row] and done > 1 and reversed_precision > 0.0:
                for o in range(outputs):
                    path_of(rest[o], B[o], ends[best_end], path[o])
                _reversals(seen.weights, rest, B, path, whole, reversed_precision, damped, lower, begins[done:])
                count = done + 3


@compiled
def _reversals(
    weights: FloatArray, rest: FloatArray, B: FloatArray, path: FloatArray, whole: int, precision: float, H: FloatArray,
    root: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Whitened coordinates (3, n) of paths with nearly the same blur as a path's, (outputs, nodes): reversed in time,
    which gives the same blur; mirrored about its mean, which does where the blur is symmetric, as that of a vibration
    is; and both. ``precision`` is that with which a path is fitted to them."""
    outputs, n, total = B.shape[0], B.shape[1], 0.0
    for k in range(whole):
        total += weights[k]
    for i in range(n):
        for j in range(i + 1):
            H[i, j] = 1.0 if i == j else 0.0
            for o in range(outputs):
                for k in range(whole):
                    H[i, j] += precision * weights[k] / total * B[o, i, k] * B[o, j, k]
    cholesky_into(H, root)
    for d in range(3):
        for i in range(n):
            out[d, i] = 0.0
        for o in range(outputs):
            mean = 0.0
            for k in range(whole):
                mean += weights[k] / total * path[o, k]
            for k in range(whole):
                to = path[o, k] if d == 1 else path[o, whole - 1 - k]
                to = to if d == 0 else 2.0 * mean - to
                x = precision * weights[k] / total * (to - rest[o, k])
                for i in range(n):
                    out[d, i] += B[o, i, k] * x
        cholesky_solve(root, out[d])


@inlined
def _near(s: FloatArray, ends: FloatArray, H: FloatArray, count: int) -> int:
    """The first of ``count`` modes that s is near, or -1; the lower halves of their informations are (modes, n, n)."""
    n = len(s)
    for m in range(count):
        distance = 0.0
        for i in range(n):
            away = s[i] - ends[m, i]
            for j in range(i):
                distance += 2.0 * away * H[m, i, j] * (s[j] - ends[m, j])
            distance += away * away * H[m, i, i]
        if distance < _NEXT_TO:
            return m
    return -1


@inlined
def _at(
    seen: Pixels, row: int, rest: FloatArray, B: FloatArray, s: FloatArray, path: FloatArray, H: FloatArray,
    pull: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Information H and negative gradient ``pull`` at whitened coordinates s; gives the objective and the pixels'
    chi-square."""
    n, distance = len(s), 0.0
    for o in range(len(path)):
        path_of(rest[o], B[o], s, path[o])
    for i in range(n):
        pull[i] = -s[i]
        distance += s[i] * s[i]
        for j in range(i + 1):
            H[i, j] = 1.0 if i == j else 0.0
    log_likelihood, square = information_of_row(seen, row, path, B, H, pull)
    return 0.5 * distance - log_likelihood, square


@compiled
def drop_repeats(
    mean: FloatArray, covariance: FloatArray, apart: float, evidence: FloatArray, total: FloatArray,
    residual: FloatArray, objective: FloatArray,
) -> int:  # fmt: skip
    """Distinct modes of (rows, modes, ...) are put first; repeats of an earlier one get log-evidence minus infinity.

    Returns the largest number of distinct modes in a row.
    """
    rows, count, n = mean.shape
    root, inverse = np.empty((n, n)), np.empty((n, n))
    most = 0
    for row in range(rows):
        kept = 0
        for j in range(count):
            if evidence[row, j] == -math.inf:
                continue
            cholesky_into(covariance[row, j], root)
            lower_inverse_into(root, inverse)
            repeats = False
            for other in range(kept):
                square = 0.0
                for i in range(n):
                    white = 0.0
                    for k in range(i + 1):
                        white += inverse[i, k] * (mean[row, other, k] - mean[row, j, k])
                    square += white * white
                repeats = repeats or square < apart * apart
            if repeats:
                evidence[row, j], objective[row, j] = -math.inf, math.inf
                continue
            if kept < j:
                mean[row, kept], covariance[row, kept] = mean[row, j], covariance[row, j]
                evidence[row, kept], evidence[row, j] = evidence[row, j], -math.inf
                total[row, kept], residual[row, kept] = total[row, j], residual[row, j]
                objective[row, kept], objective[row, j] = objective[row, j], math.inf
            kept += 1
        most = max(most, kept)
    return most
