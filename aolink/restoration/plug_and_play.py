"""Plug and play: steps of any denoiser and of the data term in turn. The module also has a denoiser, non-local means.

References
----------
Venkatakrishnan et al. 2013 (the principle); Buades et al. 2005 (non-local means); Froment 2014 (its fast form).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aolink.numerics.arrays import FloatArray
from aolink.restoration.markov import IterativeSolver

Denoiser = Callable[[FloatArray, float], FloatArray]
"""A function of a picture (rows, columns) and the standard deviation of its noise that gives the picture without
noise."""

# Coupling of scene and denoised picture, and the denoiser's first sd as a share of the picture's range.
_COUPLING = 0.23
_FIRST_SD = 0.1
_LAST_SD = 0.004
_ROUNDS = 4
_TOLERANCE = 3e-3


def plug_and_play(
    make_solver: Callable[[float], IterativeSolver], images: FloatArray, noise_variance: float,
    start: NDArray[np.floating[Any]], denoise: Denoiser,
) -> FloatArray:  # fmt: skip
    """Half-quadratic splitting: in turn, the scene x that minimises |image - H x|^2 / s^2 + rho |x - z|^2, and the
    denoised z of x.

    ``make_solver`` gives the solver of (H'WH + kappa I) for a kappa. Images, ``start``, a first restoration beyond the
    frame as well, and the result are (batch, rows, columns).
    """
    noise_sd, span = math.sqrt(noise_variance), float(np.ptp(images))
    last = max(noise_sd, _LAST_SD * span)
    x = z = np.asarray(start, np.float64)
    sds = np.geomspace(max(_FIRST_SD * span, last), last, _ROUNDS)
    for sd in sds:
        kappa = _COUPLING * noise_variance / sd**2
        solver = make_solver(kappa)
        x = np.asarray(solver.solve(solver.project(images) + kappa * z, z, _TOLERANCE), np.float64)
        if sd != sds[-1]:
            z = np.stack([denoise(each, float(sd)) for each in x])
    return x


def non_local_means(image: FloatArray, noise_sd: float) -> FloatArray:
    """Mean of the pixels within 7 pixels whose 5 x 5 neighbourhoods are similar, weighted by exp(-distance^2 / h^2).

    The squared distance is the mean squared difference less the 2 sd^2 of noise alone; h = 0.8 sd.
    """
    reach, patch, h = 7, 5, 0.8 * noise_sd
    rows, columns = image.shape
    wide = np.pad(image, reach, mode="reflect" if min(image.shape) > reach else "edge")
    total, weights = image.copy(), np.ones_like(image)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if dy == dx == 0:
                continue
            other = wide[reach + dy : reach + dy + rows, reach + dx : reach + dx + columns]
            distance = ndimage.uniform_filter((image - other) ** 2, patch)
            weight = np.exp(-np.maximum(distance - 2 * noise_sd**2, 0.0) / h**2)
            total += weight * other
            weights += weight
    return np.asarray(total / weights)
