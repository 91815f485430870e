"""Moments in a window about the spot, with what noise and motion inside the exposure do to them.

A moment, in any basis and with any window or mask, is a weighted sum of pixels, y = sum_i W_i Y_i D. A
spot resting at theta makes g(theta) = sum_i W_i (kernel integrated over pixel i) of it, so that
E[y | path] = mean_k g(theta_k) holds with kernel, pixels, window and mask all in it: there is no bias to remove.

The prior makes theta_k Gaussian, and under a Gaussian the expectations of g and its derivatives are again
error functions, of a wider kernel. So the linear regression of y on the coefficients is in closed form
(statistical linearisation), and what it leaves out, Omega, too. It is repeated about the posterior, with the
window drawn tighter each time.

Omega depends on the state, which hardly changes from frame to frame on a plant that remembers: its errors
do not average out as independent ones would. It is therefore weighted with (1 + rho)/(1 - rho), rho the
largest eigenvalue of A^N, as the variance of a mean of errors that are correlated by rho. Without that, a
filter that follows a resonance believes in one of several phases that the blur cannot tell apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from aolink.estimation import stacked
from aolink.estimation.exposure_model import ExposureModel, InputResponse
from aolink.estimation.moments import LEAST_FLUX, Flux
from aolink.estimation.observation import Belief, Correction, corrected
from aolink.optics.camera import effective_noise_density
from aolink.rig import Sensor

FloatArray = NDArray[np.float64]
Basis = Literal["monomial", "legendre", "fourier"]

_PASSES = 3
# Half width of the window beyond the path's mean, in standard deviations of the path, and of the kernel beyond that.
_PATH_REACH = 3.0
_KERNEL_REACH = 2.0
# The path is averaged over blocks of steps so that there are no more than this; a mean over it stays exact.
_MOST_NODES = 100
_MOST_MEMORY = 1e3
# Axes together: more of them do not fit into the processor's cache.
_AT_ONCE = 8
# NIS of a ratio to light that is lost in its noise.
_NOT_BELIEVED = 1e12


@dataclass(frozen=True, kw_only=True, eq=False)
class Profile:
    """Densities of one row of pixels for each axis."""

    density: FloatArray
    """One over slope units, (axes, pixels)."""
    mask: NDArray[np.bool_]
    """True where the pixel can be used, (axes, pixels)."""
    usable: NDArray[np.bool_] | None = None
    """False for axes of which nothing was measured, (axes,); None if there are none."""


@dataclass(frozen=True, eq=False)
class Regression:
    """Linear regression of measurements on the coefficients, z being where it was made."""

    expected: FloatArray
    """E[y], (axes, m)."""
    slope: FloatArray
    """H, (axes, m, n_coefficients)."""
    remainder: FloatArray
    """Omega, covariance of what is not linear, (axes, m, m)."""


class WindowedMoments:
    """Windowed moments of line-sensor profiles, one output for each axis.

    Parameters
    ----------
    orders:
        Which functions of the basis; 0 is the light in the window.
    basis:
        Of u in [-1, 1] across the window: "monomial" u^p, "legendre" P_p(u), or "fourier", where
        orders 2q - 1 and 2q are sin(pi q u) and cos(pi q u).
    flux:
        "known": the light of a frame sums to one; "measured": all is divided by the light in the window
        (order 0 is left out).
    """

    models_noise = True

    def __init__(
        self, sensor: Sensor, orders: Sequence[int] = (0, 1, 2, 3), *, basis: Basis = "monomial",
        flux: Flux = "known",
    ) -> None:  # fmt: skip
        self.sensor, self.basis, self.flux = sensor, basis, flux
        # A ratio to the light in the window needs the light first.
        self.orders = tuple(orders) if flux == "known" else (0, *(p for p in orders if p))
        self.n_measurements = len(self.orders) - (flux == "measured")

    def correct(self, model: ExposureModel, response: InputResponse, prior: Belief, measured: Profile) -> Correction:
        """Iterated statistical linearisation, from the prior to the posterior."""
        first, basis, weights = _nodes(model)
        inputs = np.add.reduceat(response.path[:, 0], first, axis=1) / (weights * model.n_steps)
        parts = [
            self._correct(
                model,
                (basis, weights, inputs[s]),
                Belief(prior.mean[s], prior.covariance[s]),
                Profile(density=measured.density[s], mask=measured.mask[s]),
            )
            for s in (slice(k, k + _AT_ONCE) for k in range(0, len(inputs), _AT_ONCE))
        ]
        if len(parts) == 1:
            return parts[0]
        joined = [np.concatenate(arrays) for arrays in zip(*(_arrays(part) for part in parts), strict=True)]
        return Correction(Belief(joined[0], joined[1]), *joined[2:])

    def _correct(
        self, model: ExposureModel, nodes: tuple[FloatArray, FloatArray, FloatArray], prior: Belief, measured: Profile
    ) -> Correction:
        basis, weights, inputs = nodes
        memory = _memory(model)
        about = prior
        for _ in range(_PASSES):
            mean = stacked.matvec(basis, about.mean) + inputs
            spread = stacked.congruence(basis, about.covariance)
            W = self.window_weights(mean, np.einsum("akk->ak", spread), measured.mask)
            fit = self.regression(W, mean, spread, basis, weights)
            y, noise = self.measured(W, measured.density, fit)
            light = y[:, 0] / np.sqrt(noise[:, 0, 0])
            if self.flux == "measured":
                y, noise, fit = _ratios(y, noise, fit)
            innovation = y - fit.expected - stacked.matvec(fit.slope, prior.mean - about.mean)
            done = corrected(prior, innovation, fit.slope, noise + memory * fit.remainder)
            about = done.posterior
        # The spread to expect of this one innovation is without the memory.
        HP = stacked.matmul(fit.slope, prior.covariance)
        S = stacked.symmetric(stacked.matmul(HP, stacked.transpose(fit.slope)) + noise + fit.remainder)
        nis = stacked.dot(innovation, stacked.matvec(stacked.inverse(S), innovation))
        if self.flux == "measured":
            nis = np.where(light < LEAST_FLUX, _NOT_BELIEVED, nis)
        return Correction(about, innovation, S, nis)

    def window_weights(self, mean: FloatArray, variance: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
        """Weights of the pixels about a path, (axes, m, pixels), from its mean and variance, both (axes, nodes)."""
        sensor = self.sensor
        sd = np.sqrt(np.maximum(variance, 0.0))
        margin = _KERNEL_REACH * math.sqrt(sensor.kernel.variance + sensor.pixel_width**2 / 12)
        # A window needs room on the sensor, wherever the path is believed to be.
        room = max(margin, 2 * sensor.pixel_width)
        low = np.minimum((mean - _PATH_REACH * sd).min(axis=1) - margin, sensor.field[1] - room)
        high = np.maximum((mean + _PATH_REACH * sd).max(axis=1) + margin, sensor.field[0] + room)
        low, high = np.maximum(low, sensor.field[0]), np.minimum(high, sensor.field[1])
        edges = sensor.edges
        inside = (edges[1:] > low[:, None]) & (edges[:-1] < high[:, None]) & mask
        u = (sensor.centres - (low + high)[:, None] / 2) / ((high - low)[:, None] / 2)
        return np.stack([self._function(p, u) * inside for p in self.orders], axis=1)

    def _function(self, order: int, u: FloatArray) -> FloatArray:
        if self.basis == "fourier":
            turn = np.pi * ((order + 1) // 2) * u
            return np.asarray(np.sin(turn) if order % 2 else np.cos(turn))
        if self.basis == "monomial":
            return np.asarray(u**order)
        return np.asarray(np.polynomial.legendre.legval(u, np.eye(order + 1)[order]))

    def regression(
        self, W: FloatArray, mean: FloatArray, spread: FloatArray, basis: FloatArray, weights: FloatArray
    ) -> Regression:
        """Regression of the weighted sums on the coefficients.

        Parameters
        ----------
        W:
            (axes, m, pixels)
        mean, spread:
            Of the path at its nodes, (axes, nodes) and (axes, nodes, nodes).
        basis, weights:
            Rows of the exposure basis at the nodes, (nodes, n_coefficients), and the nodes' weights, (nodes,).
        """
        variance = np.maximum(np.einsum("akk->ak", spread), 0.0)
        g = _expected_response(self.sensor, W, mean, variance)
        light = weights[:, None]
        # Mehler: Cov(g(a), g(b)) is the sum over j of C^j / j! times the means of the j-th derivatives.
        square = spread * spread
        remainder = sum(
            stacked.matmul(stacked.transpose(light * g[j]), stacked.matmul(power, light * g[j]))
            for j, power in ((2, square / 2), (3, square * spread / 6))
        )
        slope = stacked.matmul(stacked.transpose(light * g[1]), np.broadcast_to(basis, (len(W), *basis.shape)))
        return Regression((light * g[0]).sum(axis=1), slope, stacked.symmetric(np.asarray(remainder)))

    def measured(self, W: FloatArray, density: FloatArray, fit: Regression) -> tuple[FloatArray, FloatArray]:
        """The weighted sums, (axes, m), and the covariance of their pixels' noise, (axes, m, m)."""
        D = self.sensor.pixel_width
        y = stacked.matvec(W, density * D)
        variance = np.full_like(density, effective_noise_density(self.sensor) * D)
        if self.sensor.photoelectrons:
            variance += np.maximum(density, 0.0) * (D / self.sensor.photoelectrons)
        noise = stacked.matmul(W * variance[:, None], stacked.transpose(W))
        # Where a window has too few pixels for its functions, their sums hang together.
        noise += 1e-12 * np.eye(len(self.orders)) * noise.max(axis=(1, 2), keepdims=True)
        return y, noise


