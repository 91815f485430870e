"""Code that drivers of cameras share: the sensor's part of a picture, and pictures that become counts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import DeviceError, RigError
from aolink.rig import Timing


def checked_corner(corner: Sequence[int] | None) -> tuple[int, int] | None:
    """The key ``corner`` of a rig file as row and column. Raises RigError."""
    if corner is not None and (len(corner) != 2 or min(corner) < 0):
        raise RigError(f"devices.camera.corner is {corner!r}, expected the row and the column of a pixel: [0, 0]")
    return None if corner is None else (corner[0], corner[1])


def check_within(size: tuple[int, int], shape: tuple[int, int], corner: tuple[int, int] | None, name: str) -> None:
    """Compare a picture's rows and columns with the sensor's, which begins at ``corner`` or, if None, is all of it.

    Raises
    ------
    DeviceError
        The sensor is not within the picture.
    """
    row, column = corner or (0, 0)
    if row + shape[0] > size[0] or column + shape[1] > size[1] or (corner is None and size != shape):
        raise DeviceError(
            f"{name} gives {size} pixels, the rig file's sensor has {shape} (rows, columns): correct [sensor], or say"
            " with devices.camera.corner = [row, column] where in the picture the sensor begins"
        )


def check_timing(timing: Timing, name: str, exposure_ns: int, rate_hz: float = 0.0, margin: float = 0.01) -> None:
    """Compare a camera's exposure time, and its frame rate where that is known, with the rig file's.

    Raises
    ------
    DeviceError
        They differ by more than half a fast step, or the part ``margin`` of the rate.
    """
    wrong = ""
    if abs(exposure_ns - timing.exposure_ns) > timing.fast_step_ns / 2:
        wrong = f"exposes for {exposure_ns / 1e9:g} s, the rig file says {timing.exposure_ns / 1e9:g} s: correct"
        wrong += " timing.exposure_steps"
    elif rate_hz > 0 and abs(rate_hz * timing.frame_period_ns / 1e9 - 1) > margin:
        wrong = f"takes {rate_hz:.5g} frames a second, the rig file says {1e9 / timing.frame_period_ns:.5g}: correct"
        wrong += " timing.frame_period_steps"
    if wrong:
        raise DeviceError(f"{name} {wrong} or the camera's settings")


def sensor_part(
    picture: NDArray[Any], shape: tuple[int, int], corner: tuple[int, int] | None, name: str
) -> NDArray[Any]:
    """The part of a picture, (rows, columns) or (rows, columns, colours), that is the sensor.

    Parameters and errors are those of `check_within`.
    """
    check_within((picture.shape[0], picture.shape[1]), shape, corner, name)
    row, column = corner or (0, 0)
    return picture[row : row + shape[0], column : column + shape[1]]


def as_counts(part: NDArray[Any], name: str) -> NDArray[np.uint16]:
    """Grey values rounded to counts. Raises DeviceError for those that no pixel of 16 bits can have."""
    counts = np.rint(part) if part.dtype.kind == "f" else part
    if not (counts.min() >= 0 and counts.max() <= 0xFFFF):  # so that NaN is refused as well
        raise DeviceError(f"{name} gives values from {part.min()} to {part.max()}, expected counts from 0 to 65535")
    return counts.astype(np.uint16)
