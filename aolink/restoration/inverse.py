"""The exact inverse of the blur (Shahin, III), for pictures without noise."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import linalg

from aolink.errors import RestorationError
from aolink.numerics.arrays import FloatArray
from aolink.restoration.psf import line_matrix

Direction = Literal["forward", "backward"]

# Zeros may lie on the unit circle, as those of a uniform PSF do: an error then keeps its size.
_ON_CIRCLE = 1e-6


def largest_zero(values: FloatArray) -> float:
    """Largest magnitude of the zeros of c_0 z^m + .. + c_m; where each pixel has its own PSF, the largest over all
    pixels.

    An error of the initial state is multiplied by it from pixel to pixel: below one, the inverse is stable.
    """
    largest = 0.0
    for taps in np.unique(values.reshape(-1, values.shape[-1]), axis=0):
        kept = np.trim_zeros(taps)
        if len(kept) > 1:
            largest = max(largest, float(np.abs(np.roots(kept)).max()))
    return largest


def stable_direction(values: FloatArray, wanted: Direction | None = None) -> Direction:
    """The direction in which lines can be inverted exactly, or the requested one; backwards the PSF is reversed.

    Raises `RestorationError` where the inverse is unstable in the requested direction; or in both: the PSF has zeros on
    both sides of the unit circle.
    """
    zeros: dict[Direction, float] = {"forward": largest_zero(values), "backward": largest_zero(values[..., ::-1])}
    best: Direction = "forward" if zeros["forward"] <= zeros["backward"] else "backward"
    way = wanted or best
    if zeros[way] <= 1 + _ON_CIRCLE:
        return way
    if wanted is None:
        raise RestorationError(
            f"the exact inverse is unstable: the PSF's largest zero is {zeros['forward']:.3g} forwards and"
            f" {zeros['backward']:.3g} with the line scanned backwards, and it must lie within the unit circle; use the"
            " method smoother, gauss_markov or tv"
        )
    turned: Direction = "backward" if way == "forward" else "forward"
    cure = f"direction={turned!r} is stable" if zeros[turned] <= 1 + _ON_CIRCLE else "so is the other direction"
    raise RestorationError(
        f"the exact inverse is unstable {way}s: the PSF's largest zero is {zeros[way]:.3g}, and it must lie within"
        f" the unit circle; {cure} ({zeros[turned]:.3g}), or use the method smoother, gauss_markov or tv"
    )


def invert_lines(lines: FloatArray, values: FloatArray, known: FloatArray | None) -> FloatArray:
    """The scenes whose blur is exactly these lines (lines, columns), scanned forwards: (lines, columns + m), the m
    pixels of the initial state first. The PSF is (taps,) or (columns, taps), c_0 above zero.

    ``known`` are the scene's m pixels before the first that c_0 meets, in their order on the line, (lines or 1, m).
    None estimates them: of all scenes that give these lines, the one with the smallest differences.
    """
    columns, m = lines.shape[1], values.shape[-1] - 1
    C = line_matrix(values, columns)
    T = C[:, m:]
    free = linalg.solve_triangular(T, lines.T, lower=True)
    response = -linalg.solve_triangular(T, C[:, :m], lower=True)
    if known is None:
        whole = np.concatenate([np.eye(m), response])
        unmoved = np.concatenate([np.zeros((m, len(lines))), free])
        start = np.linalg.lstsq(np.diff(whole, axis=0), -np.diff(unmoved, axis=0), rcond=None)[0]
    else:
        start = np.broadcast_to(known, (len(lines), m)).T
    return np.concatenate([start, free + response @ start]).T
