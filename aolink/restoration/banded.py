"""The row smoother as a banded solve: what the Kalman smoother gives with a first-order scanner, all rows at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def smooth_lines(
    lines: FloatArray,
    values: FloatArray,
    correlation: float,
    variance: float,
    noise_variance: float,
    seen: BoolArray | None = None,
    known: FloatArray | None = None,
) -> FloatArray:
    """Expected scene of zero mean, given all pixels of each line.

    Minimises |image - C scene|^2 / s^2 + scene' Q scene, with Q the tridiagonal inverse covariance of a first-order
    line; (C'C / s^2 + Q) has as many bands as the PSF has taps.

    Parameters
    ----------
    lines:
        (lines, columns)
    values:
        (taps,) or (columns, taps).
    correlation, variance:
        Of the scene, see `aolink.restoration.scanner.first_order`.
    seen:
        False where a pixel was not measured, (lines, columns).
    known:
        The scene's m pixels before the first that c_0 meets, in their order on the line, (lines or 1, m).

    Returns
    -------
    (lines, columns + m), the m pixels before that one first.
    """
    n_lines, columns = lines.shape
    m = values.shape[-1] - 1
    taps = np.broadcast_to(values, (columns, m + 1))
    out = np.empty((n_lines, columns + m))
    if seen is None:
        groups = [(np.arange(n_lines), np.ones(columns))]
    else:
        masks, group = np.unique(seen, axis=0, return_inverse=True)
        groups = [(np.flatnonzero(group.ravel() == g), mask.astype(np.float64)) for g, mask in enumerate(masks)]
    for rows, weight in groups:
        bands = _prior(columns + m, correlation, variance, max(m, 1))
        _add_blur(bands, taps, weight / noise_variance)
        right = _blur_transposed(np.where(weight > 0, lines[rows], 0.0) / noise_variance, taps)
        if known is not None and m:
            start = np.broadcast_to(known, (n_lines, m))[rows]
            out[rows, :m], out[rows, m:] = start, _given_start(bands, right, start)
        else:
            out[rows] = linalg.solveh_banded(bands, right.T, lower=True, overwrite_ab=True, check_finite=False).T
    return out


def _prior(size: int, correlation: float, variance: float, reach: int) -> FloatArray:
    """Q in the lower form of `solveh_banded`, (reach + 1, size)."""
    bands = np.zeros((reach + 1, size))
    scale = 1 / (variance * (1 - correlation**2))
    bands[0] = scale * (1 + correlation**2)
    bands[0, [0, -1]] = scale
    bands[1, :-1] = -scale * correlation
    return bands


def _add_blur(bands: FloatArray, taps: FloatArray, weight: FloatArray) -> None:
    """Add C' diag(weight) C. Element (i + d, i) has all products of taps that lie d apart."""
    columns, m = taps.shape[0], taps.shape[1] - 1
    weighted = taps * weight[:, None]
    for d in range(m + 1):
        for j in range(d, m + 1):
            first = m - j
            bands[d, first : first + columns] += weighted[:, j] * taps[:, j - d]


def _blur_transposed(lines: FloatArray, taps: FloatArray) -> FloatArray:
    """C' applied to lines, (lines, columns + m)."""
    columns, m = taps.shape[0], taps.shape[1] - 1
    out = np.zeros((len(lines), columns + m))
    for j in range(m + 1):
        out[:, m - j : m - j + columns] += lines * taps[:, j]
    return out


def _given_start(bands: FloatArray, right: FloatArray, start: FloatArray) -> FloatArray:
    """Solve for the rest of the lines where the first m elements are known."""
    m = start.shape[1]
    rest = right[:, m:].copy()
    for i in range(m):
        for d in range(m - i, len(bands)):
            rest[:, i + d - m] -= bands[d, i] * start[:, i]
    return np.asarray(linalg.solveh_banded(bands[:, m:], rest.T, lower=True, check_finite=False).T)
