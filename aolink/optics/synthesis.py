"""Synthesis of a camera's frames, pixel by pixel, with any kernel along any path, and with the faults of real
detectors.

`aolink.optics.frame` makes the frames of rigs, whose kernel is a Gaussian; this module has other kernels, to test
estimators with light that their models do not describe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.special import sici

from aolink.errors import FrameError
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray

# Spots computed together: their masses stay in the processor's cache.
_AT_ONCE = 16
# Rows of the table of diffraction's masses from the middle to the first zero: linear interpolation is wrong by 1e-6.
_POINTS = 512
# Most numbers in a table; for wider windows it would take too much memory.
_LARGEST_TABLE = 4_000_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Psi:
    """A kernel of unit mass. Widths are in pixels."""

    shape: Literal["delta", "sinc2", "image"]
    zero_px: float = 0.0
    """For kind ``sinc2``, diffraction at a square lenslet: distance from the middle to the first zero, wavelength over
    pitch."""
    image: FloatArray | None = None
    """For kind ``image``: the spot on a grid of ``finer`` points a pixel; odd sides, the middle point is its origin."""
    finer: int = 1

    def __post_init__(self) -> None:
        if self.shape == "sinc2" and self.zero_px <= 0:
            raise FrameError(f"a diffraction kernel needs zero_px above 0, found {self.zero_px:g}")
        if self.shape == "image":
            good = self.image is not None and self.image.ndim == 2 and not any(n % 2 == 0 for n in self.image.shape)
            if not good or self.image is None or not self.image.sum() > 0 or self.finer < 1:
                raise FrameError("a kernel's image needs two odd sides, light in it, and finer >= 1")


def light_in_windows(psi: Psi, side: int, path_px: FloatArray) -> FloatArray:
    """Share of each spot's light in the pixels of its window, averaged over its path, (spots, side, side).

    A spot that is wholly in its window sums to one. ``path_px`` is x and y at each fast step, pixels, 0 at the middle
    of the first pixel, (spots, 2, n_steps).
    """
    if psi.shape == "image":
        return _image_windows(psi, side, path_px)
    light = np.empty((len(path_px), side, side))
    for k in range(0, len(path_px), _AT_ONCE):
        some = slice(k, k + _AT_ONCE)
        if psi.shape == "delta":  # one in the pixel where the spot is
            masses = np.asarray(np.floor(path_px[some] + 0.5)[..., None] == np.arange(side), dtype=np.float64)
        else:
            masses = _sinc2_masses(psi, side, path_px[some])
        # Both kernels are products of their two directions: the sum over the steps is a matrix product.
        np.matmul(masses[:, 1].swapaxes(1, 2), masses[:, 0], out=light[some])
    light /= path_px.shape[-1]
    return light


def _sinc2_masses(psi: Psi, side: int, positions: FloatArray) -> FloatArray:
    """Mass of one direction in each pixel, (..., n_steps, side), interpolated linearly in a table."""
    if _table_rows(psi.zero_px, side) * side > _LARGEST_TABLE:
        away = np.arange(side + 1) - 0.5 - positions[..., None]
        return np.asarray(np.diff(_sinc2_below(away / psi.zero_px), axis=-1))
    table = _sinc2_table(psi.zero_px, side)
    place = np.clip((positions + side) * (_POINTS / psi.zero_px), 0, len(table) - 2)
    row = place.astype(np.intp)
    low, high = table.take(row, axis=0), table.take(row + 1, axis=0)
    high -= low
    high *= (place - row)[..., None]
    low += high
    return np.asarray(low)


def _table_rows(zero_px: float, side: int) -> int:
    return math.ceil(3 * side / zero_px * _POINTS) + 2


@lru_cache(maxsize=8)
def _sinc2_table(zero_px: float, side: int) -> FloatArray:
    """Masses of the pixels for spots from a window before the first one to a window behind the last, (rows, side)."""
    positions = np.arange(_table_rows(zero_px, side)) * (zero_px / _POINTS) - side
    edges = np.arange(side + 1) - 0.5
    return np.asarray(np.diff(_sinc2_below((edges - positions[:, None]) / zero_px), axis=-1))


def _sinc2_below(x: FloatArray) -> FloatArray:
    """Integral of sinc^2 from minus infinity to x: 1/2 + (Si(2 pi x) - sin^2(pi x)/(pi x)) / pi."""
    a = math.pi * x
    safe = np.where(np.abs(a) < 1e-9, 1.0, a)
    return np.asarray(0.5 + (sici(2 * a)[0] - np.where(np.abs(a) < 1e-9, a, np.sin(safe) ** 2 / safe)) / math.pi)


def _image_windows(psi: Psi, side: int, path_px: FloatArray) -> FloatArray:
    """Windows of spots by `_image_of_some`, for groups of spots whose paths are about as long."""
    light = np.empty((len(path_px), side, side))
    order = np.argsort(np.ptp(path_px, axis=2).max(axis=1))
    spectrum = lru_cache(partial(_image_spectrum, psi))  # groups next to each other have squares of one size
    for k in range(0, len(order), _AT_ONCE):
        some = order[k : k + _AT_ONCE]
        light[some] = _image_of_some(psi, side, path_px[some], spectrum)
    return light


def _image_of_some(
    psi: Psi, side: int, path_px: FloatArray, image_spectrum: Callable[[int], NDArray[np.complex128]]
) -> FloatArray:
    """Convolve the image with the path's histogram on the fine grid, by their spectra.

    The light of a step is divided among the four nearest fine points by its distances, so that its mean is exact. Spots
    have squares just large enough for their paths; the squares' spectra, folded, are those of sums over pixels.
    """
    assert psi.image is not None
    fine, reach = psi.finer, max(psi.image.shape) // 2 + 1
    spots, _, steps = path_px.shape
    place = (path_px + 0.5) * fine - 0.5
    low = np.floor(place)
    part = place - low
    # Beyond, no light reaches the window.
    near = ((low >= -reach - 1) & (low <= side * fine + reach)).all(axis=1)
    # Corners and side of the spots' squares, in pixels.
    some = near.any(axis=1)[:, None, None]
    least = np.where(some, np.where(near[:, None], low, np.inf).min(axis=2, keepdims=True), 0.0)
    most = np.where(some, np.where(near[:, None], low, -np.inf).max(axis=2, keepdims=True), 0.0)
    corner = np.floor((least - reach) / fine)
    pixels = fft.next_fast_len(int(((most + 2 + reach) // fine + 1 - corner).max()), real=True)
    size = pixels * fine
    x, y = (np.where(near[:, None], low - corner * fine, 0.0)).astype(np.int64).swapaxes(0, 1)
    first = (np.arange(spots)[:, None] * size + y) * size + x
    (right, down), steady = part.swapaxes(0, 1), near / steps
    upper, lower = (1 - down) * steady, down * steady
    places = np.stack([first, first + 1, first + size, first + size + 1])
    weights = np.stack([upper * (1 - right), upper * right, lower * (1 - right), lower * right])
    trace = np.bincount(places.ravel(), weights.ravel(), spots * size**2).reshape(spots, size, size)
    spectrum = fft.rfft2(trace)
    spectrum *= image_spectrum(size)
    # Every fine-th row has the spectrum of all rows, with frequencies folded together as an aliased sum.
    folded = spectrum.reshape(spots, fine, pixels, -1).sum(axis=1) / fine
    light = fft.irfft2(folded, (pixels, size)).reshape(spots, pixels, pixels, fine).sum(axis=3)
    return _cut(light, corner[..., 0].astype(np.int64), side)


def _image_spectrum(psi: Psi, size: int) -> NDArray[np.complex128]:
    """Spectrum of the image on a square of fine points, with each row the sum over a pixel's rows from it on."""
    assert psi.image is not None
    rows, columns = psi.image.shape
    kernel = np.zeros((size, size))
    kernel[:rows, :columns] = psi.image / psi.image.sum()
    kernel = np.roll(kernel, (-(rows // 2), -(columns // 2)), (0, 1))
    over_pixel = np.sum([np.roll(kernel, -k, axis=0) for k in range(psi.finer)], axis=0)
    return np.asarray(fft.rfft2(over_pixel))


def _cut(light: FloatArray, corner: IntArray, side: int) -> FloatArray:
    """Windows from squares (spots, pixels, pixels) whose corners (spots, 2), x and y, lie there in the windows."""
    pixels = light.shape[1]
    at = np.arange(side) - corner[..., None]
    inside, at = (at >= 0) & (at < pixels), np.clip(at, 0, pixels - 1)
    window = light[np.arange(len(light))[:, None, None], at[:, 1, :, None], at[:, 0, None, :]]
    return np.asarray(np.where(inside[:, 1, :, None] & inside[:, 0, None, :], window, 0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Detector:
    """An integer camera and its faults. Light is in photo-electrons; values of single pixels are (rows, columns)."""

    bits: int = 16
    """Bits of a count, 8 to 16."""
    electrons_per_count: float = 1.0
    offset_counts: float = 0.0
    read_noise_electrons: float = 0.0
    background_electrons: FloatArray | float = 0.0
    """Background light in every pixel, photo-electrons; it has shot noise."""
    dark_electrons: FloatArray | float = 0.0
    """Dark current of a pixel in one exposure, photo-electrons; it has shot noise."""
    flat: FloatArray | float = 1.0
    """Sensitivity of the pixels (flat field)."""
    dead: BoolArray | None = None
    """Pixels that always read the offset, (rows, columns)."""

    def __post_init__(self) -> None:
        if not 8 <= self.bits <= 16 or self.electrons_per_count <= 0:
            raise FrameError(f"a detector has 8 to 16 bits and electrons_per_count above 0, found {self.bits} bits")

    def expose(self, light_electrons: FloatArray, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Counts for the mean light of an exposure, (..., rows, columns)."""
        mean = (light_electrons + self.background_electrons) * self.flat + self.dark_electrons
        electrons = rng.poisson(np.maximum(mean, 0.0)) + self.read_noise_electrons * rng.standard_normal(mean.shape)
        if self.dead is not None:
            electrons = np.where(self.dead, 0.0, electrons)
        counts = np.rint(self.offset_counts + electrons / self.electrons_per_count)
        return np.clip(counts, 0, (1 << self.bits) - 1).astype(np.uint16)
