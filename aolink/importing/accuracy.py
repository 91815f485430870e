"""The tracker's error on objects like those of a film: it follows made ones, with their light, noise and motion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from aolink.importing.tracker import Objects, Tracker, trackpy_locator
from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import pixel_masses

_SHAPES = 7
"""Numbers of a Gaussian's fit: ground, light, place, and the width in each direction."""
_TIMES = 5
"""Moments in a frame at which a made object is shown."""


def pixel_noise(windows: FloatArray, centres: FloatArray, sd: float) -> tuple[float, float]:
    """Variance of a dark pixel, and what light adds to it, for one unit of light.

    They are of what a Gaussian with a place, width and direction of its own leaves of each window, (windows, side,
    side), NaN where a pixel is left out; ``centres`` are (windows, 2) as (x, y). So light that has another shape than
    the Gaussian counts as noise, and the blur of an object that moves in a frame does not.
    """
    edges = np.arange(windows.shape[1] + 1) - 0.5
    squares, light = [], []
    for window, centre in zip(windows, centres, strict=True):
        known = np.isfinite(window)
        if not np.isfinite(centre).all() or known.sum() <= 2 * _SHAPES:
            continue
        x, y = (pixel_masses(sd**2, edges, np.asarray(centre[d]), 2) for d in (0, 1))
        terms = [np.outer(y[i], x[j]) for i in range(3) for j in range(3 - i)]
        columns = np.column_stack([np.ones(int(known.sum())), *(each[known] for each in terms)])
        found, *_ = np.linalg.lstsq(columns, window[known], rcond=None)
        left = window[known] - columns @ found
        squares.append(left**2 * len(left) / (len(left) - _SHAPES))
        light.append(np.maximum(found[1] * columns[:, 1], 0.0))
    if not squares:
        return 0.0, 0.0
    square, shown = np.concatenate(squares), np.concatenate(light)
    (dark, gain), *_ = np.linalg.lstsq(np.column_stack([np.ones(len(shown)), shown]), square, rcond=None)
    return (float(dark), float(gain)) if dark > 0 and gain > 0 else (float(square.mean()), 0.0)


def tracker_errors(
    places: FloatArray, samples: Sequence[int], light: FloatArray, sd: float, noise: tuple[float, float]
) -> FloatArray:
    """Standard deviation of the tracker's error along one direction, for each object, pixels, (n,).

    It follows Gaussians of the objects' size and light in the given noise. Each moves in a frame as a parabola does
    that has the places in this frame and its neighbours, (frames, n, 2), as its means there.
    """
    side = 2 * math.ceil(4 * sd) + 1
    n = places.shape[1]
    middles = np.column_stack([np.arange(n) * side + side // 2, np.full(n, side // 2)]).astype(np.float64)
    edges_x, edges_y = (np.arange(count + 1, dtype=np.float64) - 0.5 for count in (n * side, side))
    rng = np.random.default_rng(1)
    locate = trackpy_locator(sd)
    moments = (np.arange(_TIMES) + 0.5) / _TIMES - 0.5
    squares = np.full((len(samples), n), np.nan)
    for row, k in enumerate(samples):
        before, now, after = places[max(k - 1, 0)], places[k], places[min(k + 1, len(places) - 1)]
        speed = np.nan_to_num((after - before) / 2)
        bend = np.nan_to_num((after - 2 * now + before) / 2)
        true = middles + rng.uniform(-0.5, 0.5, (n, 2))
        path = true + speed * moments[:, None, None] + bend * (moments**2 - np.mean(moments**2))[:, None, None]
        picture = np.zeros((side, n * side))
        for j in range(n):
            x, y = (pixel_masses(sd**2, edges, path[:, j, d], 0)[0] for d, edges in enumerate((edges_x, edges_y)))
            picture += np.nan_to_num(light[j]) / _TIMES * (y.T @ x)
        variance = np.maximum(noise[0] + noise[1] * picture, 0.0)
        found = Tracker(Objects(middles, sd), locate).follow(
            picture + np.sqrt(variance) * rng.normal(size=picture.shape)
        )
        squares[row] = np.where(np.isfinite(now).all(axis=1), ((found - true) ** 2).mean(axis=1), np.nan)
    known = np.isfinite(squares)
    counted = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
    return np.asarray(np.sqrt(np.where(known, squares, 0.0).sum(axis=0) / counted))
