"""The picture sensor, a second sensor that shares the spot's exposure and sees a scene that the same mirror moves.

An intensity of one is the brightest that a picture file of whole numbers can hold, and 0 is dark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from aolink.keys import NotNegative, Positive, Within
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.sensor import BitDepth, Kernel, read_kernel, row_starts_s


@dataclass(frozen=True, kw_only=True)
class SceneSensor:
    """The picture sensor."""

    pixels: tuple[Annotated[int, Within(2, 8192)], Annotated[int, Within(2, 8192)]]
    """Rows and columns of pixels."""
    pixel_scale: Positive
    """Slope units of the spot that move the scene by one pixel."""
    kernel: Annotated[Kernel, read_kernel]
    """Image kernel of the picture's optics; its width is in slope units, as the spot's."""
    noise_sd: NotNegative
    """Standard deviation of a pixel's intensity by read-out noise."""
    bit_depth: BitDepth = 16
    black_level: NotNegative = 0.0
    """Counts of a dark pixel."""
    counts_per_intensity: Positive
    picture: str = ""
    """Picture that a simulated rig shows: a file beside the rig file, or one that comes with aolink; may be empty."""
    picture_pixels: Annotated[int, Within(1, 64)] = 1
    """Rows and columns of the picture's own pixels in one of the sensor's."""
    row_time_s: Annotated[float, Within(-1.0, 1.0)] | None = None
    """As `BaseSensor.row_time_s`, for the rows of the picture."""

    @cached_property
    def row_starts_s(self) -> FloatArray:
        """When each row's exposure starts, after that of the row that starts first, s, (rows,)."""
        return row_starts_s(self.row_time_s, self.shape[0])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of pixels."""
        return self.pixels

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return (1 << self.bit_depth) - 1

    def to_counts(self, intensity: FloatArray) -> NDArray[np.uint16]:
        """The counts that the sensor reads out: rounded, and cut at zero and at full scale."""
        counts = np.rint(self.black_level + self.counts_per_intensity * intensity)
        return np.clip(counts, 0, self.full_scale).astype(np.uint16)

    def to_intensity(self, counts: NDArray[np.uint16]) -> FloatArray:
        """The intensity for counts; noise makes it negative where it is dark."""
        return np.asarray((counts.astype(np.float64) - self.black_level) / self.counts_per_intensity)

    def is_saturated(self, counts: NDArray[np.uint16]) -> BoolArray:
        """True where a count is at an end of the scale."""
        return np.asarray((counts == 0) | (counts >= self.full_scale))


def scene_motion(n_outputs: int) -> FloatArray:
    """Matrix (1 or 2, n_outputs) whose product with the rig's outputs is the scene's displacement, slope units: the
    spots' mean displacement along x and y, or along x for a line sensor."""
    return np.eye(1) if n_outputs == 1 else np.tile(np.eye(2), (1, n_outputs // 2)) / (n_outputs // 2)


def framed(sensor: SceneSensor, picture: FloatArray) -> FloatArray:
    """The middle of a picture in the sensor's pixels, each the mean of the picture's pixels in it, (rows, columns)."""
    return framed_columns(sensor, framed_rows(sensor, picture))


def framed_rows(sensor: SceneSensor, picture: FloatArray) -> FloatArray:
    """The picture as by `framed`, for the rows alone, (rows, the picture's columns)."""
    n, rows = sensor.picture_pixels, sensor.shape[0]
    top = (picture.shape[0] - n * rows) // 2
    return np.asarray(picture[top : top + n * rows].reshape(rows, n, -1).mean(axis=1))


def framed_columns(sensor: SceneSensor, picture: FloatArray) -> FloatArray:
    """The picture as by `framed`, for the columns alone, (the picture's rows, columns)."""
    return framed_rows(replace(sensor, pixels=sensor.shape[::-1]), picture.T).T
