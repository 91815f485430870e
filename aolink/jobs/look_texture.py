"""Moments of the path of a part of a picture, whatever it shows, in each exposure.

To second order in the path about its mean, an exposure of a scene S that moves by p(t) is

    g [S(x - m) + C : grad grad S(x - m) / 2] + b + noise,

m the mean of p, C its covariance in the exposure. With a reference R in place of S that is one linear least-squares
problem a frame, in derivatives of images that are smoothed by a Gaussian wider than the path's spread. R is the mean of
the frames, each shifted back by its m: so C is known up to a constant, which is no more than R's own edges are wide.
Where the grey values vary along one direction only, as at an edge, the path is known along that only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from aolink.identification.vibration import PathMoments
from aolink.numerics.arrays import FloatArray

SMOOTH = 1.5
"""Standard deviation of the Gaussian that images are smoothed by, pixels."""
MARGIN = 4
"""Pixels about a region that derivatives and shifts need."""
_ROUNDS = 2
_LEAST_LIVELY = 0.03
"""Share of the most lively region's motion below which another is not looked at."""
_LEAST_WIDTH = 0.25
"""Least variance of an edge, pixels squared."""
_EDGE = 0.05
"""Information along the weaker axis, over that along the other, below which a region is an edge."""


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the picture: its first pixel (x, y) and its size (columns, rows)."""

    x: int
    y: int
    columns: int
    rows: int

    def cut(self, frames: FloatArray, margin: int = 0) -> FloatArray:
        """The region's pixels of frames (..., rows, columns), and so many about it."""
        return frames[
            ..., self.y - margin : self.y + self.rows + margin, self.x - margin : self.x + self.columns + margin
        ]


def moments_of(
    frames: FloatArray, times_s: FloatArray, exposure_s: float, rate_hz: float, smooth: float = SMOOTH
) -> tuple[PathMoments, FloatArray]:
    """The moments of a region, from its pixels with `MARGIN` more on each side, (K, rows, columns), and the reference.

    Noise is what the fits leave, frame by frame.
    """
    images = ndimage.gaussian_filter(frames, (0, smooth, smooth))
    reference = images.mean(axis=0)
    inside = (slice(MARGIN, -MARGIN),) * 2
    Q, edge = principal_axes(reference[inside])
    moved = np.zeros((len(frames), 2))
    for _ in range(_ROUNDS):
        spline = ndimage.spline_filter(reference)
        fits = [_fit(image, spline, shift, Q, edge, smooth) for image, shift in zip(images, moved, strict=True)]
        moved = np.array([each[0] for each in fits]) @ Q
        back = [ndimage.shift(image, -each[::-1], mode="nearest") for image, each in zip(images, moved, strict=True)]
        reference = np.mean(back, axis=0)
    mean, mean_variance, spread, spread_variance = (np.array([each[k] for each in fits])[:, None] for k in range(4))
    return PathMoments(
        times_s=times_s, exposure_s=exposure_s, rate_hz=rate_hz, mean=mean, mean_variance=mean_variance,
        spread=spread, spread_variance=spread_variance, axes=Q[None],
        constant_sd=_sharpness(reference, Q, smooth)[None] / 2,
    ), reference  # fmt: skip


def principal_axes(image: FloatArray) -> tuple[FloatArray, bool]:
    """The two axes of an image's gradients as rows (x, y), the stronger one first, and whether it is an edge."""
    y, x = np.gradient(image)
    tensor = np.array([[np.mean(x * x), np.mean(x * y)], [np.mean(x * y), np.mean(y * y)]])
    values, vectors = np.linalg.eigh(tensor)
    return vectors[:, ::-1].T.copy(), bool(values[0] < _EDGE * values[1])


def _sharpness(reference: FloatArray, Q: FloatArray, smooth: float) -> FloatArray:
    """The most that the mean blur of a reference can be, uu, uv and vv, (3,): the variance of its edges, which would be
    wider otherwise. Of a Gaussian edge that is half the mean square of its first derivative over its second's."""
    inside = (slice(MARGIN, -MARGIN),) * 2
    y, x = np.gradient(reference)
    widths = []
    for d in range(2):
        first = Q[d, 0] * x + Q[d, 1] * y
        hy, hx = np.gradient(first)
        second = Q[d, 0] * hx + Q[d, 1] * hy
        width = float((first[inside] ** 2).mean() / max(2 * float((second[inside] ** 2).mean()), 1e-300)) - smooth**2
        widths.append(max(width, _LEAST_WIDTH))
    return np.array([widths[0], math.sqrt(widths[0] * widths[1]), widths[1]])


