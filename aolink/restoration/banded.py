"""The Kalman smoother of all rows at once, for a first-order scanner, as the solution of a banded system."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.restoration.psf import line_matrix

# From this number of lines on, products of blocks are faster than solving line by line.
MANY_LINES = 64
# Smallest block, pixels; and multiplications in one product of blocks: linear algebra's own threads would wait for
# each other longer than a smaller one takes.
_BLOCK, _PRODUCT = 16, 250_000


def smooth_lines(
    lines: FloatArray, values: FloatArray, correlation: float, variance: float, noise_variance: float,
    seen: BoolArray | None = None, known: FloatArray | None = None,
) -> FloatArray:  # fmt: skip
    """Posterior mean of a scene of zero mean, given all pixels of each line.

    Minimises |image - C scene|^2 / s^2 + scene' Q scene, with Q the tridiagonal inverse covariance of a first-order
    line; (C'C / s^2 + Q) has as many bands as the PSF has taps.

    Parameters
    ----------
    lines:
        (lines, columns)
    values:
        The PSF, (taps,), or that of each pixel, (columns, taps).
    correlation, variance:
        Correlation and variance of the scene, see `aolink.restoration.scanner.first_order`.
    noise_variance:
        s^2, variance of the lines' white noise.
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
    if seen is None:
        groups = [(np.arange(n_lines), np.ones(columns))]
    else:
        lines = np.where(seen, lines, 0.0)
        masks, group = np.unique(seen, axis=0, return_inverse=True)
        groups = [(np.flatnonzero(group.ravel() == g), mask.astype(np.float64)) for g, mask in enumerate(masks)]
    right = _blur_transposed(lines, taps)
    right /= noise_variance
    for rows, weight in groups:
        bands = _prior(columns + m, correlation, variance, max(m, 1))
        bands += normal_bands(taps, weight / noise_variance)
        some = slice(None) if len(rows) == n_lines else rows
        if known is not None and m:
            start = np.broadcast_to(known, (n_lines, m))[some]
            right[some, m:] = _given_start(bands, right[some], start)
            right[some, :m] = start
        else:
            right[some] = _solved(bands, right[some])
    return right


def _prior(size: int, correlation: float, variance: float, reach: int) -> FloatArray:
    """Q in the lower form of `solveh_banded`, (reach + 1, size)."""
    bands = np.zeros((reach + 1, size))
    scale = 1 / (variance * (1 - correlation**2))
    bands[0] = scale * (1 + correlation**2)
    bands[0, [0, -1]] = scale
    bands[1, :-1] = -scale * correlation
    return bands


def normal_bands(taps: FloatArray, weight: FloatArray) -> FloatArray:
    """C' diag(weight) C in the lower form of `solveh_banded`, (taps or 2, size), from taps (columns, taps).

    Element (i + d, i) has all products of taps that lie d apart.
    """
    columns, m = taps.shape[0], taps.shape[1] - 1
    bands = np.zeros((max(m, 1) + 1, columns + m))
    weighted = taps * weight[:, None]
    for d in range(m + 1):
        for j in range(d, m + 1):
            first = m - j
            bands[d, first : first + columns] += weighted[:, j] * taps[:, j - d]
    return bands


def dense(bands: FloatArray) -> FloatArray:
    """The whole symmetric matrix from its lower bands."""
    n = bands.shape[1]
    out, i = np.zeros((n, n)), np.arange(n)
    for d, band in enumerate(bands[:n]):
        out[i[d:], i[: n - d]] = out[i[: n - d], i[d:]] = band[: n - d]
    return out


def _blur_transposed(lines: FloatArray, taps: FloatArray) -> FloatArray:
    """C' multiplied by each line, (lines, columns + m)."""
    columns, m = taps.shape[0], taps.shape[1] - 1
    C, width = line_matrix(taps, columns), max(m, _BLOCK)
    out = np.empty((len(lines), columns + m))
    for rows in _row_blocks(len(lines), width * (width + m)):
        for k in range(0, columns + m, width):
            met = slice(max(k - m, 0), min(k + width, columns))
            np.matmul(lines[rows, met], C[met, k : k + width], out=out[rows, k : k + width])
    return out


def _row_blocks(n_lines: int, one: int) -> list[slice]:
    step = max(1, _PRODUCT // one)
    return [slice(k, k + step) for k in range(0, n_lines, step)]


def _solved(bands: FloatArray, right: FloatArray) -> FloatArray:
    """x with A x = right for each line (lines, size); it may be written into ``right``."""
    if len(right) < MANY_LINES:
        return np.asarray(linalg.solveh_banded(bands, right.T, lower=True, check_finite=False).T)
    # A is block tridiagonal: D_0, D_1, .. and below them E_0, E_1, ..; eliminated from the first on,
    # S_i+1 = D_i+1 - G_i E_i', G_i = E_i S_i^-1.
    A, width, n = dense(bands), max(len(bands) - 1, _BLOCK), bands.shape[1]
    parts = [slice(k, min(k + width, n)) for k in range(0, n, width)]
    S, inverses, ratios = A[parts[0], parts[0]], [], []
    for here, after in zip(parts, [*parts[1:], slice(n, n)], strict=True):
        inverses.append(linalg.cho_solve((linalg.cholesky(S, lower=True), True), np.eye(len(S))))
        ratios.append(A[after, here] @ inverses[-1])
        S = A[after, after] - ratios[-1] @ A[after, here].T
    for rows in _row_blocks(len(right), width * width):
        x = right[rows]
        for here, after, G in zip(parts, parts[1:], ratios, strict=False):
            x[:, after] -= x[:, here] @ G.T
        x[:, parts[-1]] = x[:, parts[-1]] @ inverses[-1]
        for here, after, inverse, G in reversed(list(zip(parts, parts[1:], inverses, ratios, strict=False))):
            x[:, here] = x[:, here] @ inverse - x[:, after] @ G
    return right


def _given_start(bands: FloatArray, right: FloatArray, start: FloatArray) -> FloatArray:
    """Solve for the rest of the lines where the first m elements are known."""
    m = start.shape[1]
    rest = right[:, m:].copy()
    for i in range(m):
        for d in range(m - i, len(bands)):
            rest[:, i + d - m] -= bands[d, i] * start[:, i]
    return _solved(bands[:, m:], rest)
