"""A film: pictures of any camera, one after the other, and the times that their file has."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ImportingError

FilmFrame = NDArray[np.generic]

_CONVERTERS = (8, 10, 12, 14)
"""Bits of cameras whose pixels are stored in 16, at the lower end or at the upper one."""
_READ_FRAMES = 2000
"""Frames that are read, at most, to find out where a film saturates."""
_LEAST_PIXELS = 3
"""A film saturates at its largest value if that is a converter's last, and so many pixels have it at least, and no
fewer than are within a hundredth below it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """Pictures of one size, read when they are needed, and facts about them."""

    name: str
    """The source of the film."""
    shape: tuple[int, int]
    """Rows and columns of a picture."""
    dtype: np.dtype[np.generic]
    """Type of the pixels, as they are stored."""
    count: int
    """Number of pictures."""
    pictures: Callable[[], Iterator[FilmFrame]]
    """The pictures from the first on, (rows, columns) or (rows, columns, 2 to 4 channels): more light is a larger
    number; pixels that the file calls undefined are NaN."""
    top: float | None = None
    """The largest value that a pixel can have, where it is not the largest of the type."""
    mosaic: str = ""
    """Colours of the first two pixels of the first two rows under a Bayer mosaic, as RGGB; empty where there is
    none."""
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
    numbers: NDArray[np.int64] | None = None
    """Number of each frame among those that were taken, where some of them are missing, (count,)."""
    played: bool = False
    """Whether the times are those of playing, which need not be those of taking."""
    left_out: int = 0
    """Frames of the file that are none, and not among these."""
    account: str = ""
    """What those are, in words."""
    share: float = 1.0
    """Rate of these frames over that of the file's, where the others are copies that come in turn."""
    slopes: bool = False
    """Whether there are no pictures, but slopes alone: a frame is then one row of them, x and y of each spot."""
    nonlinear: str = ""
    """The reason why pixel values may not be proportional to light; empty where there is none."""
    notes: tuple[str, ...] = field(default=())
    """Notes for the user about how it was read."""
    files: frozenset[str] = frozenset()
    """Names of all files that hold the film, where there are several."""
    white_is_zero: bool = False
    """Whether the file keeps light as a small number."""

    def frames(self) -> Iterator[FilmFrame]:
        """The pictures in grey, (rows, columns) each."""
        return (grey(each, self.name, self.top) for each in self.pictures())

    @property
    def full_scale(self) -> float:
        """The largest value that a pixel can hold; one where values are no integers."""
        if self.top is not None:
            return self.top
        return float(np.iinfo(self.dtype.name).max) if self.dtype.kind in "iu" else 1.0

    @cached_property
    def saturates_at(self) -> float:
        """The value from which on a pixel is saturated; infinite where the values are no integers."""
        if self.dtype.kind not in "iu":
            return math.inf
        if self.dtype.itemsize < 2 or self.slopes or self.top is not None:
            return self.full_scale
        return saturation(islice(self.frames(), _READ_FRAMES), self.full_scale)

    @property
    def saturation_notes(self) -> tuple[str, ...]:
        """A note for the user where a film saturates below the largest value of its type."""
        if self.dtype.kind not in "iu" or self.saturates_at >= self.full_scale:
            return ()
        return (
            f"the values end at {self.saturates_at:g}, as those of a camera with fewer bits than the film's"
            f" {8 * self.dtype.itemsize}: pixels that have it are taken as saturated",
        )


def saturation(frames: Iterable[FilmFrame], full_scale: float, least: int = _LEAST_PIXELS) -> float:
    """The value at which frames of up to 16 bits saturate: the last of a converter of fewer bits if they end at it, in
    ``least`` pixels or more, otherwise the full scale."""
    lasts = {((1 << bits) - 1) << up for bits in _CONVERTERS for up in (0, 16 - bits)}
    top, at_top, below = -math.inf, 0, 0
    for frame in frames:
        values = frame.astype(np.float64)
        if (highest := float(np.nanmax(values, initial=-math.inf))) > top:
            top, at_top, below = highest, 0, 0
        at_top += int(np.count_nonzero(values >= top))
        below += int(np.count_nonzero((values > 0.99 * top) & (values < top)))
    return top if top in lasts and at_top >= max(least, below if least > 1 else 0) else full_scale


def grey(picture: FilmFrame, what: object, top: float | None = None) -> FilmFrame:
    """A picture (rows, columns) as it is, one with three or four channels as the mean of its colours, one with two
    without its second, which is transparency.

    The mean is proportional to light where the colours are. A pixel saturated in one colour is saturated. Raises
    `ImportingError` where the picture has another shape.
    """
    if picture.ndim == 3 and picture.shape[2] in (3, 4):
        most = math.inf if picture.dtype.kind not in "iu" else top or float(np.iinfo(picture.dtype.name).max)
        return _mean([picture[..., k] for k in range(3)], most)  # far faster than along the last axis
    if picture.ndim == 3 and picture.shape[2] in (1, 2):
        picture = picture[..., 0]
    if picture.ndim != 2 or picture.dtype.kind not in "biuf":
        raise ImportingError(f"{what} holds {picture.dtype} of shape {picture.shape}, expected a picture")
    return picture