def _fit(
    image: FloatArray, spline: FloatArray, shift: FloatArray, Q: FloatArray, edge: bool, smooth: float
) -> tuple[FloatArray, ...]:
    """Mean (2,), its variances, covariance (3,), its variances along the axes Q, and gain, about a shift (x, y)."""
    about = ndimage.shift(spline, shift[::-1], mode="nearest", prefilter=False)
    gy, gx = np.gradient(about)
    first = [Q[d, 0] * gx + Q[d, 1] * gy for d in range(2)]
    second = []
    for d in range(2):
        hy, hx = np.gradient(first[d])
        second.append([Q[e, 0] * hx + Q[e, 1] * hy for e in range(2)])
    columns = [about, np.ones_like(about), -first[0], second[0][0] / 2]
    if not edge:
        columns += [-first[1], second[0][1], second[1][1] / 2]
    inside = (slice(MARGIN, -MARGIN),) * 2
    A = np.stack([each[inside].ravel() for each in columns], axis=1)
    y = image[inside].ravel()
    scale = np.sqrt((A**2).sum(axis=0)) + 1e-300
    pseudo = np.linalg.pinv((A / scale).T @ (A / scale)) @ (A / scale).T / scale[:, None]
    x = pseudo @ y
    left = (y - A @ x).reshape(about[inside].shape)
    # Smoothing correlates the pixels' noise: P G sigma^2 G' P', and what is left is as smooth.
    kept = ndimage.gaussian_filter(pseudo.reshape(len(pseudo), *left.shape), (0, smooth, smooth))
    white = float((left**2).mean()) * 4 * math.pi * smooth**2
    variance = white * (kept**2).sum(axis=(1, 2))
    gain = x[0]
    place = Q @ shift
    mean, spread, mean_variance, spread_variance = place.copy(), np.zeros(3), np.full(2, np.inf), np.full(3, np.inf)
    parts = [(0, 2, 0, 3)] + ([] if edge else [(1, 4, 2, 6)])
    for d, k, s, j in parts:
        step = x[k] / gain
        mean[d] = place[d] + step
        mean_variance[d] = variance[k] / gain**2
        spread[s] = x[j] / gain - step**2
        spread_variance[s] = variance[j] / gain**2
    if not edge:
        spread[1] = x[5] / gain - x[2] * x[4] / gain**2
        spread_variance[1] = variance[5] / gain**2
    return mean, mean_variance, spread, spread_variance, np.array(gain)


def lively(frames: Iterable[FloatArray], size: int, most: int) -> tuple[list[Region], FloatArray]:
    """The regions that move most, none over another: where variance in time times gradient is largest; and the mean of
    the frames (rows, columns)."""
    total = squares = None
    count = 0
    for frame in frames:
        image = ndimage.gaussian_filter(frame, SMOOTH)
        total = image if total is None else total + image
        squares = image**2 if squares is None else squares + image**2
        count += 1
    assert total is not None
    assert squares is not None
    mean = total / count
    variance = np.maximum(squares / count - mean**2, 0.0)
    # What noise makes everywhere is no motion.
    variance = np.maximum(variance - 2 * np.median(variance), 0.0)
    y, x = np.gradient(mean)
    moving = ndimage.uniform_filter(variance * (x * x + y * y), size)
    rows, columns = moving.shape
    half = size // 2 + MARGIN + 1
    moving[:half], moving[rows - half :], moving[:, :half], moving[:, columns - half :] = 0, 0, 0, 0
    found: list[Region] = []
    brightest = float(moving.max())
    while len(found) < most and moving.max() > _LEAST_LIVELY * brightest:
        r, c = (int(k) for k in np.unravel_index(int(moving.argmax()), moving.shape))
        found.append(Region(c - size // 2, r - size // 2, size, size))
        moving[max(0, r - size) : r + size, max(0, c - size) : c + size] = 0
    return found, mean
