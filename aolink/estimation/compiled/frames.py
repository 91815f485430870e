"""What is measured of whole frames of spots, in one pass (rows `frame_moments_and_o3`, `reestimation_rate`).

The twins are `aolink.estimation.frames.spots.profiles` and `aolink.estimation.frames.moments.spot_significance`, which
need no Numba: who only looks at a recording does not load it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aolink.estimation.compiled.small import compiled
from aolink.numerics.arrays import FloatArray, IntArray

_ABREAST = 64


@compiled
def window_sums(frames: NDArray[np.uint16], side: int, sums: FloatArray, ends: IntArray) -> None:
    """Sums of each window over its rows and over its columns, and the ends of each frame's scale that were met.

    Frames are (frames, rows * side, columns * side). ``sums``, (side, frames, rows, columns, 2), is filled, over rows
    first; ``ends`` with the least and the largest count of each frame, (frames, 2).
    """
    width = frames.shape[2]
    columns = width // side
    above = np.empty(width, dtype=np.uint32)
    for f in range(len(frames)):
        least, largest = np.uint16(65535), np.uint16(0)
        for row in range(frames.shape[1] // side):
            above[:] = 0
            for y in range(side):
                line = frames[f, row * side + y]
                for x in range(width):
                    above[x] += line[x]
                for x in range(width):
                    least = line[x] if line[x] < least else least
                    largest = line[x] if line[x] > largest else largest
                for column in range(columns):
                    window = line[column * side : (column + 1) * side]
                    total = np.uint32(0)
                    for x in range(side):
                        total += window[x]
                    sums[y, f, row, column, 1] = total
            for column in range(columns):
                for x in range(side):
                    sums[x, f, row, column, 0] = above[column * side + x]
        ends[f, 0], ends[f, 1] = least, largest


@compiled
def brightest_stretches(density: FloatArray, found: FloatArray) -> None:
    """The largest sum over each of some lengths of pixels, over the root of the length, of a profile in each column,
    (pixels, n): ``found``, (n,)."""
    pixels, n = density.shape
    light, best = np.zeros((pixels + 1, _ABREAST)), np.empty(_ABREAST)
    for first in range(0, n, _ABREAST):
        count = min(_ABREAST, n - first)
        for i in range(pixels):
            for k in range(count):
                light[i + 1, k] = light[i, k] + density[i, first + k]
        length = 1
        while length <= pixels:
            root = math.sqrt(length)
            best[:] = -math.inf
            for i in range(pixels + 1 - length):
                low, high = light[i], light[i + length]
                for k in range(_ABREAST):
                    gained = high[k] - low[k]
                    best[k] = gained if gained > best[k] else best[k]
            for k in range(count):
                share = best[k] / root
                found[first + k] = share if length == 1 else max(found[first + k], share)
            length *= 2