def _expected_response(sensor: Sensor, W: FloatArray, mean: FloatArray, variance: FloatArray) -> list[FloatArray]:
    """E[g], E[g'], E[g''], E[g'''] for theta ~ N(mean, variance), each (axes, nodes, m)."""
    width = np.sqrt(sensor.kernel.sigma**2 + 2 * variance)[..., None]
    u = (sensor.edges - mean[..., None]) / width
    bell = np.exp(-u * u) / (math.sqrt(math.pi) * width)
    # The sum over pixels of W_i times a difference of edges, summed by edges instead.
    padded = np.concatenate([np.zeros((*W.shape[:2], 1)), W, np.zeros((*W.shape[:2], 1))], axis=2)
    steps = stacked.transpose(-np.diff(padded, axis=2))
    derivatives = (erf(u) / 2, -bell, -2 * u / width * bell, -(4 * u * u - 2) / width**2 * bell)
    return [stacked.matmul(d, steps) for d in derivatives]


def _nodes(model: ExposureModel) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """First steps of the path's blocks, the basis' mean over each, and each block's share of the exposure."""
    length = -(-model.n_steps // _MOST_NODES)
    first = np.arange(0, model.n_steps, length)
    sizes = np.diff(np.append(first, model.n_steps))
    return first, np.add.reduceat(model.basis[0], first, axis=0) / sizes[:, None], sizes / model.n_steps


def _arrays(correction: Correction) -> tuple[FloatArray, ...]:
    after = correction.posterior
    rest = correction.innovation, correction.innovation_covariance, correction.nis
    return (after.mean, after.covariance, *rest)


def _memory(model: ExposureModel) -> float:
    rho = float(np.abs(np.linalg.eigvals(model.transition)).max())
    return min(_MOST_MEMORY, (1 + rho) / max(1 - rho, 1e-9))


def _ratios(y: FloatArray, noise: FloatArray, fit: Regression) -> tuple[FloatArray, FloatArray, Regression]:
    """Everything divided by the first measurement, the light, to first order."""
    ratio, expected = y[:, 1:] / y[:, :1], fit.expected[:, 1:] / fit.expected[:, :1]

    def derivative(values: FloatArray, light: FloatArray) -> FloatArray:
        eye = np.broadcast_to(np.eye(values.shape[1]), (len(values), values.shape[1], values.shape[1]))
        return np.concatenate([-values[..., None], eye], axis=2) / light[:, :, None]

    J = derivative(expected, fit.expected[:, :1])
    noise = stacked.congruence(derivative(ratio, y[:, :1]), noise)
    return ratio, noise, Regression(expected, stacked.matmul(J, fit.slope), stacked.congruence(J, fit.remainder))
