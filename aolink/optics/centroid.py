"""Centroids of spots by the usual methods: centre of gravity, thresholded, weighted.

Windows are densities or counts without background, (n, rows, columns). Positions are (x, y) in pixels, x along
the columns and y along the rows, and 0 is the middle of the first pixel. NaN where a window holds no light.
"""

from __future__ import annotations

import numpy as np

from aolink.numerics.arrays import FloatArray

_ITERATIONS = 20
"""How often a weight is moved to the centroid that it gives."""


def centre_of_gravity(windows: FloatArray, threshold: FloatArray | float = 0.0) -> FloatArray:
    """First moments, (n, 2).

    ``threshold``, one for all windows or (n,), is subtracted from each, after which only values above zero count. With
    zero all pixels count, negative ones as well, so that the noise's mean stays zero.
    """
    if np.any(threshold):
        windows = np.maximum(windows - np.broadcast_to(threshold, len(windows))[:, None, None], 0.0)
    rows, columns = windows.shape[1:]
    light = windows.sum(axis=(1, 2))
    light = np.where(light > 0, light, np.nan)
    x = windows.sum(axis=1) @ np.arange(columns)
    y = windows.sum(axis=2) @ np.arange(rows)
    return np.stack([x, y], axis=1) / light[:, None]


def weighted_centroid(windows: FloatArray, weight_sd: float, start: FloatArray | None = None) -> FloatArray:
    """Weighted centre of gravity: a Gaussian weight is moved to the centroid that it gives, again and again, (n, 2).

    The centroid under a weight at distance d from a Gaussian spot is off by a share of d; repeated, the weight ends on
    the spot. Thomas et al., Mon. Not. R. Astron. Soc. 371, 323 (2006). ``weight_sd`` is in pixels; ``start``, (n, 2),
    is the weight's first position; each window's brightest pixel where None.
    """
    rows, columns = windows.shape[1:]
    x, y = np.arange(columns), np.arange(rows)
    brightest = windows.reshape(len(windows), -1).argmax(axis=1)
    place = np.stack([brightest % columns, brightest // columns], axis=1).astype(np.float64) if start is None else start
    for _ in range(_ITERATIONS):
        across = np.exp(-(((x - place[:, :1]) / weight_sd) ** 2) / 2)
        along = np.exp(-(((y - place[:, 1:]) / weight_sd) ** 2) / 2)
        place = centre_of_gravity(windows * along[:, :, None] * across[:, None, :])
    return place
