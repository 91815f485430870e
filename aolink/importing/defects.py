"""Pixels of a film's camera that are hot or dead: through the whole film they are far from all light about them."""

from __future__ import annotations

import math
from itertools import islice
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from aolink.errors import FrameError
from aolink.films.film import Film
from aolink.importing.frames import FilmLight
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.numerics.rms import rms
from aolink.optics.kernel import pixel_masses
from aolink.optics.maxima import flatten, mended, spread

_SAMPLES, FEWEST = 49, 9
"""Number of frames of whose pixels the median is taken, and the least."""
_MOST_NUMBERS = 20_000_000
"""Numbers that are held for this, at most."""
_SIGNIFICANCE = 8.0
"""Standard deviations of the median picture's noise by which a hot or dead pixel exceeds what light explains."""
_SHARPEST = 0.6
"""Width of the sharpest light that is no defect, in that of the objects."""
_NEARLY = 0.9
"""Share of the frames in which such a pixel differs from its neighbours at least."""
_STEPS = 2.0
"""Steps of the camera's numbers by which such a pixel differs at least."""
_LISTED = 20
"""The most pixels that a note lists for a rig file."""
_SHOWN = 3
"""Hot and dead pixels of which a note has the places."""


def find_defects(film: Film, light: FilmLight, sd: float) -> BoolArray:
    """Which pixels are hot or dead, (rows, columns), in a film of objects of standard deviation ``sd``, pixels.

    In the median of frames from the whole film such a pixel is brighter than its second or its third brightest
    neighbour (or darker than its second or third darkest one) by a larger factor than light about as sharp as the
    objects can be. So neither objects that stay in their place nor the border of one are taken for defects, and up to
    three defects beside each other are found. A film of fewer than nine frames has none.
    """
    count = min(_SAMPLES, film.count, max(FEWEST, _MOST_NUMBERS // math.prod(film.shape)))
    if count < FEWEST:
        return np.zeros(film.shape, dtype=np.bool_)
    chosen = np.unique(np.linspace(0, film.count - 1, count).round().astype(np.int64)).tolist()
    wanted = set(chosen)
    frames = islice(film.frames(), chosen[-1] + 1)
    shown = np.array([light.of(frame)[0].astype(np.float32) for k, frame in enumerate(frames) if k in wanted])
    median = np.median(shown, axis=0).astype(np.float64)
    try:
        _, ground = flatten(median)
    except FrameError:  # too small, or the same everywhere
        return np.zeros(film.shape, dtype=np.bool_)
    flat = median - ground
    least = max(_SIGNIFICANCE * _noise(flat), _STEPS * light.step)
    second, third = (_peak_over_neighbour(_SHARPEST * sd, number) for number in (2, 3))
    (bright, holes), (dark, bumps) = (_stands_out(sign * flat, (second, third), least) for sign in (1.0, -1.0))
    found = bright | bumps | dark | holes
    if found.any():
        found[found] = _always(shown, ground[found], found, np.where(bright | bumps, 1.0, -1.0)[found], second)
    return found


def defects_note(defects: BoolArray, *, of_rig: bool = False) -> str:
    """A note for the user on hot and dead pixels, (rows, columns); ``of_rig``: of a frame as the rig file has it."""
    rows, columns = np.nonzero(defects)
    some = ", ".join(f"{x},{y}" for x, y in zip(columns[:_SHOWN], rows[:_SHOWN], strict=True))
    key = [list(map(int, each)) for each in zip(rows, columns, strict=True)]
    more = f"; with another film of this camera: sensor.defects = {key}" if of_rig and len(key) <= _LISTED else ""
    what = "hot or dead pixel is" if len(rows) == 1 else "hot or dead pixels are"
    return f"{len(rows)} {what} left out, at {some}{' and others' if len(rows) > _SHOWN else ''}{more}"


def _noise(flat: FloatArray) -> float:
    """Standard deviation of the differences to the median of the neighbours, without the largest tenth of them.

    Numbers of few bits need the mean as well: their median is often zero.
    """
    rest = flat - ndimage.median_filter(flat, 3)
    size = np.abs(rest)
    return max(spread(rest), rms(np.minimum(size, np.quantile(size, 0.9))))


def _always(
    shown: NDArray[np.float32], ground: FloatArray, candidates: BoolArray, sign: FloatArray, factor: float
) -> BoolArray:
    """Which candidates differ in nearly all frames, (frames, rows, columns), from what the pixels about them explain,
    (candidates,).

    ``ground`` is the background there, ``sign`` is 1 where they are brighter and -1 where they are darker.

    The median over time of an object that moves may have steps from pixel to pixel that no frame has.
    """
    # What the interpolation leaves of a Gaussian's middle pixel, for one unit of what it gives there.
    left = (1 - 1 / factor) ** 2
    around = np.array([mended(frame.astype(np.float64), candidates)[candidates] for frame in shown])
    differs = sign * (shown[:, candidates] - around) > left / (1 - left) * np.abs(around - ground)
    return np.asarray(differs.mean(axis=0) >= _NEARLY)


def _stands_out(flat: FloatArray, factors: tuple[float, float], least: float) -> tuple[BoolArray, BoolArray]:
    """Where a pixel is too bright for its neighbours, and where it is a hole in light, (rows, columns) each.

    ``factors`` are those for the second and for the third neighbour, which light at the picture's edge may exceed.
    """
    ring = np.ones((3, 3), dtype=np.bool_)
    ring[1, 1] = False
    peak, hole = (np.zeros(flat.shape, dtype=np.bool_) for _ in range(2))
    ends: tuple[tuple[float, Literal["mirror", "constant"]], ...] = ((factors[0], "mirror"), (factors[1], "constant"))
    for number, (factor, mode) in enumerate(ends, 2):
        brighter = ndimage.rank_filter(flat, -number, footprint=ring, mode=mode, cval=np.inf)
        darker = ndimage.rank_filter(flat, number - 1, footprint=ring, mode=mode, cval=-np.inf)
        peak |= flat > factor * np.maximum(brighter, 0.0) + least
        hole |= darker > factor * np.maximum(flat, 0.0) + least
    return peak, hole


def _peak_over_neighbour(sd: float, number: int) -> float:
    """Light of a Gaussian's brightest pixel over that of the ``number``-th brightest beside it, at most."""
    at = np.linspace(0.0, 0.5, 11)  # of the middle, in the pixel
    masses = pixel_masses(sd**2, np.arange(-1.5, 2.0), at, 0)[0]
    pixels = (masses[:, None, :, None] * masses[None, :, None, :]).reshape(-1, 9)
    beside = np.sort(np.delete(pixels, 4, axis=1), axis=1)[:, -number]
    return float((pixels[:, 4] / np.maximum(beside, 1e-9)).max())
