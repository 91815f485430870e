"""Sensors as dataclasses: pixels, image kernel, counts and noise.

Quantities are in the rig's own slope unit: that of ``sensor.field``, of the plant's output and of the
kernel's width. A density is light over length for a line sensor, and over area on a plane.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
import scipy

from aolink.errors import RigError
from aolink.keys import Count, NotNegative, Positive, Within, array, checked, pair, read
from aolink.numerics.arrays import BoolArray, FloatArray, Indices
from aolink.optics.texture import Texture

KERNEL_WIDTHS = {"sigma": 1.0, "sd": math.sqrt(2.0), "fwhm": 1 / (2 * math.sqrt(math.log(2.0)))}
"""How a kernel's width may be given, and the paper's sigma for one of it."""


@dataclass(frozen=True, kw_only=True)
class Kernel:
    """Image kernel Psi of unit mass: the spot that a resting beam makes."""

    shape: Literal["gaussian"]
    sigma: float
    """Width, slope units, in the paper's convention: Psi = exp(-w^2/sigma^2) / (sigma sqrt(pi)), variance sigma^2/2.

    For a kernel that is not round, the width of the round one whose variance is the mean of both directions.
    """
    matrix: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Sigma of Psi = exp(-w' Sigma^-2 w) / (pi |Sigma|), Mishra & Wen (4), symmetric; None where it is round."""

    @property
    def variance(self) -> float:
        """Variance of the kernel in one direction, slope units squared."""
        return self.sigma**2 / 2

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the kernel on a plane, Sigma^2/2, slope units squared, (2, 2)."""
        width = self.sigma * np.eye(2) if self.matrix is None else np.array(self.matrix)
        return np.asarray(width @ width / 2)


PIXEL = Kernel(shape="gaussian", sigma=math.sqrt(2 / 12))
"""The blur of a square pixel of side one, as wide as a Gaussian can have it."""


def row_starts_s(row_time_s: float | None, rows: int) -> FloatArray:
    """When the exposure of each row starts, after that of the row that starts first, s, (rows,); all at once where the
    row time is not known."""
    starts = (row_time_s or 0.0) * np.arange(rows)
    return np.asarray(starts - starts.min())


@dataclass(frozen=True, kw_only=True)
class _Width:
    shape: Literal["gaussian"]
    sigma: Any = None
    """As `Kernel.sigma`, or as `Kernel.matrix`."""
    sd: Positive | None = None
    """Standard deviation, slope units, in place of ``sigma``."""
    fwhm: Positive | None = None
    """Full width at half maximum, slope units, in place of ``sigma``."""


def read_kernel(values: Any, key: str) -> Kernel:
    """Read a table ``kernel``. Raises `RigError`."""
    shape = read(_Width, values, key).shape
    given = [name for name in KERNEL_WIDTHS if name in values]
    if len(given) != 1:
        both = f"{key}.{given[0]} and {key}.{given[1]} both say how wide the kernel is" if given else ""
        raise RigError(f"{both or f'{key}.sigma is missing'}: give one of {', '.join(KERNEL_WIDTHS)}")
    (name,) = given
    if not isinstance(values[name], list):
        return Kernel(shape=shape, sigma=KERNEL_WIDTHS[name] * checked(Positive, values[name], f"{key}.{name}"))
    width = array(values[name], f"{key}.{name}", ("x, y", "x, y"), {"x, y": 2})
    if width[0, 1] != width[1, 0] or float(np.linalg.eigvalsh(width).min()) <= 0:
        raise RigError(f"{key}.sigma = {width.tolist()} must be symmetric and positive definite")
    (xx, xy), (_, yy) = width.tolist()
    mean = math.sqrt((xx * xx + yy * yy) / 2 + xy * xy)  # of Sigma^2's diagonal
    return Kernel(shape=shape, sigma=mean, matrix=((xx, xy), (xy, yy)))


def _places(value: Any, key: str) -> tuple[tuple[int, int], ...]:
    return tuple(sorted({*checked(tuple[tuple[Count, Count], ...], value, key)}))


BitDepth = Annotated[int, Within(1, 16)]
Windows = Annotated[int, Within(1, 256)]
Side = Annotated[int, Within(2, 256)]


@dataclass(frozen=True, kw_only=True)
class BaseSensor(ABC):
    """The common part of all sensors: equal pixels, each spot seen on ``field``, an integer read-out.

    Whoever uses a sensor asks it for what differs, not for its class: the rig's outputs are ``directions`` slopes of
    each spot, spot after spot.
    """

    directions = 1
    """Directions in which a spot is seen: along a line, or in x and y."""
    grid = (1, 1)
    """Rows and columns of windows."""
    field: Annotated[tuple[float, float], pair]
    """Outer edges of the first and the last pixel that see a spot, slope units; the same in both directions."""
    noise_density: NotNegative
    """V: a pixel of size D that holds the mean density has noise variance V/D (Mishra & Wen, section V). In its place
    ``read_noise_counts`` or, beside ``photoelectrons``, ``read_noise_electrons``: a pixel's standard deviation."""
    kernel: Annotated[Kernel, read_kernel]
    bit_depth: BitDepth = 16
    black_level: NotNegative = 0.0
    """Counts of a pixel that sees nothing."""
    counts_per_density: Positive
    """Counts for a density of one."""
    photoelectrons: NotNegative = 0.0
    """Photo-electrons of a whole spot in one exposure; 0 means that shot noise is negligible."""
    defects: Annotated[tuple[tuple[int, int], ...], _places] = ()
    """Row and column of each pixel that is hot, dead or otherwise wrong."""
    pedestal: Literal["known", "free"] = "known"
    """Whether ``black_level`` is what a pixel in the dark gives, or that is found in each window of each frame."""
    row_time_s: Annotated[float, Within(-1.0, 1.0)] | None = None
    """Time from the start of one row's exposure to that of the next row down, s; negative where the lowest row is the
    first; 0 for a global shutter; None where the rig file does not say."""

    @cached_property
    def row_starts_s(self) -> FloatArray:
        """When each row's exposure starts, after that of the row that starts first, s, (rows,)."""
        return row_starts_s(self.row_time_s, self.shape[0])

    @cached_property
    def spot_starts_s(self) -> FloatArray:
        """The same for the middle row of each spot's window, s, (spots,)."""
        rows = (self.window_of(spot)[0] for spot in range(self.spots))
        return np.array([self.row_starts_s[each].mean() for each in rows])

    @cached_property
    def defect_mask(self) -> BoolArray | None:
        """True where a pixel is defective, (rows, columns); None where none is."""
        if not self.defects:
            return None
        mask = np.zeros(self.shape, dtype=np.bool_)
        mask[tuple(np.array(self.defects).T)] = True
        return mask

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""

    @property
    @abstractmethod
    def pixel_width(self) -> float:
        """Side of a pixel, slope units."""

    @property
    @abstractmethod
    def pixel_size(self) -> float:
        """D: a pixel's length (slope units) on a line sensor, its area on a plane."""

    @property
    @abstractmethod
    def profile(self) -> Sensor:
        """The line sensor that sees one slope of one spot as this one does, all light of the other direction summed."""

    @property
    @abstractmethod
    def peak_density(self) -> float:
        """Density of a pixel at whose middle a spot rests, one over ``pixel_size``."""

    @property
    def lit(self) -> Indices:
        """Windows that have a spot, counted along the rows of the grid, (spots,)."""
        return np.arange(self.grid[0] * self.grid[1])

    @property
    def spots(self) -> int:
        """Number of spots."""
        return len(self.lit)

    @property
    def spot_light(self) -> FloatArray | None:
        """Share of each spot's lenslet that is lit, (spots,); None where all is."""
        return None

    def light_of(self, output: int) -> float:
        """Share of its light that the spot of an output gets."""
        return 1.0 if self.spot_light is None else float(self.spot_light[output // self.directions])

    def window_of(self, spot: int) -> tuple[slice, slice]:
        """Where a spot's window is in a frame."""
        height, width = (pixels // windows for pixels, windows in zip(self.shape, self.grid, strict=True))
        row, column = divmod(int(self.lit[spot]), self.grid[1])
        return np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return (1 << self.bit_depth) - 1


@dataclass(frozen=True, kw_only=True)
class Sensor(BaseSensor):
    """A line sensor: one spot on a row of pixels."""

    kind: Literal["line"]
    pixels: Annotated[int, Within(2, 65_536)]

    @property
    def shape(self) -> tuple[int, int]:
        return (1, self.pixels)

    @property
    def pixel_width(self) -> float:
        return (self.field[1] - self.field[0]) / self.pixels

    @property
    def pixel_size(self) -> float:
        return self.pixel_width

    @property
    def profile(self) -> Sensor:
        return self

    @property
    def peak_density(self) -> float:
        return math.erf(self.pixel_width / 2 / self.kernel.sigma) / self.pixel_width

    @property
    def edges(self) -> FloatArray:
        """Pixel edges, slope units, (pixels + 1,)."""
        return np.linspace(self.field[0], self.field[1], self.pixels + 1)

    @property
    def centres(self) -> FloatArray:
        """Pixel centres, slope units, (pixels,)."""
        edges = self.edges
        return (edges[:-1] + edges[1:]) / 2


@dataclass(frozen=True, kw_only=True)
class SpotSensor(BaseSensor):
    """A camera behind lenslets: a grid of windows, a spot in each, seen in two directions.

    The rig's outputs are spot 0's slope along x (columns), spot 0's along y (rows), spot 1's along x, ...;
    spots are counted along the rows of the grid, windows in the dark left out. A density of one is that of a wholly lit
    lenslet's spot: the window of a lenslet that is lit in part has that share of it.
    """

    kind: Literal["spots"]
    directions = 2
    grid: tuple[Windows, Windows] = field()  # one that has to be given, unlike a line's
    window: tuple[Side, Side]
    """Rows and columns of pixels in a window; a square."""
    light: tuple[float, ...] | None = None
    """Share of each window's lenslet that is lit, along the rows of the grid; 0 without a spot; None where all are
    fully lit."""

    @cached_property
    def lit(self) -> Indices:
        return super().lit if self.light is None else np.flatnonzero(self.light)

    @cached_property
    def spot_light(self) -> FloatArray | None:
        return None if self.light is None else np.array(self.light)[self.lit]

    @property
    def shape(self) -> tuple[int, int]:
        return (self.grid[0] * self.window[0], self.grid[1] * self.window[1])

    @property
    def pixel_width(self) -> float:
        return (self.field[1] - self.field[0]) / self.window[1]

    @property
    def pixel_size(self) -> float:
        return self.pixel_width**2

    @cached_property
    def profile(self) -> Sensor:
        """The line sensor whose counts are the sums of a window's counts over its rows, or over its columns.

        A density summed over the other direction's length L has noise density V L. Every pixel is rounded, not only
        the sum: V includes the variance of the other roundings.
        """
        side, across = self.pixel_width, self.window[0]
        roundings = (across - 1) * side**3 / (12 * self.counts_per_density**2)
        return Sensor(
            kind="line", pixels=self.window[1], field=self.field, kernel=self.kernel,
            noise_density=self.noise_density * (self.field[1] - self.field[0]) + roundings,
            bit_depth=self.bit_depth + (across - 1).bit_length(), black_level=across * self.black_level,
            counts_per_density=self.counts_per_density / side, photoelectrons=self.photoelectrons,
        )  # fmt: skip

    @property
    def peak_density(self) -> float:
        half = self.pixel_width / 2
        if self.kernel.matrix is None:
            return (math.erf(half / self.kernel.sigma) / self.pixel_width) ** 2
        # The density is right to second order in a pixel's width over the kernel's.
        covariance = self.kernel.covariance + np.eye(2) * half**2 / 3
        return 1 / (2 * math.pi * math.sqrt(float(np.linalg.det(covariance))))


@dataclass(frozen=True, kw_only=True)
class RegionSensor(SpotSensor):
    """A square part of a camera's picture, whatever it shows, that one plant moves along x and y; the slope unit is a
    pixel."""

    kind: Literal["region"]  # type: ignore[assignment]
    reference: tuple[tuple[NotNegative, ...], ...]
    """Counts of the part at rest, row by row; its outer 4 pixels only show what may move in."""
    blur: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How much the reference is blurred itself: covariance of its path, xx, xy and yy, pixels squared."""
    counts_per_density: Positive
    """Counts of an intensity of one."""
    kernel: Annotated[Kernel, read_kernel] = PIXEL
    """Blur of the camera in restored pictures: without a table that of a square pixel."""

    @cached_property
    def at_rest(self) -> FloatArray:
        """Densities of the reference, (rows, columns)."""
        return (np.array(self.reference) - self.black_level) / self.counts_per_density

    @cached_property
    def texture(self) -> Texture:
        """What moves."""
        return Texture(self.at_rest)

    def moved(self, path: FloatArray) -> FloatArray:
        """Mean density in each pixel while the region moves along a path, x and y, (2, n_steps): (rows, columns)."""
        spline = scipy.ndimage.spline_filter(self.at_rest)
        frames = (scipy.ndimage.shift(spline, at[::-1], mode="nearest", prefilter=False) for at in path.T)
        return np.asarray(sum(frames) / path.shape[1])
