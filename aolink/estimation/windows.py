"""Moments of many spots at once, each in a window of its own on a frame: two axes for each spot.

Where a plant's axes do not hang together, a spot's x and y need their own moments only, y_p0 and y_0q; with
cross moments they are `aolink.estimation.moments2d`'s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.moments import (
    Flux,
    Measurement,
    moments_from_sums,
    recombine,
    shift_matrix,
    with_shot_noise,
    without_kernel,
)
from aolink.optics.kernel import kernel_moments
from aolink.rig import Kernel

FloatArray = NDArray[np.float64]

# Spots together: more of them do not fit into the processor's cache.
_AT_ONCE = 128


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """The pixels about a spot, and what the camera makes of light there."""

    shape: tuple[int, int]
    """Rows and columns."""
    x_field: tuple[float, float]
    """Outer edges of the first and the last column, slope units."""
    y_field: tuple[float, float]
    """Outer edges of the first and the last row, slope units."""
    kernel: FloatArray
    """Covariance of the image kernel, slope units squared, (2, 2)."""
    noise_density: float
    """V of the plane, with what rounding adds: a pixel of area D_x D_y has noise variance V / (D_x D_y)."""
    black_level: float
    """Counts of a pixel that sees nothing."""
    counts_per_density: float
    """Counts for a density of one (one over slope units squared)."""
    photoelectrons: float = 0.0
    """Of the whole spot in one exposure; 0 means so many that shot noise does not matter."""


def measure_windows(
    window: Window, counts: NDArray[np.uint16], orders: Sequence[int] = (1, 2), flux: Flux = "known"
) -> Measurement | str:
    """Moments of spots without the kernel, y_p with E[y_p] = mean(theta_x^p) and mean(theta_y^p).

    Parameters
    ----------
    counts:
        (spots, rows, columns), no pixel missing or saturated.
    orders:
        Which moments, from 1.
    flux:
        As in `aolink.estimation.moments.measure_moments`.

    Returns
    -------
    Of the first spot x, then y, of the second x, and so on: (2 * spots) axes; or why there are none.

    References
    ----------
    Mishra & Wen (7) to (11), for the marginals of a two-dimensional frame.
    """
    if counts.shape[1:] != window.shape:
        raise ValueError(f"windows have {counts.shape[1:]} pixels, not {window.shape}")
    highest = max(orders)
    pixels = counts.reshape(len(counts), -1)
    raw = _sums(window, pixels, highest, window.black_level)
    both = []
    for axis in (0, 1):
        noise = window.noise_density * _noise_integrals(window, axis, 2 * highest)
        if window.photoelectrons:
            noise = with_shot_noise(noise, pixels, window.black_level, partial(_shot_sums, window, axis, 2 * highest))
        measured = moments_from_sums(raw[axis], noise, _unmixing(window, axis, highest), orders, flux)
        if isinstance(measured, str):
            return measured
        both.append(measured)
    x, y = both
    value = np.stack([x.value, y.value], axis=1).reshape(-1, len(orders))
    if x.covariance.strides[0] == y.covariance.strides[0] == 0 and (x.covariance[0] == y.covariance[0]).all():
        same = np.broadcast_to(x.covariance[0], (len(value), *x.covariance.shape[1:]))
        return Measurement(value=value, covariance=same)
    covariance = np.stack([x.covariance, y.covariance], axis=1).reshape(len(value), *x.covariance.shape[1:])
    return Measurement(value=value, covariance=covariance)


def _geometry(window: Window, axis: int) -> tuple[int, float, float]:
    """Pixels along x (0) or y (1), their width, and mid-field."""
    pixels, (low, high) = ((window.shape[1], window.x_field), (window.shape[0], window.y_field))[axis]
    return pixels, (high - low) / pixels, (low + high) / 2


def _sums(window: Window, pixels: NDArray[Any], highest: int, black_level: float) -> list[FloatArray]:
    """M_n along x and along y, kernel included, (spots, pixels of both), each (spots, highest + 1).

    Of counts over whole numbers, counts times odd pixel coordinates, which floating point does without rounding:
    no bit depends on how the sum is ordered.
    """
    rows, columns = window.shape
    odd = np.tile(_odd(columns), rows), np.repeat(_odd(rows), columns)
    weights = [odd[0] ** 0, *(each**n for each in odd for n in range(1, highest + 1))]
    sums = np.empty((len(weights), len(pixels)))
    for k in range(0, len(pixels), _AT_ONCE):
        block = pixels[k : k + _AT_ONCE].astype(np.float64)
        # One column at a time reads the pixels as fast as the cache gives them; all of them at once do not.
        for n, column in enumerate(weights):
            sums[n, k : k + _AT_ONCE] = block @ column
    sums -= black_level * np.array([column.sum() for column in weights])[:, None]
    out = []
    for axis in (0, 1):
        _, width, centre = _geometry(window, axis)
        _, other_width, _ = _geometry(window, 1 - axis)
        scale = width * other_width / window.counts_per_density * (width / 2) ** np.arange(highest + 1)
        raw = np.concatenate([sums[:1], sums[1 + axis * highest :][:highest]]) * scale[:, None]
        out.append(raw.T if centre == 0 else recombine(raw.T, shift_matrix(centre, highest)))
    return out


def _shot_sums(window: Window, axis: int, highest: int, light: FloatArray) -> FloatArray:
    return _sums(window, light, highest, 0.0)[axis] / window.photoelectrons


def _odd(pixels: int) -> FloatArray:
    """Pixel centres from mid-field, in half pixels."""
    return np.arange(1.0 - pixels, pixels, 2.0)


def _noise_integrals(window: Window, axis: int, highest: int) -> FloatArray:
    """Integral of x^n (or y^n) over the window, (highest + 1,)."""
    (low, high), (first, last) = (window.x_field, window.y_field)[:: 1 if axis == 0 else -1]
    n = np.arange(highest + 1)
    return np.asarray((high ** (n + 1) - low ** (n + 1)) / (n + 1) * (last - first))


def _unmixing(window: Window, axis: int, highest: int) -> FloatArray:
    _, width, _ = _geometry(window, axis)
    kernel = Kernel(shape="gaussian", sigma=math.sqrt(2 * window.kernel[axis, axis]))
    return without_kernel(kernel_moments(kernel, width, highest), highest)