def _mean(planes: list[NDArray[Any]], most: float) -> FilmFrame:
    """Mean of pixels; of pixels one of which is saturated, ``most``."""
    mean = sum(each.astype(np.float64) for each in planes) / len(planes)
    return np.where(np.any([each >= most for each in planes], axis=0), most, mean)


def array_film(frames: Any, name: str, **known: Any) -> Film:
    """A film of frames in memory or in a file, (frames, rows, columns), or of one picture, (rows, columns).

    Colours have a last axis of 3 or 4; films of spots, (spots, frames, rows, columns), stand side by side. Raises
    `ImportingError` where the array has another shape, or does not hold numbers.
    """
    shape, dtype = tuple(frames.shape), np.dtype(frames.dtype)
    # A spot's window is a square, so one of 3 or 4 columns has no more rows.
    colours = int(len(shape) > 2 and shape[-1] in (3, 4) and shape[-2] > 4)
    if len(shape) == 2 + colours:
        frames, shape = np.asarray(frames)[None], (1, *shape)
    if len(shape) == 4 and not colours:  # one film for each spot, all with the same times
        spots, count, rows, columns = shape
        frames = np.moveaxis(np.asarray(frames), 0, 2).reshape(count, rows, spots * columns)
        shape = frames.shape
        known["notes"] = (*known.get("notes", ()), f"the films of {spots} spots stand side by side in one picture")
    if len(shape) != 3 + colours or min(shape) < 1 or dtype.kind not in "biuf":
        raise ImportingError(f"{name} holds {dtype} of shape {shape}, expected numbers as (frames, rows, columns)")
    return Film(
        name=name, shape=(int(shape[1]), int(shape[2])), dtype=dtype, count=int(shape[0]), **known,
        pictures=lambda: (np.asarray(frames[k]) for k in range(len(frames))),
    )  # fmt: skip


@dataclass(frozen=True)
class Stored:
    """An array that lies in a file as it is. It is read frame by frame and not mapped: a mapped file that somebody
    shortens ends the process."""

    path: Path
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int
    """Its first byte."""

    def __post_init__(self) -> None:
        if self.path.stat().st_size < self.offset + math.prod(self.shape) * self.dtype.itemsize:
            raise ImportingError(f"{self.path} is cut off: it announces numbers of shape {self.shape}")

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, k: int) -> FilmFrame:
        numbers = math.prod(self.shape[1:])
        found = np.fromfile(self.path, self.dtype, numbers, offset=self.offset + k * numbers * self.dtype.itemsize)
        if len(found) < numbers:
            raise ImportingError(f"{self.path} has become shorter while it was read: frame {k} is cut off")
        return found.reshape(self.shape[1:])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        whole = Stored(self.path, self.dtype, (1, *self.shape), self.offset)
        return np.asarray(whole[0], dtype)


def one_colour(film: Film, colour: str) -> Film:
    """The film of one colour, "red", "green" or "blue", of pictures in colour or under a mosaic; "all" makes pictures
    in colour of a mosaic.

    Under a mosaic each two by two pixels become one: the mean of those of the colour. Raises `ImportingError` where the
    pictures have no colours.
    """
    letter, most = colour[0].upper(), film.saturates_at

    def changed(picture: FilmFrame) -> FilmFrame:
        if not film.mosaic:
            if picture.ndim != 3 or picture.shape[2] < 3:
                raise ImportingError(f"{film.name} has no colours: leave --film colour out")
            return picture if colour == "all" else picture[..., "RGB".index(letter)]
        rows, columns = (n // 2 * 2 for n in picture.shape)
        cells = [picture[k // 2 : rows : 2, k % 2 : columns : 2] for k in range(4)]
        planes = [_mean([c for c, of in zip(cells, film.mosaic, strict=True) if of == each], most) for each in "RGB"]
        return np.stack(planes, axis=-1) if colour == "all" else planes["RGB".index(letter)]

    shape = (film.shape[0] // 2, film.shape[1] // 2) if film.mosaic else film.shape
    return replace(film, pictures=lambda: map(changed, film.pictures()), shape=shape, mosaic="")


def other_pixels(film: Film, meant: str) -> Film:
    """The film of whole numbers of as many bits with or without a sign, or with their bytes in the other order."""
    if film.dtype.kind not in "iu":
        raise ImportingError(f"{film.name} has pixels of {film.dtype}, no whole numbers: leave --film pixels out")
    kind = {"signed": "i", "unsigned": "u", "swapped": film.dtype.kind}[meant]
    dtype = np.dtype(f"{kind}{film.dtype.itemsize}")

    def changed(picture: FilmFrame) -> FilmFrame:
        same = picture.byteswap() if meant == "swapped" else picture
        return same.astype(same.dtype.newbyteorder("=")).view(dtype)

    return replace(film, pictures=lambda: map(changed, film.pictures()), dtype=dtype, top=None)
