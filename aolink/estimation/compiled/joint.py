"""Many spots of one plant: likelihood and Fisher information of their pixels, and of the plant's coefficients.

A spot's path is a sum of courses in time; ``m`` is their number (`aolink.estimation.model.joint_paths`).
"""

from __future__ import annotations

import math

import numpy as np

from aolink.estimation.compiled.pixels import LARGE
from aolink.estimation.compiled.small import compiled, compiled_sums
from aolink.numerics.arrays import BoolArray, FloatArray, Indices


@compiled
def informed(information: FloatArray, patterns: FloatArray, course_of: Indices, course: int, out: FloatArray) -> None:
    """Information between the course of each output and the first k coefficients, ``out`` (outputs, k), from each
    spot's information (spots, 2, m, 2, m) and the patterns (outputs, size).
    """
    for s in range(len(information)):
        for d in range(2):
            row = information[s, d, course]
            for k in range(out.shape[1]):
                c = course_of[k]
                out[2 * s + d, k] = row[0, c] * patterns[2 * s, k] + row[1, c] * patterns[2 * s + 1, k]


@compiled_sums
def spread_of(left: FloatArray, patterns: FloatArray, starts: Indices, course: int, out: FloatArray) -> None:
    """Covariance of the courses' shares, (spots, 2, m, 2, m), between one course and those up to it.

    ``left`` holds the course's patterns times the covariance of the coefficients, (outputs, .), ``starts`` where each
    course's coefficients begin, and where the last one's end.
    """
    for s in range(len(out)):
        for d in range(2):
            for e in range(2):
                for c in range(course + 1):
                    total = 0.0
                    for k in range(starts[c], starts[c + 1]):
                        total += left[2 * s + d, k] * patterns[2 * s + e, k]
                    out[s, d, course, e, c] = out[s, e, c, d, course] = total


@compiled
def taken(matrix: FloatArray, places: Indices, out: FloatArray) -> None:
    """The submatrix of the rows and columns at these places."""
    for i in range(len(places)):
        for j in range(len(places)):
            out[i, j] = matrix[places[i], places[j]]


@compiled
def spread_out(lower: FloatArray, places: Indices, out: FloatArray) -> None:
    """A symmetric matrix from its lower half, its rows and columns put at these places."""
    for i in range(len(lower)):
        for j in range(i + 1):
            out[places[i], places[j]] = out[places[j], places[i]] = lower[i, j]


@compiled_sums
def looked_at(
    X: FloatArray, Y: FloatArray, terms: FloatArray, weights: FloatArray, courses: FloatArray, area: float,
    y: FloatArray, usable: BoolArray, read: FloatArray, gain: FloatArray, log_likelihood: FloatArray, score: FloatArray,
    information: FloatArray,
) -> None:  # fmt: skip
    """Log-likelihood, score and Fisher information of spots' pixels by the courses of their two paths, at a point.

    Parameters
    ----------
    X, Y:
        Share of a spot's light that each column and each row of pixels gets, and its derivatives by the spot's place,
        (terms + 1, spots, nodes, side).
    terms:
        Mehler's series of the kernel.
    courses:
        (nodes, m), and their ``weights``.
    y, usable:
        Densities, (spots, side * side).
    read, gain:
        Their variance without light, and how it grows with it, (spots,).
    log_likelihood, score, information:
        (spots,), (spots, 2 m) and (spots, 2 m, 2 m), x before y.
    """
    _, spots, nodes, side = X.shape
    m, pixels = courses.shape[1], side * side
    f, J = np.empty((side, side)), np.empty((2 * m, side, side))
    flat, light = J.reshape(2 * m, pixels), f.reshape(pixels)
    scores, fisher, weighted = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    for s in range(spots):
        f[:] = 0.0
        J[:] = 0.0
        for t in range(len(terms)):
            for k in range(nodes):
                for r in range(side):
                    a = terms[t] * weights[k] * Y[t, s, k, r] / area
                    b = terms[t] * weights[k] * Y[t + 1, s, k, r] / area
                    for c in range(side):
                        f[r, c] += a * X[t, s, k, c]
                    for q in range(m):
                        x, z = a * courses[k, q], b * courses[k, q]
                        for c in range(side):
                            J[q, r, c] += x * X[t + 1, s, k, c]
                        for c in range(side):
                            J[m + q, r, c] += z * X[t, s, k, c]
        total, product, quiet = 0.0, 1.0, 1.0 / read[s]
        for p in range(pixels):
            scores[p] = fisher[p] = 0.0
            if usable[s, p]:
                grows = gain[s] if light[p] > 0.0 else 0.0
                R = read[s] + grows * light[p]
                e = y[s, p] - light[p]
                total += e * e / R
                product *= R * quiet
                if product > LARGE:
                    total += math.log(product)
                    product = 1.0
                scores[p] = e / R + grows * (e * e / R - 1.0) / (2.0 * R)
                fisher[p] = 1.0 / R + grows * grows / (2.0 * R * R)
        log_likelihood[s] = -0.5 * (total + math.log(product))
        for i in range(2 * m):
            pull = 0.0
            for p in range(pixels):
                pull += flat[i, p] * scores[p]
                weighted[p] = flat[i, p] * fisher[p]
            score[s, i] = pull
            for j in range(i + 1):
                square = 0.0
                for p in range(pixels):
                    square += weighted[p] * flat[j, p]
                information[s, i, j] = information[s, j, i] = square
