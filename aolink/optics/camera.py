"""The camera as an integer device: densities become counts and counts become densities.

A pixel's size D is its length on a line sensor, and its area on a plane.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.sensor import BaseSensor


def to_counts(sensor: BaseSensor, density: FloatArray) -> NDArray[np.uint16]:
    """The counts that the camera reads out for a density: rounded, and cut at zero and at full scale."""
    counts = np.rint(sensor.black_level + sensor.counts_per_density * density)
    return np.clip(counts, 0, sensor.full_scale).astype(np.uint16)


def to_density(sensor: BaseSensor, counts: NDArray[np.uint16] | FloatArray) -> FloatArray:
    """The density for counts, shape of ``counts``; noise makes it negative where there is no light."""
    return (counts.astype(np.float64) - sensor.black_level) / sensor.counts_per_density


def is_saturated(sensor: BaseSensor, counts: NDArray[np.uint16]) -> BoolArray:
    """True where a count is at an end of the scale (zero or full scale), so that the light is not known."""
    return np.asarray((counts == 0) | (counts >= sensor.full_scale))


def pixel_noise_sd(sensor: BaseSensor) -> float:
    """Standard deviation of a pixel's density by read-out noise, sqrt(V/D)."""
    return math.sqrt(sensor.noise_density / sensor.pixel_size)


def shot_gain(sensor: BaseSensor) -> float:
    """Variance of a pixel's density by shot noise for each unit of density, 1/(photoelectrons D); 0 if negligible."""
    return 1 / (sensor.photoelectrons * sensor.pixel_size) if sensor.photoelectrons else 0.0


def effective_noise_density(sensor: BaseSensor) -> float:
    """V with the rounding to whole counts added (variance 1/12 of a count), so that it is never zero."""
    return sensor.noise_density + sensor.pixel_size / (12 * sensor.counts_per_density**2)
