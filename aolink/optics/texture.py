"""The motion of a part of a picture, whatever it shows, inside one exposure: mean and covariance of its path.

To second order in the path about its mean, an exposure of a scene S that moves by p(t) is

    g [S(x - m) + C : grad grad S(x - m) / 2] + b + noise,

m the mean of p, C its covariance in the exposure. With a reference R in place of S that is one linear least-squares
problem a frame, in derivatives of images that are smoothed by a Gaussian wider than the path's spread. Where R is
blurred itself, C is known up to a constant, which is no more than R's own edges are wide. Where the grey values vary
along one direction only, as at an edge, the path is known along that only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from aolink.numerics.arrays import FloatArray

SMOOTH = 1.5
"""Standard deviation of the Gaussian that images are smoothed by, pixels."""
MARGIN = 4
"""Pixels about a region that derivatives and shifts need."""
INSIDE = (slice(MARGIN, -MARGIN),) * 2
_ROUNDS = 3
_FIRST, _SECOND = np.array([1, -8, 0, 8, -1]) / 12, np.array([-1, 16, -30, 16, -1]) / 12
"""Derivatives, to the fourth order in a pixel."""
_EDGE = 0.05
"""Information along the weaker axis, over that along the other, below which a region is an edge."""
_LEAST_GAIN = 0.3
"""Contrast of a picture, over that of the reference, below which it shows something else."""


@dataclass(frozen=True, eq=False)
class Moments:
    """Mean (2,) of a path along the axes of a texture, its covariance there, uu, uv and vv, (3,), and the variances of
    these, infinite where they are not known; the gain g."""

    mean: FloatArray
    mean_variance: FloatArray
    spread: FloatArray
    spread_variance: FloatArray
    gain: float


class Texture:
    """A reference picture, with `MARGIN` more on each side than what is compared, (rows, columns)."""

    def __init__(self, picture: FloatArray, smooth: float = SMOOTH) -> None:
        self.smooth, self.reference = smooth, scipy.ndimage.gaussian_filter(picture, smooth)
        self.axes, self.edge = principal_axes(self.reference[INSIDE])
        self.take(self.reference)

    def take(self, reference: FloatArray) -> None:
        """Take another smoothed reference, with the same axes."""
        self.reference, self._spline = reference, scipy.ndimage.spline_filter(reference)

    @property
    def known_means(self) -> FloatArray:
        """What makes the known ones of u and v of x and y, (1 or 2, 2)."""
        return self.axes[: 1 if self.edge else 2]

    @property
    def known_spreads(self) -> FloatArray:
        """What makes the known ones of uu, uv and vv of xx, xy and yy, (1 or 3, 3)."""
        return turned_covariances(self.axes)[: 1 if self.edge else 3]

    def seen(self, picture: FloatArray) -> Moments | None:
        """The moments of the path of a picture that is as large as the reference; None where it shows something else or
        has gone further than `MARGIN`."""
        image = scipy.ndimage.gaussian_filter(picture, self.smooth)
        details, known = (each[INSIDE] - each[INSIDE].mean() for each in (image, self.reference))
        match = scipy.signal.fftconvolve(np.pad(details, MARGIN), known[::-1, ::-1], mode="valid")
        row, column = np.unravel_index(int(match.argmax()), match.shape)
        shift = np.array([column - MARGIN, row - MARGIN], dtype=np.float64)
        if self.edge:  # along it nothing is known
            shift = self.axes[0] * (self.axes[0] @ shift)
        for _ in range(_ROUNDS):
            found = self.fit(image, shift)
            shift = found.mean @ self.axes
            if not (found.gain > _LEAST_GAIN and np.abs(shift).max() <= MARGIN):
                return None
        return found

    def fit(self, image: FloatArray, shift: FloatArray) -> Moments:
        """The moments of the path of a smoothed picture, about a shift (x, y), pixels."""
        Q, smooth = self.axes, self.smooth
        about = scipy.ndimage.shift(self._spline, shift[::-1], mode="nearest", prefilter=False)
        first, (uu, uv, vv) = derivatives(about, Q)
        columns = [about, np.ones_like(about), -first[0], uu / 2]
        if not self.edge:
            columns += [-first[1], uv, vv / 2]
        A = np.stack([each[INSIDE].ravel() for each in columns], axis=1)
        y = image[INSIDE].ravel()
        scale = np.sqrt((A**2).sum(axis=0)) + 1e-300
        pseudo = np.linalg.pinv((A / scale).T @ (A / scale)) @ (A / scale).T / scale[:, None]
        x = pseudo @ y
        left = (y - A @ x).reshape(about[INSIDE].shape)
        # Smoothing correlates the pixels' noise: P G sigma^2 G' P', and what is left is as smooth.
        kept = scipy.ndimage.gaussian_filter(pseudo.reshape(len(pseudo), *left.shape), (0, smooth, smooth))
        white = float((left**2).mean()) * 4 * math.pi * smooth**2
        variance = white * (kept**2).sum(axis=(1, 2))
        gain = float(x[0])
        mean, spread, mean_variance, spread_variance = Q @ shift, np.zeros(3), np.full(2, np.inf), np.full(3, np.inf)
        parts = [(0, 2, 0, 3)] + ([] if self.edge else [(1, 4, 2, 6)])
        for d, k, s, j in parts:
            step = x[k] / gain
            mean[d] += step
            mean_variance[d] = variance[k] / gain**2
            spread[s] = x[j] / gain - step**2
            spread_variance[s] = variance[j] / gain**2
        if not self.edge:
            spread[1] = x[5] / gain - x[2] * x[4] / gain**2
            spread_variance[1] = variance[5] / gain**2
        return Moments(mean, mean_variance, spread, spread_variance, gain)


def derivatives(image: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of an image along the axes u and v, (2, rows, columns), and uu, uv and vv, (3, rows, columns)."""
    along = [[scipy.ndimage.correlate1d(image, stencil, axis) for axis in (1, 0)] for stencil in (_FIRST, _SECOND)]
    (x, y), (xx, yy) = along
    xy = scipy.ndimage.correlate1d(x, _FIRST, 0)
    return np.tensordot(Q, np.stack([x, y]), axes=1), np.tensordot(
        turned_covariances(Q), np.stack([xx, xy, yy]), axes=1
    )


def principal_axes(image: FloatArray) -> tuple[FloatArray, bool]:
    """The two axes of an image's gradients as rows (x, y), the stronger one first, and whether it is an edge."""
    y, x = np.gradient(image)
    tensor = np.array([[np.mean(x * x), np.mean(x * y)], [np.mean(x * y), np.mean(y * y)]])
    values, vectors = np.linalg.eigh(tensor)
    return vectors[:, ::-1].T.copy(), bool(values[0] < _EDGE * values[1])


def turned_covariances(q: FloatArray) -> FloatArray:
    """What makes xx, xy and yy of a covariance those along the rows of q, (3, 3)."""
    return np.array([
        [q[0, 0] ** 2, 2 * q[0, 0] * q[0, 1], q[0, 1] ** 2],
        [q[0, 0] * q[1, 0], q[0, 0] * q[1, 1] + q[0, 1] * q[1, 0], q[0, 1] * q[1, 1]],
        [q[1, 0] ** 2, 2 * q[1, 0] * q[1, 1], q[1, 1] ** 2],
    ])  # fmt: skip
