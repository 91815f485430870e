"""A second, picture sensor that shares the spot's exposure: a scene that the same mirror moves.

An intensity of one is the brightest that a picture file of whole numbers can hold, and 0 is dark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aolink.errors import RestorationError, RigError
from aolink.pictures import read_picture
from aolink.sensor import Kernel, read_kernel
from aolink.toml_table import Table

FloatArray = NDArray[np.float64]

_SHIPPED = Path(__file__).parent / "rigs"
_LUMINANCE = (0.2126, 0.7152, 0.0722)


@dataclass(frozen=True, kw_only=True)
class SceneSensor:
    """The picture sensor."""

    shape: tuple[int, int]
    """Rows and columns of pixels."""
    pixel_scale: float
    """Slope units of the spot that move the scene by one pixel."""
    kernel: Kernel
    """Of the picture's optics; its width is in slope units, as the spot's."""
    noise_sd: float
    """Standard deviation of a pixel's intensity by read-out noise."""
    bit_depth: int
    black_level: float
    """Counts of a dark pixel."""
    counts_per_intensity: float
    picture: str
    """What a simulated rig shows: a picture file beside the rig file, or one that comes with aolink; may be empty."""
    picture_pixels: int
    """Rows and columns of the picture's own pixels in one of the sensor's."""

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return (1 << self.bit_depth) - 1

    def to_counts(self, intensity: FloatArray) -> NDArray[np.uint16]:
        """What the sensor reads out: rounded, and cut at zero and at full scale."""
        counts = np.rint(self.black_level + self.counts_per_intensity * intensity)
        return np.clip(counts, 0, self.full_scale).astype(np.uint16)

    def to_intensity(self, counts: NDArray[np.uint16]) -> FloatArray:
        """The intensity that counts stand for; noise makes it negative where it is dark."""
        return np.asarray((counts.astype(np.float64) - self.black_level) / self.counts_per_intensity)

    def is_saturated(self, counts: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """True where a count is at an end of the scale."""
        return np.asarray((counts == 0) | (counts >= self.full_scale))


def read_scene(table: Table) -> SceneSensor:
    """The table ``[scene]``; the picture itself is not opened. Raises `RigError`."""
    kernel_table = table.table("kernel")
    kernel = read_kernel(kernel_table)
    kernel_table.finish()
    rows, columns = table.integers("pixels", 2, "rows and columns", low=2, high=8192)
    sensor = SceneSensor(
        shape=(rows, columns),
        pixel_scale=table.number("pixel_scale", above=0.0),
        kernel=kernel,
        noise_sd=table.number("noise_sd", low=0.0),
        bit_depth=table.integer("bit_depth", 16, low=1, high=16),
        black_level=table.number("black_level", 0.0, low=0.0),
        counts_per_intensity=table.number("counts_per_intensity", above=0.0),
        picture=table.text("picture", ""),
        picture_pixels=table.integer("picture_pixels", 1, low=1, high=64),
    )
    if sensor.black_level >= sensor.full_scale:
        raise RigError(f"scene.black_level = {sensor.black_level:g} is not below the full scale, {sensor.full_scale}")
    table.finish()
    return sensor


def scene_motion(n_outputs: int) -> FloatArray:
    """How the scene moves when the spots do: as their mean along x and y; along x alone where a line is seen.

    Returns
    -------
    (1 or 2, n_outputs): times the rig's outputs it is the scene's displacement, slope units.
    """
    return np.eye(1) if n_outputs == 1 else np.tile(np.eye(2), (1, n_outputs // 2)) / (n_outputs // 2)


def read_scene_picture(sensor: SceneSensor, folder: Path) -> FloatArray:
    """The picture that a simulated rig shows, in its own, finer pixels; grey, 0 to 1 where it holds whole numbers.

    Parameters
    ----------
    folder:
        Of the rig file; what is not in it may come with aolink.

    Raises
    ------
    RigError
        There is none, it cannot be read, or it is smaller than the sensor's frame.
    """
    if not sensor.picture:
        raise RigError("scene.picture is missing: a simulated rig needs a picture to show")
    beside, shipped = folder / sensor.picture, _SHIPPED / sensor.picture
    try:
        found = read_picture(shipped if shipped.is_file() and not beside.is_file() else beside)
    except RestorationError as error:
        raise RigError(f"scene.picture: {error}") from None
    if found.ndim == 3 and found.shape[2] in (3, 4):
        grey = found[..., :3] @ np.array(_LUMINANCE)
    else:
        grey = found.astype(np.float64) if found.dtype.kind in "buif" else np.zeros(0)
    if found.dtype.kind in "ui":
        grey = grey / np.iinfo(found.dtype).max
    needed = tuple(n * sensor.picture_pixels for n in sensor.shape)
    if grey.ndim != 2 or grey.shape[0] < needed[0] or grey.shape[1] < needed[1] or not np.isfinite(grey).all():
        raise RigError(
            f"scene.picture: {beside} has shape {found.shape}, expected at least {needed[0]} x {needed[1]} finite"
            " numbers (scene.pixels times scene.picture_pixels), better more: the scene goes on beyond the frame"
        )
    return np.asarray(grey, dtype=np.float64)


def framed(sensor: SceneSensor, picture: FloatArray) -> FloatArray:
    """The middle of a picture in the sensor's pixels, each the mean of its own, (rows, columns)."""
    return framed_columns(sensor, framed_rows(sensor, picture))


def framed_rows(sensor: SceneSensor, picture: FloatArray) -> FloatArray:
    """The same for the rows alone, (rows, the picture's columns)."""
    n, rows = sensor.picture_pixels, sensor.shape[0]
    top = (picture.shape[0] - n * rows) // 2
    return np.asarray(picture[top : top + n * rows].reshape(rows, n, -1).mean(axis=1))


def framed_columns(sensor: SceneSensor, picture: FloatArray) -> FloatArray:
    """And for the columns alone, (the picture's rows, columns)."""
    return framed_rows(replace(sensor, shape=sensor.shape[::-1]), picture.T).T
