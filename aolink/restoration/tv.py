"""Total variation by ADMM (alternating direction method of multipliers), with the exact Gauss-Markov linear step."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.restoration.markov import Solver, differences_transposed

FloatArray = NDArray[np.floating[Any]]

# Weight of total variation in square roots of lambda, for Laplacian differences about as large as Gaussian ones.
WEIGHT = 1.2
# Penalty on the split differences, in lambdas, and over-relaxation: with these, six iterations converge.
PENALTY = 3.0
_RELAXATION = 1.7
ITERATIONS = 6
# Inner accuracy where the linear step is iterative.
_TOLERANCE = 3e-3


def total_variation(
    make_solver: Callable[[float], Solver],
    images: FloatArray,
    noise_variance: float,
    difference_weight: float,
    iterations: int = ITERATIONS,
) -> tuple[FloatArray, Solver]:
    """Minimise |image - H scene|^2 / (2 s^2) + w sum |gradient of scene|, w = 1.2 sqrt(lambda).

    Parameters
    ----------
    make_solver:
        Gives the solver for a kappa.
    images:
        (batch, rows, columns)
    noise_variance, difference_weight:
        s^2, and lambda, one over the variance of the scene's differences.

    Returns
    -------
    The scenes, beyond the frame as well, (batch, rows, columns), and their solver, which knows where the frame lies.
    """
    penalty = PENALTY * difference_weight
    kappa = penalty * noise_variance
    threshold = WEIGHT * math.sqrt(difference_weight) / penalty
    solver = make_solver(kappa)
    seen = solver.project(images)
    x = solver.solve(seen, solver.guess(images), _TOLERANCE)
    # Differences plus scaled dual variables: times the shrinkage f they are the split differences, the rest the duals.
    along, down = np.diff(x, axis=-1), np.diff(x, axis=-2)
    for _ in range(iterations):
        f = _shrinkage(along, down, threshold)
        kept = 2 * f
        kept -= 1
        right = differences_transposed(kept[..., :, :-1] * along, kept[..., :-1, :] * down)
        right *= kappa
        right += seen
        x = solver.solve(right, x, _TOLERANCE)
        f *= -_RELAXATION
        f += 1
        along *= f[..., :, :-1]
        down *= f[..., :-1, :]
        for v, new in ((along, np.diff(x, axis=-1)), (down, np.diff(x, axis=-2))):
            new *= _RELAXATION
            v += new
    return x, solver


def _shrinkage(along: FloatArray, down: FloatArray, threshold: float) -> FloatArray:
    """max(1 - threshold / |gradient|, 0) at each pixel."""
    size = np.zeros((*along.shape[:-1], down.shape[-1]), along.dtype)
    np.square(along, out=size[..., :-1])
    size[..., :-1, :] += down * down
    np.sqrt(size, out=size)
    np.maximum(size, threshold, out=size)
    np.divide(-threshold, size, out=size)
    size += 1
    return size
