"""Moments in a window about the spot, used by iterated statistical linearisation.

Line sensors have compiled code for it (`aolink.estimation.moments.lines`); `aolink.estimation.moments.spots` is for
spots on a plane.

A moment, with any window or mask, is a weighted sum of pixels, y = sum_i W_i Y_i D. A
spot resting at theta makes g(theta) = sum_i W_i (kernel integrated over pixel i) of it, so that
E[y | path] = mean_k g(theta_k) holds with kernel, pixels, window and mask all in it: there is no bias to remove.

The prior makes theta_k Gaussian, and under a Gaussian the expectations of g and its derivatives are again
error functions, of a wider kernel. So the linear regression of y on the coefficients is in closed form
(statistical linearisation), and what it leaves out, Omega, too. It is repeated about the posterior, with the
window drawn tighter each time.

Omega depends on the state, which hardly changes from frame to frame on a plant that remembers: its errors
do not average out as independent ones would. It is therefore weighted with (1 + rho)/(1 - rho), as the
variance of a mean of errors that are correlated by rho. Without that, a filter that follows a resonance trusts one of
several phases that the blur cannot distinguish. Where the frames carry little information, the plant correlates the
errors, by the largest eigenvalue of A^N; where they carry much, an error is passed on by A^N (I - K H) only, as far as
that is linear. rho is the geometric mean of both: the first alone wastes the frames' information, the second gives too
small a covariance where several paths explain the blur.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import effective_noise_density
from aolink.optics.kernel import gaussian_below
from aolink.optics.sensor import BaseSensor

PASSES = 3
# Half width of the window beyond the path's mean, in standard deviations of the path, and of the kernel beyond that.
PATH_REACH = 3.0
KERNEL_REACH = 2.0
# The path is averaged over equal parts of the steps so that there are no more than this; a mean over it stays exact.
MOST_NODES = 100
MOST_MEMORY = 1e3
# NIS of moments that are divided by a light that its noise hides: they are gated.
NOT_BELIEVED = 1e12


@dataclass(frozen=True, eq=False)
class Regression:
    """Linear regression of measurements on the coefficients, z being where it was made."""

    expected: FloatArray
    """E[y], (axes, m)."""
    slope: FloatArray
    """H, (axes, m, n_coefficients)."""
    remainder: FloatArray
    """Omega, covariance of what is not linear, (axes, m, m)."""


def weighted_sums(
    sensor: BaseSensor, W: FloatArray, density: FloatArray, light: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Weighted sums of pixels, (..., m), and the covariance of the pixels' noise in them, (..., m, m).

    W is (..., m, pixels). ``density``, (..., pixels), is zero where a pixel cannot be used; its weights are zero as
    well. ``light`` is that of the spot, as a share of a whole one's, that the density was divided by, (...); one where
    None.
    """
    D = sensor.pixel_size
    y = batched.matvec(W, density * D)
    variance = np.full_like(density, effective_noise_density(sensor) * D)
    if sensor.photoelectrons:
        electrons = sensor.photoelectrons if light is None else sensor.photoelectrons / light[..., None]
        variance += np.maximum(density, 0.0) * (D / electrons)
    if light is not None:
        variance /= light[..., None] ** 2
    noise = batched.matmul(W * variance[..., None, :], batched.transpose(W))
    # Where a window has fewer pixels than functions, their sums are linearly dependent; where it has none, all are
    # zero, and say nothing whatever their noise is.
    largest = noise.max(axis=(-2, -1), keepdims=True)
    noise += np.eye(W.shape[-2]) * np.where(largest > 0, 1e-12 * largest, 1.0)
    return y, noise


def expected_response(
    kernel_variance: float, edges: FloatArray, W: FloatArray, mean: FloatArray, variance: FloatArray, highest: int = 3
) -> list[FloatArray]:
    """Expectations of g and its derivatives up to ``highest`` for theta ~ N(mean, variance), (..., nodes), each (...,
    nodes, m); W are weights of the pixels, (..., m, pixels)."""
    # The sum over pixels of W_i times a difference of edges, summed by edges instead.
    padded = np.zeros((*W.shape[:-1], W.shape[-1] + 2))
    padded[..., 1:-1] = W
    steps = batched.transpose(-np.diff(padded, axis=-1))
    below = gaussian_below(kernel_variance + variance, edges, mean, highest)
    return [batched.matmul(each, steps) for each in below]


def slowest(transition: FloatArray) -> FloatArray:
    """Spectral radius: the modulus of the largest eigenvalue, (axes, n, n) -> (axes,)."""
    finite = np.isfinite(transition).all(axis=(1, 2), keepdims=True)
    # What is not finite is refused by the filter; here it must only not stop the others.
    A = np.where(finite, transition, 0.0)
    if A.shape[1] != 2:
        return np.asarray(np.abs(np.linalg.eigvals(A)).max(axis=1))
    half, away = (A[:, 0, 0] + A[:, 1, 1]) / 2, (A[:, 0, 0] - A[:, 1, 1]) / 2
    square = away * away + A[:, 0, 1] * A[:, 1, 0]
    turning = np.sqrt(np.abs(half * half - square))
    return np.asarray(np.where(square < 0, turning, np.abs(half) + np.sqrt(np.abs(square))))


def error_memory(rho: FloatArray, most: float) -> FloatArray:
    """Variance of a mean of errors correlated by rho, over that of independent ones: (1 + rho) / (1 - rho), at most
    ``most``."""
    return np.asarray(np.minimum(most, (1 + rho) / np.maximum(1 - rho, 1e-9)))
