"""Total variation by ADMM (alternating direction method of multipliers).

Along lines its linear step is the exact Gauss-Markov one. On the plane this step would take conjugate gradients in each
iteration, so there the blurred plane is split off as well, and the linear step is a division of spectra.

References
----------
Boyd et al. 2011 (ADMM); Matakos, Ramani & Fessler 2013 and Almeida & Figueiredo 2013 (borders by splitting the plane
off before it is masked); Bauschke, Goebel, Lucet & Wang 2008 (the proximal average).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.numerics.arrays import BoolArray
from aolink.restoration.markov import PeriodicPlane, Solver, differences_transposed, inverse_spectrum, single_is_enough

FloatingArray = NDArray[np.floating[Any]]

# Weight of total variation in square roots of lambda, for Laplacian differences about as large as Gaussian ones.
WEIGHT = 1.2
# Penalty on the split differences, in lambdas, and over-relaxation: with these, six iterations converge.
PENALTY = 3.0
_RELAXATION = 1.7
ITERATIONS = 6
# Inner accuracy where the linear step is iterative.
_TOLERANCE = 3e-3


def total_variation(
    make_solver: Callable[[float], Solver], images: FloatingArray, noise_variance: float, difference_weight: float,
    iterations: int = ITERATIONS,
) -> tuple[FloatingArray, Solver]:  # fmt: skip
    """Minimise |image - H scene|^2 / (2 s^2) + w sum |gradient of scene|, w = 1.2 sqrt(lambda), lambda one over the
    variance of the scene's differences (``difference_weight``).

    ``make_solver`` gives the solver for a kappa; images are (batch, rows, columns). The result is the scenes, beyond
    the frame as well, (batch, rows, columns), and their solver, which knows where the frame lies.
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
        kept = _shrinkage(along, down, threshold)
        right = differences_transposed(*((2 * f - 1) * v for f, v in zip(kept, (along, down), strict=True)))
        right *= kappa
        right += seen
        x = solver.solve(right, x, _TOLERANCE)
        for f, v, axis in zip(kept, (along, down), (-1, -2), strict=True):
            f *= -_RELAXATION
            f += 1
            v *= f
            new = np.diff(x, axis=axis)
            new *= _RELAXATION
            v += new
    return x, solver


def _shrinkage(along: FloatingArray, down: FloatingArray, threshold: float) -> tuple[FloatingArray, FloatingArray]:
    """The share that differences along rows (..., rows, columns - 1) and down columns (..., rows - 1, columns) keep.

    A pixel has four gradients, of a difference to its left or right and one above or below, and keeps
    max(1 - threshold / |gradient|, 0) of each. A difference keeps the mean of the four that it is part of. This is the
    proximal operator of the proximal average of the four total variations, so the minimised function is convex and
    treats all four diagonal directions alike.
    """
    *batch, rows, columns = (*along.shape[:-1], down.shape[-1])
    across = np.zeros((*batch, rows, columns + 1), along.dtype)
    upright = np.zeros((*batch, rows + 1, columns), along.dtype)
    np.square(along, out=across[..., :, 1:-1])
    np.square(down, out=upright[..., 1:-1, :])
    left, right, above, below = across[..., :-1], across[..., 1:], upright[..., :-1, :], upright[..., 1:, :]

    def lost(one: FloatingArray, other: FloatingArray) -> FloatingArray:
        """A quarter of the share that a gradient with these squares loses."""
        size = one + other
        np.maximum(size, threshold * threshold, out=size)
        np.sqrt(size, out=size)
        return np.divide(-threshold / 4, size, out=size)

    right_below, right_above, left_below, left_above = (lost(a, b) for a in (right, left) for b in (below, above))
    keep_along = right_below[..., :-1] + right_above[..., :-1]
    keep_along += left_below[..., 1:]
    keep_along += left_above[..., 1:]
    keep_along += 1
    keep_down = right_below[..., :-1, :] + left_below[..., :-1, :]
    keep_down += right_above[..., 1:, :]
    keep_down += left_above[..., 1:, :]
    keep_down += 1
    return keep_along, keep_down


PLANE_ITERATIONS = 28
# Penalties on the split plane, in weights of a pixel, and on the split differences, in lambdas, for which these
# iterations are enough.
_PLANE_PENALTY = 0.07
_DIFFERENCE_PENALTY = 6.0


