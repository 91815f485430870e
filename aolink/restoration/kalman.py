"""The augmented Kalman filter along lines (Shahin (10)-(13)): predictor, filter, lag, and the smoother over it.

The state is W(k) = (X(k), Z(k)): X holds the scene's last m pixels, X_i = scene(k - i), the canonical realisation (8)
of the PSF's transfer function (7); Z is the scanner's. All lines are filtered at once. Where every line has the same
mask they share one covariance; otherwise each has its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.restoration.scanner import Scanner


@dataclass(frozen=True, kw_only=True, eq=False)
class LineModel:
    """The augmented model, Shahin (12), with the prior of its state at the first pixel."""

    A: FloatArray
    """The transition matrix, with B gamma and alpha in it, (states, states)."""
    Q: FloatArray
    """Process noise B-bar K B-bar', (states, states)."""
    rows: FloatArray
    """C-bar = (c_1 .. c_m, c_0 gamma) for each pixel, (columns, states)."""
    output: FloatArray
    """Row that gives the scene at k from W(k), (states,)."""
    start_mean: FloatArray
    """Mean of W(0), (lines or 1, states)."""
    start_covariance: FloatArray
    """Covariance P(0), (states, states)."""


def line_model(values: FloatArray, columns: int, scanner: Scanner, known: FloatArray | None = None) -> LineModel:
    """The model of lines of so many pixels of a scanner's scene, blurred by a PSF c_0 .. c_m, (taps,), or that of each
    pixel, (columns, taps).

    ``known`` are the m pixels of the scene before the first, about its mean, the nearest first, (lines or 1, m); None
    where they are not known and have the scanner's stationary covariance.
    """
    taps = np.broadcast_to(values, (columns, values.shape[-1]))
    m, q = taps.shape[1] - 1, len(scanner.gamma)
    n = m + q
    A, Q = np.zeros((n, n)), np.zeros((n, n))
    A[:m, :m] = np.eye(m, k=-1)
    if m:
        A[0, m:] = scanner.gamma
    A[m:, m:] = scanner.alpha
    Q[m:, m:] = scanner.noise
    rows = np.concatenate([taps[:, 1:], taps[:, :1] * scanner.gamma], axis=1)
    output = np.concatenate([np.zeros(m), scanner.gamma])
    P = _stationary(scanner, m)
    mean = np.zeros((1, n))
    if known is not None and m:
        # The scanner's state, given the pixels that it has just put out.
        gain = np.linalg.lstsq(P[:m, :m], P[:m, m:], rcond=None)[0]
        mean = np.concatenate([known, known @ gain], axis=1)
        given = P[m:, m:] - P[m:, :m] @ gain
        P = np.zeros_like(P)
        P[m:, m:] = (given + given.T) / 2
    return LineModel(A=A, Q=Q, rows=rows, output=output, start_mean=mean, start_covariance=P)


def _stationary(scanner: Scanner, m: int) -> FloatArray:
    """Covariance of (scene(-1) .. scene(-m), Z(0))."""
    sigma, r = scanner.covariance, scanner.correlation(max(m - 1, 0))
    P = np.empty((m + len(sigma),) * 2)
    lag = np.abs(np.subtract.outer(np.arange(m), np.arange(m)))
    P[:m, :m], P[m:, m:] = r[lag], sigma
    reach = sigma @ scanner.gamma
    for i in range(m):
        # Z(0) = alpha^(i+1) Z(-i-1) + later noise.
        reach = scanner.alpha @ reach
        P[m:, i] = P[i, m:] = reach
    return P


@dataclass(frozen=True, kw_only=True, eq=False)
class Filtered:
    """States along the lines. Covariances are shared by all lines (first axis 1), or each line has its own."""

    predicted: FloatArray
    """W(k) given the pixels before k, (columns, lines, states)."""
    filtered: FloatArray
    """W(k) given the pixels up to k, (columns, lines, states)."""
    predicted_covariance: FloatArray
    """(columns, lines or 1, states, states); without columns where it was not kept."""
    filtered_covariance: FloatArray


def kalman(
    model: LineModel, lines: FloatArray, noise_variance: float, seen: BoolArray | None = None, keep: bool = False
) -> Filtered:
    """Filter lines (lines, columns); ``seen`` is False where a pixel was not measured, and ``keep`` says whether to
    keep the covariances, which the smoother needs.

    Shahin (13), with the barred B in B K B', in the usual two steps; F(k) there is A times the gain here.
    """
    n_lines, columns = lines.shape
    n = model.A.shape[0]
    W = np.broadcast_to(model.start_mean, (n_lines, n)).copy()
    P = model.start_covariance[None]
    if seen is not None and not (seen == seen[:1]).all():
        P = np.repeat(P, n_lines, axis=0)
    shared = len(P) == 1
    predicted, filtered = np.empty((2, columns, n_lines, n))
    shape = (columns if keep else 0, *P.shape)
    P_predicted, P_filtered = np.empty(shape), np.empty(shape)
    for k, row in enumerate(model.rows):
        predicted[k] = W
        PC = P @ row
        gain = PC / (PC @ row + noise_variance)[:, None]
        if seen is not None:
            gain = gain * (seen[:1, k] if shared else seen[:, k])[:, None]
        W = W + gain * np.where(True if seen is None else seen[:, k], lines[:, k] - W @ row, 0.0)[:, None]
        P_after = P - gain[:, :, None] * PC[:, None, :]
        filtered[k] = W
        if keep:
            P_predicted[k], P_filtered[k] = P, P_after
        W = W @ model.A.T
        P = model.A @ P_after @ model.A.T + model.Q
        P = (P + P.swapaxes(1, 2)) / 2
    return Filtered(
        predicted=predicted, filtered=filtered, predicted_covariance=P_predicted, filtered_covariance=P_filtered
    )


def smooth(model: LineModel, result: Filtered) -> FloatArray:
    """W(k) given all pixels (Rauch, Tung and Striebel), (columns, lines, states)."""
    out = result.filtered.copy()
    for k in range(len(out) - 2, -1, -1):
        crossed = model.A @ result.filtered_covariance[k]
        # Pixels that are known, or shifted along, have no variance of their own: the pseudo-inverse.
        gain = np.linalg.pinv(result.predicted_covariance[k + 1], rcond=1e-13, hermitian=True) @ crossed
        out[k] += ((out[k + 1] - result.predicted[k + 1])[:, None, :] @ gain)[:, 0]
    return out


def scene_from_states(model: LineModel, states: FloatArray, pixels: range, lag: int = 0, first: int = 0) -> FloatArray:
    """Pixels of the scene from states: pixel k from state k + lag, (lines, len(pixels)).

    Pixels before that of state ``first`` are taken from the past pixels X which that state holds.
    """
    columns, n_lines, _ = states.shape
    out = np.empty((n_lines, len(pixels)))
    for i, pixel in enumerate(pixels):
        k = min(max(pixel + lag, first), columns - 1)
        out[:, i] = states[k] @ model.output if pixel == k else states[k][:, k - pixel - 1]
    return out
