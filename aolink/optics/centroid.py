"""Centroids of spots by the usual methods: centre of gravity, thresholded, weighted, correlation.

Windows are densities or counts without background, (n, rows, columns). Positions are (x, y) in pixels, x along
the columns and y along the rows, and 0 is the middle of the first pixel. NaN where a window holds no light.
"""

from __future__ import annotations

import numpy as np

from aolink.numerics.arrays import FloatArray


def centre_of_gravity(windows: FloatArray, threshold: FloatArray | float = 0.0) -> FloatArray:
    """First moments, (n, 2).

    Parameters
    ----------
    threshold:
        Threshold that is subtracted from each window, after which only values above zero count; one for all windows or
        (n,). With zero all pixels count, negative ones as well, so that the noise's mean stays zero.
    """
    if np.any(threshold):
        windows = np.maximum(windows - np.broadcast_to(threshold, len(windows))[:, None, None], 0.0)
    rows, columns = windows.shape[1:]
    light = windows.sum(axis=(1, 2))
    light = np.where(light > 0, light, np.nan)
    x = windows.sum(axis=1) @ np.arange(columns)
    y = windows.sum(axis=2) @ np.arange(rows)
    return np.stack([x, y], axis=1) / light[:, None]


def weighted_centroid(
    windows: FloatArray, weight_sd: float, iterations: int = 20, start: FloatArray | None = None
) -> FloatArray:
    """Weighted centre of gravity: a Gaussian weight is moved to the centroid that it gives, again and again, (n, 2).

    The centroid under a weight at distance d from a Gaussian spot is off by a share of d; repeated, the weight ends on
    the spot. Thomas et al., Mon. Not. R. Astron. Soc. 371, 323 (2006).

    Parameters
    ----------
    weight_sd:
        Standard deviation of the weight, pixels.
    start:
        First position of the weight, (n, 2); each window's brightest pixel where None.
    """
    rows, columns = windows.shape[1:]
    x, y = np.arange(columns), np.arange(rows)
    brightest = windows.reshape(len(windows), -1).argmax(axis=1)
    place = np.stack([brightest % columns, brightest // columns], axis=1).astype(np.float64) if start is None else start
    for _ in range(iterations):
        across = np.exp(-(((x - place[:, :1]) / weight_sd) ** 2) / 2)
        along = np.exp(-(((y - place[:, 1:]) / weight_sd) ** 2) / 2)
        place = centre_of_gravity(windows * along[:, :, None] * across[:, None, :])
    return place


def correlation_centroid(windows: FloatArray, template: FloatArray, iterations: int = 8) -> FloatArray:
    """Position of the template's centroid where it correlates best with each window, (n, 2).

    The correlation is a trigonometric polynomial of the shift, and Newton's method finds its maximum.

    Parameters
    ----------
    template:
        An image of the spot, without background, no larger than a window, (rows, columns).
    """
    rows, columns = (2 * n for n in windows.shape[1:])  # so that the correlation is not periodic
    product = np.fft.fft2(windows, (rows, columns)) * np.fft.fft2(template, (rows, columns)).conj()
    correlation = np.fft.ifft2(product).real.reshape(len(windows), -1)
    best = correlation.argmax(axis=1)
    y, x = best // columns, best % columns
    shift = np.stack([np.where(x < columns // 2, x, x - columns), np.where(y < rows // 2, y, y - rows)], 1).astype(
        float
    )
    # The Nyquist frequency has both signs, whose derivatives cancel.
    k_x, k_y = (2 * np.pi * np.where(np.abs(f) == 0.5, 0, f) for f in (np.fft.fftfreq(columns), np.fft.fftfreq(rows)))
    start = shift.copy()
    for _ in range(iterations):
        waves = product * np.exp(1j * (k_x * shift[:, :1])[:, None, :] + 1j * (k_y * shift[:, 1:])[:, :, None])
        by_x, by_y = waves.sum(axis=1), waves.sum(axis=2)
        gradient = -np.stack([(by_x * k_x).sum(axis=1).imag, (by_y * k_y).sum(axis=1).imag], axis=1)
        xx, yy = -(by_x * k_x**2).sum(axis=1).real, -(by_y * k_y**2).sum(axis=1).real
        xy = -((waves @ k_x) @ k_y).real
        determinant = xx * yy - xy**2
        uphill = (determinant > 0) & (xx < 0)  # near a maximum: elsewhere Newton's step leads away from it
        safe = np.where(uphill, determinant, 1.0)
        step = np.stack([yy * gradient[:, 0] - xy * gradient[:, 1], xx * gradient[:, 1] - xy * gradient[:, 0]], 1)
        shift = np.clip(shift - np.where(uphill, 1 / safe, 0.0)[:, None] * step, start - 1, start + 1)
    place = centre_of_gravity(template[None])[0] + shift
    return np.where((windows.max(axis=(1, 2)) > 0)[:, None], place, np.nan)