def plane_weight(noise_variance: float, difference_weight: float) -> float:
    """Weight of total variation on the plane: 0.32 lambda^0.2 / s^0.6.

    A fit to the best weights of six pictures, two measured camera-shake kernels and three noises: it is off by a factor
    of 1.2 (root mean square), 1.6 at worst. A weight of 1.2 times the root of lambda, which depends mostly on the
    largest edges, is off by 1.7 and 3.3.
    """
    return float(0.32 * difference_weight**0.2 * noise_variance**-0.3)


def plane_total_variation(
    plane: PeriodicPlane, images: NDArray[np.float64], noise_variance: float, difference_weight: float,
    seen: BoolArray | None = None, iterations: int = PLANE_ITERATIONS,
) -> FloatingArray:  # fmt: skip
    """Minimise |W (image - H scene)|^2 / (2 s^2) + w sum |gradient of scene|, with w of `plane_weight`.

    The splits are u = H scene, on a periodic plane, in which the data weight the measured pixels of the frame, and the
    scene's differences, of which those across the periodic border have weight zero.

    Parameters
    ----------
    plane:
        The PSF's transforms.
    images:
        (batch, rows, columns), with likely values where nothing was measured.
    noise_variance, difference_weight:
        s^2, and lambda, one over the variance of the scene's differences.
    seen:
        W, (rows, columns), False where nothing was measured; None where all was.

    Returns
    -------
    The scenes, beyond the frame as well, (batch, rows, columns).
    """
    kappa = _DIFFERENCE_PENALTY * difference_weight * noise_variance
    threshold = plane_weight(noise_variance, difference_weight) * noise_variance / kappa
    single = single_is_enough(kappa, float(plane.taps.sum()))
    real, complex_ = (np.dtype(np.float32), np.dtype(np.complex64)) if single else (np.dtype(float), np.dtype(complex))
    transfer: NDArray[np.complexfloating[Any]] = plane.transfer.astype(complex_)
    share = kappa / _PLANE_PENALTY
    solve: FloatingArray = inverse_spectrum(plane.transfer, plane.rough, share).astype(real)
    back = transfer.conj()
    weight: FloatingArray = np.zeros(plane.shape, real)
    weight[plane.blurred] = 1.0 if seen is None else seen
    data: FloatingArray = np.zeros((len(images), *plane.shape), real)
    data[..., *plane.blurred] = images
    data *= weight
    part = 1 / (weight + _PLANE_PENALTY)
    rows, columns = plane.scene
    spectrum = plane.forward(plane.guess(images, difference_weight * noise_variance).astype(real))
    # The splits of the blurred plane and of the differences, plus their scaled dual variables, as above.
    u, x = plane.backward(spectrum * transfer), plane.backward(spectrum)
    along, down = _next(x, -1), _next(x, -2)
    shrunk_along, shrunk_down = along[..., :rows, : columns - 1], down[..., : rows - 1, :columns]
    for _ in range(iterations):
        kept_along, kept_down = _shrinkage(shrunk_along, shrunk_down, threshold)
        split_u, split_along, split_down = (data + _PLANE_PENALTY * u) * part, along.copy(), down.copy()
        split_along[..., :rows, : columns - 1] *= kept_along
        split_down[..., : rows - 1, :columns] *= kept_down
        right = _before(2 * split_along - along, -1) + _before(2 * split_down - down, -2)
        spectrum = (plane.forward(2 * split_u - u) * back + share * plane.forward(right)) * solve
        blurred, x = plane.backward(spectrum * transfer), plane.backward(spectrum)
        for v, new, split in (
            (u, blurred, split_u),
            (along, _next(x, -1), split_along),
            (down, _next(x, -2), split_down),
        ):
            new -= split
            new *= _RELAXATION
            v += new
    return x[..., :rows, :columns]


def _next(x: FloatingArray, axis: int) -> FloatingArray:
    """The next pixel less this one, for each pixel, periodically."""
    out = np.roll(x, -1, axis)
    out -= x
    return out


def _before(x: FloatingArray, axis: int) -> FloatingArray:
    """The transpose of `_next`."""
    out = np.roll(x, 1, axis)
    out -= x
    return out
