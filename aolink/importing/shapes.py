"""The shape of a film's objects in the single frames: which of them are longer than they are wide."""

from __future__ import annotations

import math

import numpy as np

from aolink.importing.accuracy import within_frames
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.kernel import pixel_masses

_FEWEST = 10
"""Number of frames from which on a shape is known."""
_CERTAIN = 4.0
"""Standard deviations of its square by which a difference of the axes is certain."""
_TIMES = 5
"""Moments of a frame at which the motion in it is taken."""
_LONGEST = 0.8
"""Largest difference of the axes' variances over their sum, for objects three times as long as wide."""
_BENT = 0.42
"""By this factor of its square the fit exceeds that difference, for ellipses of Gaussian profile 1.2 to 2 times as long
as wide, because it is of first order."""


def axis_ratios(
    windows: FloatArray, centres: FloatArray, sd: float, usable: BoolArray, motion: FloatArray
) -> FloatArray:
    """Length of each object's light over its width, as standard deviations, (n,), at most 3: 1 where they are not
    certain to differ, NaN where too little of it is seen.

    Second derivatives of a Gaussian of standard deviation ``sd``, pixels, are fitted to ``windows`` (samples, n, side,
    side) about ``centres`` (samples, n, 2), where an object is ``usable`` (samples, n); ``motion`` is the covariance of
    its motion in the frame, which is no shape, (samples, n, 2, 2). An object may turn during the film: products of
    successive samples are averaged, in which noise has no share.
    """
    samples, n, side, _ = windows.shape
    edges = np.arange(side + 1) - 0.5
    found = np.full((samples, n, 4), np.nan)  # light, and what xx, yy and xy add to its covariance, times the light
    for k, j in np.argwhere(usable & np.isfinite(centres).all(axis=2)):
        window, (x, y) = windows[k, j], (pixel_masses(sd**2, edges, centres[k, j, d], 2) for d in (0, 1))
        known = np.isfinite(window)
        terms = [np.outer(y[a], x[b]) for b, a in ((0, 0), (2, 0), (0, 2), (1, 1), (1, 0), (0, 1))]
        columns = np.column_stack([*(each[known] for each in terms), np.ones(int(known.sum()))])
        if len(columns) > 2 * columns.shape[1]:
            found[k, j] = np.linalg.lstsq(columns, window[known], rcond=None)[0][:4] * (1.0, 2.0, 2.0, 1.0)
    ratios = np.full(n, np.nan)
    for j in range(n):
        seen = np.isfinite(found[:, j, 0])
        light = float(found[seen, j, 0].mean()) if seen.sum() >= _FEWEST else 0.0
        if light <= 0:
            continue
        moved = motion[seen, j][:, [0, 1, 0], [0, 1, 1]]
        xx, yy, xy = (found[seen, j, 1:] / light - moved).T
        differences = np.column_stack([(xx - yy) / 2, xy])
        products = (differences[1:] * differences[:-1]).sum(axis=1)
        square, error = float(products.mean()), float(products.std()) / math.sqrt(len(products))
        mean = max(sd**2 + float((xx + yy).mean()) / 2, (sd / 2) ** 2)
        share = math.sqrt(max(square, 0.0)) / mean
        share = min((math.sqrt(1 + 4 * _BENT * share) - 1) / (2 * _BENT), _LONGEST)
        ratios[j] = math.sqrt((1 + share) / (1 - share)) if square > _CERTAIN * error else 1.0
    return ratios


def motion_within(places: FloatArray) -> FloatArray:
    """Covariance of each object's motion in each frame, pixels squared, (frames, n, 2, 2); ``places`` are
    (frames, n, 2)."""
    nodes, weights = np.polynomial.legendre.leggauss(_TIMES)
    motion = within_frames(places, (nodes + 1) / 2)
    motion -= np.einsum("t, ktnd -> knd", weights / 2, motion)[:, None]
    return np.asarray(np.einsum("t, ktnc, ktnd -> kncd", weights / 2, motion, motion))
