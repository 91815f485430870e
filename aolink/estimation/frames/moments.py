"""Spatial moments of an exposure: measured from counts, with the covariance of their noise.

The p-th moment is sum omega^p Y D over the pixels, with omega the pixel's centre, Y its density and D its
width. The kernel and the pixels' width add to it as independent variables do; their contribution is removed, so that
E[y_p] = mean(theta^p). Mishra & Wen (7) to (11).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.frames.frame_data import Measurement
from aolink.numerics import batched
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.camera import effective_noise_density
from aolink.optics.kernel import kernel_moments
from aolink.optics.sensor import Sensor

Counts = NDArray[np.uint16] | FloatArray

# A smeared spot falls short of the first about once in eighty; a frame without one reaches the second once in 270.
_LEAST, _ENOUGH = 2.0, 4.0


def raw_moments(sensor: Sensor, counts: Counts, highest: int) -> FloatArray:
    """M_p = sum omega^p Y D for p = 0 .. highest, kernel included, (axes, pixels) -> (axes, highest + 1).

    Summed over whole numbers, counts times odd pixel coordinates, which floating point does without
    rounding for all but huge sensors: so no axis depends on its neighbours, whatever BLAS does.
    """
    odd = 2.0 * np.arange(sensor.pixels) + 1 - sensor.pixels  # pixel centres from mid-field, in half pixels
    powers = odd[:, None] ** np.arange(highest + 1)
    # Contiguous in memory along the axes, so that what follows is fast for many of them.
    sums = (powers.T @ counts.T.astype(np.float64, copy=False)).T - sensor.black_level * powers.sum(axis=0)
    half, centre = sensor.pixel_width / 2, sum(sensor.field) / 2
    about_centre: FloatArray = sums * (half ** np.arange(highest + 1) * sensor.pixel_width / sensor.counts_per_density)
    if centre == 0:
        return about_centre
    return recombine(about_centre, _binomial_sums([centre**k for k in range(highest + 1)]))


def noise_integrals(sensor: Sensor, highest: int) -> FloatArray:
    """I(n), integral of omega^n over the field, for n = 0 .. highest, (highest + 1,).

    Cov(M_p, M_q) = V I(p + q): on [-1, 1], 2/3 V and 2/5 V for orders 1 and 2, and 0 between. (11)
    """
    low, high = sensor.field
    return np.array([(high ** (n + 1) - low ** (n + 1)) / (n + 1) for n in range(highest + 1)])


def without_kernel(kernel: FloatArray) -> FloatArray:
    """The matrix that removes the kernel from moments 0 .. highest, (highest + 1, highest + 1).

    The moments found are M_p = sum_k binom(p, k) kernel_k m_(p-k); this is the inverse of that map.
    """
    return np.asarray(np.linalg.inv(_binomial_sums(kernel)))


def _binomial_sums(of: Sequence[float] | FloatArray) -> FloatArray:
    """The matrix of M_p = sum_k binom(p, k) of_k m_(p-k), as many rows as there are numbers."""
    mixing = np.zeros((len(of), len(of)))
    for p in range(len(of)):
        for k in range(p + 1):
            mixing[p, p - k] = math.comb(p, k) * of[k]
    return mixing


def measure_moments(
    sensor: Sensor, counts: Counts, orders: Sequence[int], light: FloatArray | None = None
) -> Measurement:
    """Moments of line-sensor frames without the kernel, y_p with E[y_p] = mean(theta^p).

    The total is one, as Mishra & Wen (9) to (11) take it.

    Parameters
    ----------
    counts:
        One row for each axis, (axes, pixels), none missing or saturated.
    orders:
        Orders of the moments, from 1.
    light:
        Light of each spot as a share of a whole one's, (axes,); one where None.
    """
    highest = max(orders)
    noise = effective_noise_density(sensor) * noise_integrals(sensor, 2 * highest)
    if sensor.photoelectrons:
        noise = _with_shot_noise(sensor, noise, counts)
    raw = raw_moments(sensor, counts, highest)
    if light is not None:
        raw, noise = raw / light[:, None], noise / light[:, None] ** 2
    everything = np.arange(raw.shape[1])
    raw[:, 0] = 1.0
    covariance = np.array(noise[..., everything[:, None] + everything])
    covariance[..., 0, :] = covariance[..., :, 0] = 0.0
    unmix = _unmixing(sensor, highest)[list(orders)]
    covariance = batched.congruence(unmix, covariance if covariance.ndim == 3 else covariance[None])
    return Measurement(
        value=recombine(raw, unmix), covariance=np.broadcast_to(covariance, (len(raw), *covariance.shape[1:]))
    )


def _with_shot_noise(sensor: Sensor, read: FloatArray, counts: Counts) -> FloatArray:
    """Cov(M_p, M_q) by p + q with shot noise of the light as measured, from that by read-out noise alone, (n,).

    Shot noise adds y_(p+q) / photoelectrons, (axes, n).
    """
    powers = sensor.centres[:, None] ** np.arange(len(read))
    scale = sensor.pixel_width / (sensor.counts_per_density * sensor.photoelectrons)

    def noisy(light: FloatArray) -> FloatArray:
        # A product for each row: the bits of one for all would depend on their number.
        return np.asarray(read + (np.ascontiguousarray(light)[:, None] @ powers)[:, 0] * scale)

    light = counts.astype(np.float64) - sensor.black_level
    noise = noisy(light)
    # Where noise makes the light so negative that this is no covariance, light is what is above the black level.
    poor = ~_is_covariance(noise)
    if poor.any():
        noise[poor] = noisy(np.maximum(light[poor], 0.0))
    return noise


def _is_covariance(noise: FloatArray) -> BoolArray:
    """Whether the matrices with entries noise[p + q] are positive definite, (axes, 2 highest + 1) -> (axes,)."""
    size = noise.shape[1] // 2 + 1
    left = [[noise[:, p + q] for q in range(size)] for p in range(size)]
    good = np.ones(len(noise), dtype=bool)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for k in range(size):
            good &= left[k][k] > 0
            for p in range(k + 1, size):
                for q in range(k + 1, size):
                    left[p][q] = left[p][q] - left[p][k] * left[k][q] / left[k][k]
    return good


def spot_significance(sensor: Sensor, density: FloatArray) -> FloatArray:
    """Light of each row's brightest stretch in standard deviations of its noise, over several lengths.

    Densities (n, pixels) -> (n,).
    """
    light = np.zeros((sensor.pixels + 1, len(density)))
    if len(density) < sensor.pixels:
        np.cumsum(density.T, axis=0, out=light[1:])
    else:  # the same sums; NumPy's own are slow across long rows
        for k in range(sensor.pixels):
            np.add(light[k], density[:, k], out=light[k + 1])
    lengths = [2**k for k in range(sensor.pixels.bit_length()) if 2**k <= sensor.pixels]
    gained = [(light[n:] - light[:-n]).max(axis=0) / math.sqrt(n) for n in lengths]
    return np.asarray(np.max(gained, axis=0) * significance_scale(sensor))


def significance_scale(sensor: Sensor) -> float:
    """One over the standard deviation of a pixel's density."""
    return math.sqrt(sensor.pixel_width / effective_noise_density(sensor))


def least_significance(sensor: Sensor, light: FloatArray | float = 1.0) -> FloatArray:
    """The least `spot_significance` of a frame that has a spot, however widely it is smeared.

    The significance of light as wide as the field is its total over the total's noise, one less by chance. Where that
    is large, a frame without a spot hardly ever reaches it; where it is small, most do, but their moments' covariance
    is large. ``light`` is the spot's as a share of a whole one's.
    """
    total = light / math.sqrt(effective_noise_density(sensor) * (sensor.field[1] - sensor.field[0]))
    return np.clip(total - 1, _LEAST, _ENOUGH)


@lru_cache(maxsize=16)
def _unmixing(sensor: Sensor, highest: int) -> FloatArray:
    return without_kernel(kernel_moments(sensor.kernel, sensor.pixel_width, highest))


def recombine(moments: FloatArray, matrix: FloatArray) -> FloatArray:
    """matrix @ moments for each axis, in elementwise operations."""
    return np.stack([sum(row[k] * moments[:, k] for k in range(len(row))) for row in matrix]).T
