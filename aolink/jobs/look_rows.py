"""Lines and edges in the films of cameras that expose their rows one after the other: where they are, and their bands.

A target that goes through many rows, as a bolt's edge, tape, or a line of light, is seen at another time in each row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from aolink.identification.bands import Bands
from aolink.numerics.arrays import FloatArray, IntArray

BAND_S = 0.2e-3
"""Longest time from the first row of a band to that of the next."""
_BIN = 8
"""Rows that are summed to find a target."""
_SMOOTH = 1.5
_WINDOW = 32
"""Columns about a target that are looked at."""
_LEAST_ROWS = 128
"""Rows that a target must go through: spots are smaller."""
_NEAR = 3.0
"""Pixels from a parabola within which a place belongs to it."""
_INLIERS = 0.7
_TRIES = 300
_STEEP = 1.0
"""Columns that a target may go aside within a band."""


@dataclass(frozen=True, eq=False)
class Target:
    """A line or an edge through many rows."""

    first: int
    """First row."""
    places: FloatArray
    """Column in each row, (rows,)."""
    mean: FloatArray
    """Mean of the frames, (rows, columns)."""


def find_target(frames: Iterator[FloatArray], at: tuple[float, float] | None, size: int) -> Target | None:
    """The line or edge that moves most, or is strongest where none does; about the place ``at`` (x, y) where one is
    given, as wide as ``size``. None where nothing goes through many rows."""
    count, total, squares, whole = 0, None, None, None
    for frame in frames:
        rows = len(frame) // _BIN * _BIN
        if rows < _LEAST_ROWS or frame.shape[1] < _WINDOW + 2:
            return None
        binned = ndimage.gaussian_filter1d(frame[:rows].reshape(-1, _BIN, frame.shape[1]).mean(axis=1), _SMOOTH, axis=1)
        if total is None:
            total, squares, whole = np.zeros_like(binned), np.zeros_like(binned), np.zeros_like(frame)
        total, squares, whole, count = total + binned, squares + binned**2, whole + frame, count + 1
    if total is None or squares is None or whole is None:
        return None
    mean = total / count
    variance = squares / count - mean**2
    slope = np.gradient(mean, axis=1) ** 2
    usual = float(np.median(variance))
    moving = ndimage.uniform_filter1d(np.maximum(variance - 2 * usual, 0.0) * slope, 5, axis=1)
    for score in (moving, ndimage.uniform_filter1d(slope, 5, axis=1)):
        shown = score.copy()
        shown[:, : _WINDOW // 4], shown[:, -(_WINDOW // 4) :] = 0, 0
        if at is not None:
            columns = np.arange(shown.shape[1])
            shown[:, np.abs(columns - at[0]) > size / 2] = 0
        best = shown.argmax(axis=1).astype(np.float64)
        strength = shown.max(axis=1)
        found = _parabola(best, strength > 0.02 * float(strength.max()) if strength.max() > 0 else strength > 0, at)
        if found is not None:
            first, last, curve = found
            rows = np.arange(first * _BIN, (last + 1) * _BIN)
            return Target(first * _BIN, np.polyval(curve, (rows - (_BIN - 1) / 2) / _BIN), whole / count)
    return None


def _parabola(
    best: FloatArray, good: np.ndarray, at: tuple[float, float] | None
) -> tuple[int, int, FloatArray] | None:
    """First and last bin of a parabola through most of the places, and its coefficients."""
    rows = np.flatnonzero(good)
    if len(rows) * _BIN < _LEAST_ROWS:
        return None
    rng, most, curve = np.random.default_rng(0), 0, np.zeros(3)
    for _ in range(_TRIES):
        three = rng.choice(rows, 3, replace=False)
        tried = np.polyfit(three, best[three], 2)
        inside = int((np.abs(np.polyval(tried, rows) - best[rows]) < _NEAR).sum())
        if inside > most:
            most, curve = inside, tried
    for _ in range(3):
        inliers = rows[np.abs(np.polyval(curve, rows) - best[rows]) < _NEAR]
        curve = np.polyfit(inliers, best[inliers], 2)
    first, last = int(inliers[0]), int(inliers[-1])
    if (last - first + 1) * _BIN < _LEAST_ROWS or len(inliers) < _INLIERS * (last - first + 1):
        return None
    return first, last, curve


def bands_of(
    frames: Iterator[FloatArray], target: Target, times_s: FloatArray, row_time_s: float, exposure_s: float,
    rate_hz: float,
) -> tuple[Bands, IntArray]:  # fmt: skip
    """The bands of a target, and the first row and column of each (B, 2); ``times_s`` are the middles of the exposures
    of each frame's first row."""
    slope = float(np.abs(np.diff(target.places)).max())
    n = max(1, min(int(BAND_S / abs(row_time_s)), int(_STEEP / max(slope, 1e-9)), len(target.places) // 8))
    count = len(target.places) // n
    places = target.places[: count * n].reshape(count, n)
    rows = target.first + np.arange(count * n).reshape(count, n)
    columns = target.mean.shape[1]
    first = np.clip(np.rint(places.mean(axis=1) - (_WINDOW - 1) / 2).astype(int), 0, columns - _WINDOW)
    y, x = rows[:, :, None], (first[:, None] + np.arange(_WINDOW))[:, None]
    images = np.array([frame[y, x].mean(axis=1) for frame in frames])
    bands = Bands(
        images=images, rest=places - first[:, None], times_s=times_s, delays_s=rows * row_time_s,
        exposure_s=exposure_s, rate_hz=rate_hz,
    )  # fmt: skip
    return bands, np.stack([rows[:, 0], first], axis=1)
