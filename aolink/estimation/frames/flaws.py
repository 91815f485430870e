"""What a frame's flaws cost is bought back before anything is measured: defective pixels, an unknown pedestal."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.frames.frame_data import Needs
from aolink.exposure import Exposure
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.camera import effective_noise_density, is_saturated
from aolink.optics.frame import spot_windows
from aolink.optics.sensor import BaseSensor

_LIT = 3.0
"""A pixel that is brighter than the pedestal by as many standard deviations of its noise is lit."""
_BESIDE = 2.0
"""Pixels are not taken for dark within as many of the kernel's standard deviations of a lit one."""
_FEWEST = 4
"""Fewer dark pixels than this show no pedestal."""
_ROUNDS = 12


def has_flaws(sensor: BaseSensor) -> bool:
    """Whether `without_flaws` changes anything."""
    return bool(sensor.defects) or sensor.pedestal == "free"


def without_flaws(sensor: BaseSensor, exposure: Exposure, needs: Needs) -> Exposure:
    """The exposure as an estimator shall take it.

    Defects of the sensor are missing pixels where each pixel is taken for itself; for moments, and for windows that are
    summed, they are interpolated from the pixels about them. Where the pedestal is free, it is subtracted from each
    window.
    """
    from aolink.optics.maxima import mended  # SciPy takes long to load, and few rigs need it here

    pixels: NDArray[Any] = exposure.pixels
    mask, defects = exposure.mask, sensor.defect_mask
    if pixels.shape != sensor.shape or exposure.slopes is not None:
        return exposure
    usable = mask & ~is_saturated(sensor, pixels)
    if defects is not None:
        usable &= ~defects
        if needs.what == "moments" or (sensor.directions == 2 and needs.what == "profile"):
            pixels, mask = mended(pixels.astype(np.float64), defects), mask | defects
        else:
            mask = mask & ~defects
    if sensor.pedestal == "free":
        dark = pedestals(sensor, pixels, usable) - sensor.black_level
        whole = np.zeros(sensor.shape)
        for spot, value in enumerate(dark.tolist()):
            whole[sensor.window_of(spot)] = value
        # A count at an end of the scale stays one.
        pixels = np.where(is_saturated(sensor, exposure.pixels), exposure.pixels, pixels - whole)
    return replace(exposure, pixels=pixels, mask=mask)


def pedestals(sensor: BaseSensor, pixels: NDArray[np.uint16] | FloatArray, usable: BoolArray) -> FloatArray:
    """Counts of a pixel in the dark, for each window of a frame, (spots,); ``sensor.black_level`` where too few are.

    The mean of the pixels that no light reaches: those that are neither brighter than that mean by `_LIT` standard
    deviations of the noise nor near one that is, from the darkest quarter on (sigma clipping).
    """
    from scipy import ndimage

    counts, good = spot_windows(sensor, pixels.astype(np.float64)), spot_windows(sensor, usable)
    reach = math.ceil(_BESIDE * math.sqrt(sensor.kernel.variance) / sensor.pixel_width)
    beside = np.ones((1, min(2 * reach + 1, 2 * counts.shape[1] - 1), 2 * reach + 1), dtype=bool)
    noise = effective_noise_density(sensor) / sensor.pixel_size * sensor.counts_per_density**2
    of_shot = sensor.counts_per_density / (sensor.photoelectrons * sensor.pixel_size) if sensor.photoelectrons else 0.0
    known = np.where(good, counts, np.nan).reshape(len(counts), -1)
    level = np.nanquantile(known, 0.25, axis=1) if good.any() else np.full(len(counts), sensor.black_level)
    enough = np.isfinite(level)
    for _ in range(_ROUNDS):
        sd = np.sqrt(noise + of_shot * np.maximum(level - sensor.black_level, 0.0))
        lit = good & (counts > (level + _LIT * sd)[:, None, None])
        dark = good & ~ndimage.binary_dilation(lit, beside)
        number = np.count_nonzero(dark, axis=(1, 2))
        enough &= number >= _FEWEST
        before, level = level, np.where(dark, counts, 0.0).sum(axis=(1, 2)) / np.maximum(number, 1)
        if np.array_equal(before[enough], level[enough]):
            break
    return np.where(enough, level, sensor.black_level)
