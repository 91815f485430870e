"""Moments of two-dimensional frames, cross terms with them: y_pq with E[y_pq] = mean(theta_x^p theta_y^q).

As `aolink.estimation.frames.moments`, for a kernel that may couple the two directions. The noise density V is
of the plane: a pixel of area D_x D_y has noise variance V / (D_x D_y).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from aolink.estimation.frames.frame_data import Measurement
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.optics.plane import kernel_moments_2d

Order = tuple[int, int]


def measure_moments_2d(
    density: FloatArray, x_edges: FloatArray, y_edges: FloatArray, kernel: FloatArray, noise_density: float,
    orders: Sequence[Order], light: FloatArray | None = None, photoelectrons: float = 0.0,
) -> Measurement:  # fmt: skip
    """Moments of frames without the kernel, whose light sums to one.

    Parameters
    ----------
    density:
        One over slope units squared, (axes, rows, columns), no pixel missing.
    x_edges, y_edges:
        Edges of equal columns and rows, slope units, (columns + 1,) and (rows + 1,).
    kernel:
        Covariance of the kernel, slope units squared, (2, 2).
    noise_density:
        V of the plane.
    orders:
        Pairs (p, q).
    light:
        Light of each spot as a share of a whole one's, (axes,); one where None.
    photoelectrons:
        Photoelectrons of a whole spot; 0 where shot noise is negligible.
    """
    highest = max(p + q for p, q in orders)
    every = [(p, n - p) for n in range(highest + 1) for p in range(n + 1)]
    x, y = (x_edges[:-1] + x_edges[1:]) / 2, (y_edges[:-1] + y_edges[1:]) / 2
    pixel = float(x_edges[1] - x_edges[0]), float(y_edges[1] - y_edges[0])
    area = pixel[0] * pixel[1]
    weights = np.stack([np.outer(y**q, x**p).ravel() for p, q in every]) * area
    pixels = density.reshape(len(density), -1)
    raw = batched.matvec(weights, pixels)
    spread = (noise_density * _integrals(every, x_edges, y_edges))[None]
    if photoelectrons:
        read, shot = spread, weights[:, None] * weights / (area * photoelectrons)
        spread = read + _sums(shot, pixels)
        # Where noise makes the light so negative that this is no covariance, light is what is above the black level.
        poor = np.linalg.eigvalsh(spread)[:, 0] <= 0
        spread[poor] = read + _sums(shot, np.maximum(pixels[poor], 0.0))
    if light is not None:
        raw, spread = raw / light[:, None], spread / light[:, None, None] ** 2
    unmix = _without_kernel(every, kernel_moments_2d(kernel, pixel, highest))[[every.index(o) for o in orders]]
    raw[:, 0] = 1.0
    spread[:, 0], spread[:, :, 0] = 0.0, 0.0
    covariance = batched.congruence(unmix, spread)
    return Measurement(
        value=batched.matvec(unmix, raw), covariance=np.broadcast_to(covariance, (len(raw), *covariance.shape[1:]))
    )


def _sums(weights: FloatArray, pixels: FloatArray) -> FloatArray:
    """Sums of pixels with weights (n, n, pixels) for each axis, (axes, pixels) -> (axes, n, n)."""
    n = len(weights)
    return batched.matvec(weights.reshape(n * n, -1), pixels).reshape(-1, n, n)


def _integrals(orders: Sequence[Order], x_edges: FloatArray, y_edges: FloatArray) -> FloatArray:
    """Integral over the field of x^(p + p') y^(q + q') for each two orders."""

    def power(edges: FloatArray, n: int) -> float:
        return float(edges[-1] ** (n + 1) - edges[0] ** (n + 1)) / (n + 1)

    return np.array([[power(x_edges, p + r) * power(y_edges, q + s) for r, s in orders] for p, q in orders])


def _without_kernel(orders: Sequence[Order], kernel: FloatArray) -> FloatArray:
    """Inverse of M_pq = sum_ab binom(p, a) binom(q, b) kernel_ab m_(p-a)(q-b), for orders that hold all lower ones."""
    mixing = np.zeros((len(orders), len(orders)))
    for i, (p, q) in enumerate(orders):
        for j, (r, s) in enumerate(orders):
            if r <= p and s <= q:
                mixing[i, j] = math.comb(p, r) * math.comb(q, s) * kernel[p - r, q - s]
    return np.asarray(np.linalg.inv(mixing))
