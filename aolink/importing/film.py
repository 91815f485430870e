"""A film: frames of any camera, one after the other, and the times that their file has."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ImportingError

FilmFrame = NDArray[np.generic]

_CONVERTERS = (10, 12, 14)
"""Bits of cameras whose pixels are stored in 16, at the lower end or at the upper one."""
_READ_FRAMES = 2000
"""Frames that are read, at most, to find out where a film saturates."""
_LEAST_PIXELS = 3
"""A film saturates at its largest value if that is a converter's last, and so many pixels have it at least, and no
fewer than are within a hundredth below it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """Frames of one size, read when they are needed, and facts about them."""

    name: str
    """The source of the film."""
    shape: tuple[int, int]
    """Rows and columns of a frame."""
    dtype: np.dtype[np.generic]
    """Type of the pixels, as they are stored."""
    count: int
    """Number of frames."""
    frames: Callable[[], Iterator[FilmFrame]]
    """The frames from the first on, (rows, columns) each."""
    rate_hz: float | None = None
    """Frames a second, where the file has it."""
    exposure_s: float | None = None
    """Exposure time of each frame, where the file has it."""
    start_ns: int | None = None
    """Start of the first exposure, ns since 1970, where the file has it."""
    times_ns: NDArray[np.int64] | None = None
    """Start of each exposure, ns from an arbitrary zero, where the file has it, (count,)."""
    inputs: NDArray[np.float64] | None = None
    """Inputs that the mirror held in each fast step, where the file has them, (steps, n_inputs)."""
    input_times_ns: NDArray[np.int64] | None = None
    """The time at which each row of ``inputs`` was put out, to be held until the next; ns from the start of the first
    exposure. None: there is a row for each frame, or for each fast step from the first exposure on."""
    slopes: bool = False
    """Whether there are no pictures, but slopes alone: a frame is then one row of them, x and y of each spot."""
    nonlinear: str = ""
    """The reason why pixel values may not be proportional to light; empty where there is none."""
    notes: tuple[str, ...] = field(default=())
    """Notes for the user about how it was read."""

    @cached_property
    def saturates_at(self) -> float:
        """The value from which on a pixel is saturated; infinite where the values are no integers."""
        if self.dtype.kind not in "iu":
            return math.inf
        full_scale = float(np.iinfo(self.dtype.name).max)
        lasts = {((1 << bits) - 1) << up for bits in _CONVERTERS for up in (0, 16 - bits)}
        if self.dtype.itemsize < 2 or self.slopes:
            return full_scale
        top, at_top, below = -math.inf, 0, 0
        for frame in islice(self.frames(), _READ_FRAMES):
            values = frame.astype(np.float64)
            if (highest := float(values.max())) > top:
                top, at_top, below = highest, 0, 0
            at_top += int(np.count_nonzero(values >= top))
            below += int(np.count_nonzero((values > 0.99 * top) & (values < top)))
        return top if top in lasts and at_top >= max(_LEAST_PIXELS, below) else full_scale

    @property
    def saturation_notes(self) -> tuple[str, ...]:
        """A note for the user where a film saturates below the largest value of its type."""
        if self.dtype.kind not in "iu" or self.saturates_at >= np.iinfo(self.dtype.name).max:
            return ()
        return (
            f"the values end at {self.saturates_at:g}, as those of a camera with fewer bits than the film's"
            f" {8 * self.dtype.itemsize}: pixels that have it are taken as saturated",
        )


def grey(picture: FilmFrame, what: object) -> FilmFrame:
    """A picture (rows, columns) as it is, one with three or four channels as the mean of its colours.

    The mean is proportional to light where the colours are. A pixel saturated in one colour is saturated. Raises
    `ImportingError` where the picture has another shape.
    """
    if picture.ndim == 3 and picture.shape[2] in (3, 4):
        red, green, blue = (picture[..., k] for k in range(3))  # far faster than along the last axis
        mean = np.asarray(np.add(np.add(red, green, dtype=np.float64), blue) / 3)
        if picture.dtype.kind in "iu":
            most = np.iinfo(picture.dtype.name).max
            mean[(red == most) | (green == most) | (blue == most)] = most
        return mean
    if picture.ndim != 2 or picture.dtype.kind not in "biuf":
        raise ImportingError(f"{what} holds {picture.dtype} of shape {picture.shape}, expected a picture")
    return picture


def array_film(frames: NDArray[Any], name: str, **known: Any) -> Film:
    """A film of frames in memory, (frames, rows, columns).

    Colours, (frames, rows, columns, 3 or 4), become grey; films of spots, (spots, frames, rows, columns), stand side by
    side. Raises `ImportingError` where the array has another shape, or does not hold numbers.
    """
    # A spot's window is a square, so one of 3 or 4 columns has no more rows.
    colours = frames.ndim == 4 and frames.shape[3] in (3, 4) and frames.shape[2] > 4
    if frames.ndim == 4 and not colours:  # one film for each spot, all with the same times
        spots, count, rows, columns = frames.shape
        frames = np.moveaxis(frames, 0, 2).reshape(count, rows, spots * columns)
        known["notes"] = (*known.get("notes", ()), f"the films of {spots} spots stand side by side in one picture")
    if frames.ndim != 3 + colours or min(frames.shape) < 1 or frames.dtype.kind not in "biuf":
        raise ImportingError(
            f"{name} holds {frames.dtype} of shape {frames.shape}, expected numbers as (frames, rows, columns)"
        )
    times = known.get("times_ns")
    if times is not None and times.shape != (len(frames),):
        raise ImportingError(f"{name} has {len(frames)} frames and times of shape {times.shape}: give one for each")
    shape = (int(frames.shape[1]), int(frames.shape[2]))
    return Film(
        name=name, shape=shape, dtype=frames.dtype, count=len(frames), **known,
        frames=lambda: (grey(each, name) for each in frames) if colours else iter(frames),
    )  # fmt: skip
