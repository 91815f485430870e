"""Total variation by ADMM (alternating direction method of multipliers).

Along lines its linear step is the exact Gauss-Markov one. On the plane that would take conjugate gradients in each
iteration, so there the blurred plane is split off as well and the linear step is a division of spectra.

References
----------
Boyd et al. 2011 (ADMM); Matakos, Ramani & Fessler 2013 and Almeida & Figueiredo 2013 (borders by splitting the plane
off before it is masked).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.numerics.arrays import BoolArray
from aolink.restoration.markov import Plane, Solver, differences_transposed, inverse_spectrum, single_is_enough

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


PLANE_ITERATIONS = 40
# Penalty on the split plane, in weights of a pixel, for which these iterations are enough.
_PLANE_PENALTY = 0.05


def plane_weight(noise_variance: float, difference_weight: float) -> float:
    """Weight of total variation on the plane: 0.32 lambda^0.2 / s^0.6.

    A fit to the best weights of six pictures, two measured camera-shake kernels and three noises: it is off by a factor
    of 1.2 (root mean square), 1.6 at worst. 1.2 times the root of lambda, which the largest edges decide, is off by 1.7
    and 3.3.
    """
    return float(0.32 * difference_weight**0.2 * noise_variance**-0.3)


def plane_total_variation(
    plane: Plane,
    images: NDArray[np.float64],
    noise_variance: float,
    difference_weight: float,
    seen: BoolArray | None = None,
    iterations: int = PLANE_ITERATIONS,
) -> FloatArray:
    """Minimise |W (image - H scene)|^2 / (2 s^2) + w sum |gradient of scene|, with w of `plane_weight`.

    The splits are u = H scene, on a plane that goes round, of which the data weigh the pixels of the frame that were
    measured, and the scene's differences, of which those that go round weigh nothing.

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
    kappa = PENALTY * difference_weight * noise_variance
    threshold = plane_weight(noise_variance, difference_weight) * noise_variance / kappa
    single = single_is_enough(kappa, float(plane.taps.sum()))
    real, complex_ = (np.dtype(np.float32), np.dtype(np.complex64)) if single else (np.dtype(float), np.dtype(complex))
    transfer: NDArray[np.complexfloating[Any]] = plane.transfer.astype(complex_)
    share = kappa / _PLANE_PENALTY
    solve: FloatArray = inverse_spectrum(plane.transfer, plane.rough, share).astype(real)
    back = transfer.conj()
    weight: FloatArray = np.zeros(plane.shape, real)
    weight[plane.blurred] = 1.0 if seen is None else seen
    data: FloatArray = np.zeros((len(images), *plane.shape), real)
    data[..., *plane.blurred] = images
    data *= weight
    part = 1 / (weight + _PLANE_PENALTY)
    rows, columns = plane.scene
    spectrum = plane.forward(plane.guess(images, difference_weight * noise_variance).astype(real))
    dual = np.zeros_like(data)
    # Differences plus scaled dual variables, as above.
    along = down = np.zeros_like(data)
    for k in range(iterations + 1):
        u, x = plane.backward(spectrum * transfer), plane.backward(spectrum)
        if k == iterations:
            break
        u += dual
        dual = u - (data + _PLANE_PENALTY * u) * part
        u -= 2 * dual
        along, down = along + _next(x, -1), down + _next(x, -2)
        f = _shrinkage(along[..., :rows, : columns - 1], down[..., : rows - 1, :columns], threshold)
        split_along, split_down = along.copy(), down.copy()
        split_along[..., :rows, : columns - 1] *= 2 * f[..., :, :-1] - 1
        split_down[..., : rows - 1, :columns] *= 2 * f[..., :-1, :] - 1
        right = _before(split_along, -1) + _before(split_down, -2)
        spectrum = (plane.forward(u) * back + share * plane.forward(right)) * solve
        along, down = (along - split_along) / 2, (down - split_down) / 2
    return x[..., :rows, :columns]


def _next(x: FloatArray, axis: int) -> FloatArray:
    """Each pixel's next one less itself, round the plane."""
    out = np.roll(x, -1, axis)
    out -= x
    return out


def _before(x: FloatArray, axis: int) -> FloatArray:
    """The transpose of `_next`."""
    out = np.roll(x, 1, axis)
    out -= x
    return out
