"""The exact inverse of the blur (Shahin, III), for pictures without noise."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from aolink.errors import RestorationError
from aolink.restoration.psf import line_matrix

FloatArray = NDArray[np.float64]
Direction = Literal["forward", "backward"]

# Zeros may lie on the unit circle, as those of a uniform PSF do: an error then keeps its size.
_ON_CIRCLE = 1e-6


def largest_zero(values: FloatArray) -> float:
    """Largest magnitude of the zeros of c_0 z^m + .. + c_m, over all pixels where each has its own PSF.

    An error of the initial state is multiplied by it from pixel to pixel: below one, the inverse is stable.
    """
    largest = 0.0
    for taps in np.unique(values.reshape(-1, values.shape[-1]), axis=0):
        kept = np.trim_zeros(taps)
        if len(kept) > 1:
            largest = max(largest, float(np.abs(np.roots(kept)).max()))
    return largest


def stable_direction(values: FloatArray) -> Direction:
    """The direction in which lines can be inverted exactly; backwards the PSF is reversed.

    Raises
    ------
    RestorationError
        The PSF has zeros on both sides of the unit circle.
    """
    forward, backward = largest_zero(values), largest_zero(values[..., ::-1])
    if min(forward, backward) > 1 + _ON_CIRCLE:
        raise RestorationError(
            f"the exact inverse is unstable: the PSF's largest zero is {forward:.3g} forwards and {backward:.3g} with"
            " the line scanned backwards, and it must lie within the unit circle; use the method smoother,"
            " gauss_markov or tv"
        )
    return "forward" if forward <= backward else "backward"


def check_direction(values: FloatArray, direction: Direction) -> None:
    """Refuse a direction in which the inverse is unstable, before it runs."""
    there, back = (largest_zero(v) for v in (values, values[..., ::-1]))
    found, other = (there, back) if direction == "forward" else (back, there)
    if found > 1 + _ON_CIRCLE:
        turned = "backward" if direction == "forward" else "forward"
        cure = (
            f"direction={turned!r} is stable ({other:.3g})"
            if other <= 1 + _ON_CIRCLE
            else f"so is the other direction ({other:.3g})"
        )
        raise RestorationError(
            f"the exact inverse is unstable {direction}s: the PSF's largest zero is {found:.3g}, and it must lie within"
            f" the unit circle; {cure}, or use the method smoother, gauss_markov or tv"
        )


def invert_lines(lines: FloatArray, values: FloatArray, known: FloatArray | None) -> FloatArray:
    """The scenes whose blur is exactly these lines, scanned forwards.

    Parameters
    ----------
    lines:
        (lines, columns)
    values:
        (taps,) or (columns, taps), c_0 above zero.
    known:
        The scene's m pixels before the first that c_0 meets, in their order on the line, (lines or 1, m). None
        estimates them: of all scenes that give these lines, the one with the smallest differences.

    Returns
    -------
    (lines, columns + m), the m pixels of the initial state first.
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
