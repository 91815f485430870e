"""Moments in a window about the spot, used by iterated statistical linearisation.

Line sensors have compiled code for it (`aolink.estimation.moments.lines`); the class here is for spots on a plane.

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

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from aolink.estimation.frames.frame_data import Densities
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.kalman.update import joseph_update
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.estimation.model.quadrature import QuadraturePaths, equal_parts, quadrature_paths
from aolink.numerics import batched
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.camera import effective_noise_density
from aolink.optics.kernel import gaussian_below
from aolink.optics.sensor import BaseSensor, Sensor

PASSES = 3
# Half width of the window beyond the path's mean, in standard deviations of the path, and of the kernel beyond that.
PATH_REACH = 3.0
KERNEL_REACH = 2.0
# The path is averaged over equal parts of the steps so that there are no more than this; a mean over it stays exact.
MOST_NODES = 100
MOST_MEMORY = 1e3
# Axes together: more of them do not fit into the processor's cache.
_AT_ONCE = 8

Data = TypeVar("Data", bound=Densities)


@dataclass(frozen=True, eq=False)
class Regression:
    """Linear regression of measurements on the coefficients, z being where it was made."""

    expected: FloatArray
    """E[y], (axes, m)."""
    slope: FloatArray
    """H, (axes, m, n_coefficients)."""
    remainder: FloatArray
    """Omega, covariance of what is not linear, (axes, m, m)."""


class Windowed(ABC, Generic[Data]):
    """Iterated statistical linearisation: the common part for line sensors and spots on a plane."""

    models_noise = True
    most_nodes = MOST_NODES
    most_memory = MOST_MEMORY
    """Bound of `error_memory`; with 1, errors of an exposure count as independent of those before."""

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Data) -> Update:
        """Iterated statistical linearisation, from the prior to the posterior."""
        nodes = quadrature_paths(model, response, equal_parts(model.exposed_steps, self.most_nodes))
        parts = [
            self._update(model, nodes.part(s), prior.part(s), measured.part(s))
            for s in (slice(k, k + _AT_ONCE) for k in range(0, len(prior.mean), _AT_ONCE))
        ]
        if len(parts) == 1:
            return parts[0]
        joined = [np.concatenate(arrays) for arrays in zip(*(_arrays(part) for part in parts), strict=True)]
        return Update(Gaussian(joined[0], joined[1]), *joined[2:])

    def _update(self, model: ExposureModel, nodes: QuadraturePaths, prior: Gaussian, measured: Data) -> Update:
        about, rho = prior, np.full(len(prior.mean), slowest(model.transition[None])[0])
        memory = error_memory(rho, self.most_memory)
        for to_come in reversed(range(PASSES)):
            y, noise, fit = self.look(nodes, about, measured)
            innovation = y - fit.expected - batched.matvec(fit.slope, prior.mean - about.mean)
            R = noise + memory[:, None, None] * fit.remainder
            done = joseph_update(prior, innovation, fit.slope, R)
            about = done.posterior
            if to_come:
                rho_here = np.sqrt(rho * slowest(_closed_loop(model, prior, fit.slope, R)))
                memory = error_memory(rho_here, self.most_memory)
        # The covariance of this one innovation is without the memory.
        HP = batched.matmul(fit.slope, prior.covariance)
        S = batched.symmetric(batched.matmul(HP, batched.transpose(fit.slope)) + noise + fit.remainder)
        nis = batched.dot(innovation, batched.matvec(batched.inverse(S), innovation))
        return Update(about, innovation, S, nis)

    @abstractmethod
    def look(
        self, nodes: QuadraturePaths, about: Gaussian, measured: Data
    ) -> tuple[FloatArray, FloatArray, Regression]:
        """The sums (axes, sums), their noise (axes, sums, sums), and their regression on the coefficients."""

    def window(
        self, sensor: Sensor, kernel: float, mean: FloatArray, variance: FloatArray, mask: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """u in [-1, 1] across the window about a path, and the pixels that are in it, both (axes, pixels).

        ``kernel`` is the variance of the kernel in this direction, slope units squared; mean and variance are those of
        the path at its nodes, (axes, nodes); ``mask``, (axes, pixels), is True where a pixel can be used.
        """
        sd = np.sqrt(np.maximum(variance, 0.0))
        margin = KERNEL_REACH * math.sqrt(kernel + sensor.pixel_width**2 / 12)
        # A window needs room on the sensor, wherever the path is expected.
        room = max(margin, 2 * sensor.pixel_width)
        low = np.minimum((mean - PATH_REACH * sd).min(axis=1) - margin, sensor.field[1] - room)
        high = np.maximum((mean + PATH_REACH * sd).max(axis=1) + margin, sensor.field[0] + room)
        low, high = np.maximum(low, sensor.field[0]), np.minimum(high, sensor.field[1])
        edges = sensor.edges
        inside = (edges[1:] > low[:, None]) & (edges[:-1] < high[:, None]) & mask
        return (sensor.centres - (low + high)[:, None] / 2) / ((high - low)[:, None] / 2), inside


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


def _arrays(correction: Update) -> tuple[FloatArray, ...]:
    after = correction.posterior
    rest = correction.innovation, correction.innovation_covariance, correction.nis
    return (after.mean, after.covariance, *rest)


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


def _closed_loop(model: ExposureModel, prior: Gaussian, H: FloatArray, R: FloatArray) -> FloatArray:
    """How an error of the start state goes on to the next exposure's, A (I - K H), (axes, n_states, n_states)."""
    n = len(model.transition)
    PH = batched.matmul(prior.covariance, batched.transpose(H))
    K = batched.matmul(PH, batched.inverse(batched.symmetric(batched.matmul(H, PH)) + R))
    kept = np.eye(prior.mean.shape[1])[:, :n] - batched.matmul(K, H[:, :, :n])
    return batched.matmul(np.broadcast_to(model.end_rows, (len(kept), *model.end_rows.shape)), kept)
