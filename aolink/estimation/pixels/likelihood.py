"""The pixels of an exposure as a function of few coefficients, for the estimators that use the blur whole.

A pixel is E[Y | path] = (1/N) sum_k (kernel integrated over it, the spot resting at theta_k) / D, and theta is linear
in the coefficients z = (x(k0), xi) of the exposure. Only as many directions of xi are kept as move the spot visibly:
the first singular vectors of the noise path, until the rest is a tenth of the kernel's standard deviation, rms, and, as
far as twelve coefficients do it, no more than the pixels can hardly see. The directions that are left out keep their
prior and widen the kernel by their variance. If the pixels could resolve them, the estimate would show a false motion
instead. Start states are kept whole.

Pixels see the mean of a path best. Noise that is left out and moves it is taken for another start state, and the end
state, which it moves too, seems less certain than it is. So the direction in which the rest moves the mean is kept as
well, as far as sixteen coefficients do it.

A direction that moves the path far may hardly change the frame, as a vibration with many swings in an exposure does,
and one that moves it less may change the frame much. So where twelve coefficients leave much of the noise visible, the
directions that change the pixels most come first.

The mean over the fast steps is taken by quadrature with few nodes (`aolink.estimation.model.quadrature`).
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from aolink.errors import EstimatorError
from aolink.estimation.compiled.pixels import Pixels
from aolink.estimation.frames.frame_data import Profile, SpotWindows
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model import quadrature
from aolink.estimation.model.base import Dynamics, ExposureModel, InputResponse
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray, Indices
from aolink.optics.camera import effective_noise_density, shot_gain
from aolink.optics.kernel import pixel_masses
from aolink.optics.plane import mehler_series
from aolink.optics.sensor import BaseSensor

# Rms of the noise path that is left out, in standard deviations of the kernel.
_LEFT_OUT = 0.1
# And in standard deviations of the position as measured from the pixels of a spot at rest; for the sake of this there
# are no more coefficients than this, since the cost of an estimate grows with the square of their number.
_SEEN = 2.0
_MOST_SEEN = 12
# Standard deviation of the mean of the noise path that may be left out, in standard deviations of that position; for
# the sake of this there are no more coefficients than the second number. What is left out of the mean is unknown to the
# end state: of a slow drift, whose position many exposures tell, a tenth already makes it too uncertain. A plant that
# moves many spots has many such directions: they are not sought.
_MEAN_LEFT_OUT = 0.1
_MOST_WITH_MEAN = 16
_ONE_SPOT = 2
# Variance that the noise left out may add to the pixels together, in variances of a pixel's noise, where there are as
# many coefficients as `_MOST_SEEN`. Where it adds more, directions are chosen by how much they change the pixels, until
# what is left out adds no more than the second number.
_MOST_VISIBLE, _HARDLY_VISIBLE = 4.0, 0.2
# Random paths from which it is found what changes the pixels.
_FEW_PATHS = 16
# The table of a pixel's light over the spot's position: points in one standard deviation of the kernel, and its end.
_POINTS = 16
_REACH = 5.0
# The most pairs of a point and a pixel in that table, which has some hundreds.
_MOST_LIGHT = 1 << 22
# Reductions and tables that are kept: more than the estimators that a scan of frequencies runs side by side.
_SIDE_BY_SIDE = 256


@dataclass(frozen=True, eq=False)
class Reduction:
    """A few coefficients t instead of z: z = (x, V xi'), t = (x, xi')."""

    expand: FloatArray
    """(n_coefficients, n): z = expand t."""
    left_out: FloatArray
    """Covariance of z that t leaves out, (n_coefficients, n_coefficients)."""
    end_rows: FloatArray
    """End states of t, (n_states, n)."""
    end_remainder: FloatArray
    """Covariance of the end state that t leaves out, (n_states, n_states)."""
    widening: float
    """Mean variance of the part of the path that t leaves out, by which the kernel is widened."""
    resolution: quadrature.Resolution
    least_blur: float
    """Variance with which the pixels show the blur's variance, slope units^4."""

    @property
    def size(self) -> int:
        """n"""
        return int(self.expand.shape[1])

    def prior(self, state: Gaussian) -> Gaussian:
        """The prior of t, from that of the start state; leading axes as they come."""
        return state.with_noise(self.size)

    def coefficients(self, t: Gaussian) -> Gaussian:
        """The Gaussian of z, from that of t, one for each axis."""
        return t.mapped(self.expand, self.left_out)


@lru_cache(maxsize=_SIDE_BY_SIDE)
def reduction(model: ExposureModel, sensor: BaseSensor, *, left_out: float = _LEFT_OUT) -> Reduction:
    """The reduction for a sensor, made once.

    ``left_out`` is the rms of the path that may be left out, in standard deviations of the kernel.
    """
    n = model.plant.n_states
    variance = float(np.linalg.eigvalsh(sensor.kernel.covariance)[0])
    V, rest = _kept(model, sensor, left_out * math.sqrt(variance), math.sqrt(_resting_noise(sensor, variance, 1)))
    size, kept = V.shape
    expand = np.zeros((n + size, n + kept))
    expand[:n, :n], expand[n:, n:] = np.eye(n), V
    hidden = np.zeros((n + size, n + size))
    hidden[n:, n:] = np.eye(size) - V @ V.T
    remainder = model.end_remainder + model.end_rows @ hidden @ model.end_rows.T
    return Reduction(
        expand=expand, left_out=hidden, end_rows=model.end_rows @ expand, end_remainder=remainder,
        widening=rest + model.unmodelled_rest, resolution=quadrature.resolution_of(model, sensor),
        least_blur=_resting_noise(sensor, variance, 2) * 4,
    )  # fmt: skip


def _kept(model: ExposureModel, sensor: BaseSensor, coarse: float, resting_sd: float) -> tuple[FloatArray, float]:
    """The directions of the noise that are kept, (noise coefficients, kept), and the variance of the remaining path.

    The remaining path's rms is at most ``coarse``.
    """
    noise = model.basis[..., model.plant.n_states :]
    outputs, _, size = noise.shape
    if not size:
        return np.zeros((0, 0)), 0.0
    paths, means = noise.reshape(-1, size) / math.sqrt(model.n_steps), noise.mean(axis=1)

    _, values, vectors = np.linalg.svd(paths, full_matrices=False)
    # Each output by itself: a remainder that is spread over many of them is as small on each.
    left = np.append(np.cumsum(values[::-1] ** 2)[::-1], 0.0) / outputs
    most = _MOST_SEEN - model.plant.n_states
    count = int(np.argmax(left <= coarse**2))
    count = max(count, min(int(np.argmax(left <= (_SEEN * resting_sd) ** 2)), most))
    V, rest = vectors[:count].T, float(left[count])
    if outputs <= _ONE_SPOT and rest > (_SEEN * resting_sd) ** 2:
        S = _visibility(model, sensor, noise)
        if np.trace(S) - np.trace(V.T @ S @ V) > _MOST_VISIBLE:
            values, vectors = np.linalg.eigh(S)
            vectors = vectors[:, ::-1]
            visible = np.append(np.cumsum(values)[::-1], 0.0)
            left = np.append(np.cumsum(((paths @ vectors) ** 2).sum(axis=0)[::-1])[::-1], 0.0) / outputs
            count = min(int(np.argmax(visible <= _HARDLY_VISIBLE)), most)
            count = max(count, int(np.argmax(left <= coarse**2)))
            V, rest = vectors[:, :count], float(left[count])
    if outputs <= _ONE_SPOT:
        _, values, vectors = np.linalg.svd(means - means @ V @ V.T, full_matrices=False)
        more = vectors[values > _MEAN_LEFT_OUT * resting_sd][: max(_MOST_WITH_MEAN - model.plant.n_states - count, 0)]
        if len(more):
            V = np.concatenate([V, more.T], axis=1)
            rest = float(np.sum((paths - paths @ V @ V.T) ** 2)) / outputs
    return V, rest


def _visibility(model: ExposureModel, sensor: BaseSensor, noise: FloatArray) -> FloatArray:
    """How much the noise changes the pixels: V' S V is the information that they have on its directions V, if all else
    is known. S is the mean over some of the plant's paths, (noise coefficients, noise coefficients).

    A spot's window on a plane counts by its sums over rows and over columns.
    """
    line = sensor.profile
    every = quadrature.typical_paths(model, _FEW_PATHS).reshape(_FEW_PATHS, len(noise), -1)
    S = np.zeros((noise.shape[-1],) * 2)
    for output, changed in enumerate(noise):
        variance = float(sensor.kernel.covariance[output, output])
        for path in every[:, output]:
            light, slope = (each[0] / line.pixel_size for each in pixel_masses(variance, line.edges, path[None], 1))
            variances = effective_noise_density(line) / line.pixel_size
            variances = variances + shot_gain(line) * np.maximum(light.mean(axis=0), 0.0)
            change = slope.T @ changed / (len(path) * np.sqrt(variances)[:, None])
            S += change.T @ change / _FEW_PATHS
    return S


def _resting_noise(sensor: BaseSensor, variance: float, order: int) -> float:
    """Variance of what is measured from the pixels of a spot at rest (Cramer and Rao's bound): of its position for
    order 1; for order 2 a quarter of that of the variance of its blur, since d/dv = 1/2 d^2/dx^2 of a Gaussian's light.

    By the mean information over positions in a pixel: a spot much narrower than that is seen only at its edges.
    """
    line = sensor.profile
    positions = line.pixel_size * np.linspace(0, 1, _POINTS, endpoint=False)
    masses = [each / line.pixel_size for each in pixel_masses(variance, line.edges, positions, order)]
    noise = effective_noise_density(line) / line.pixel_size + shot_gain(line) * np.maximum(masses[0], 0.0)
    information = float((masses[order] ** 2 / noise).sum(axis=1).mean())
    return 1 / information if information else math.inf


class PixelView:
    """The pixels of one frame as a function of the reduced coefficients t of each axis: prediction and likelihood.

    Points of each axis lie along the second dimension of every argument, (axes, k, ...). ``level`` is that
    of the reduction's resolution.
    """

    def __init__(
        self, sensor: BaseSensor, model: ExposureModel, response: InputResponse, measured: Profile | SpotWindows,
        reduced: Reduction, level: int = 0,
    ) -> None:  # fmt: skip
        self.sensor, self.reduced, self.measured = sensor, reduced, measured
        self.on_line = measured.directions == 1
        """Whether each axis has a row of pixels, which are left to compiled code; spots on a plane are not."""
        self.optics = sensor.profile if self.on_line else sensor
        at = quadrature.quadrature_paths(model, response, reduced.resolution.levels[level])
        self.nodes = replace(at, basis=at.basis @ reduced.expand, widening=0.0)
        """Paths of t at the quadrature's nodes; what t leaves out widens the kernel instead."""
        axes = len(measured.density)
        self.y = measured.density.reshape(axes, -1)
        """Densities of all pixels of an axis, (axes, pixels)."""
        self.mask = measured.mask.reshape(axes, -1)
        self.axes = np.arange(axes)
        """Numbers of these axes of the plant, (axes,)."""
        self.read_noise = effective_noise_density(self.optics) / self.optics.pixel_size
        self.gain = shot_gain(self.optics)
        self.kernel = sensor.kernel.covariance + reduced.widening * np.eye(2)
        """Covariance of the kernel with that widening, slope units squared, (2, 2)."""
        self.dynamics = Dynamics(model.transition, reduced.end_rows, model.path_gram)

    def part(self, axes: slice | Indices) -> PixelView:
        """The part of these axes."""
        view = copy(self)
        view.y, view.mask, view.axes = self.y[axes], self.mask[axes], self.axes[axes]
        view.nodes, view.measured = self.nodes.part(axes), self.measured.part(axes)
        return view

    @property
    def outputs(self) -> int:
        """Outputs of one axis."""
        return int(self.nodes.basis.shape[0])

    @property
    def whole_nodes(self) -> int:
        """Nodes inside the exposure's fast steps; two that correct for where it starts and ends come after them."""
        return len(self.nodes.weights) - (2 if self.nodes.weights.min() < 0 else 0)

    @property
    def kernel_variance(self) -> float:
        """Variance of the kernel in its narrowest direction, slope units squared."""
        return float(np.linalg.eigvalsh(self.kernel)[0])

    @property
    def rows(self) -> FloatArray:
        """Path at the nodes of the coefficients, (n_outputs * nodes, n)."""
        return self.nodes.basis.reshape(-1, self.reduced.size)

    @property
    def gram(self) -> FloatArray:
        """R'R for these rows R, as a mean over the exposure and a sum over outputs, (n, n)."""
        return np.asarray((self.rows * np.tile(self.nodes.weights, self.outputs)[:, None]).T @ self.rows)

    @property
    def moment_nodes(self) -> quadrature.QuadraturePaths:
        """The nodes for windowed moments, which widen the kernel by what t leaves out."""
        return replace(self.nodes, widening=self.reduced.widening)

    def blur_of(self, covariance: FloatArray) -> FloatArray:
        """Variance of the blur's variance, slope units^4, that paths of these covariances of t have, (axes, k, n, n) ->
        (axes, k): 2 tr(G P G P), G being `gram`."""
        GP = self.gram @ covariance
        return np.asarray(2 * np.einsum("...ij,...ji->...", GP, GP))

    @property
    def seen(self) -> Pixels:
        """The frame for compiled code."""
        profile, nodes = self.sensor.profile, self.nodes
        terms = np.ones(1) if self.on_line else np.array(mehler_series(self.kernel))
        across, down = (
            np.stack([_light_table(float(self.kernel[d, d]), profile.pixel_size, j) for j in range(len(terms))])
            for d in (0, 1)
        )
        windows = (len(self.y), self.outputs // 2, profile.pixels, profile.pixels)
        if self.on_line:
            windows, down = (len(self.y), 1, 1, profile.pixels), np.array([[[[1.0], [0.0], [0.0], [0.0]]]])
        return Pixels(
            y=np.ascontiguousarray(self.y).reshape(windows), usable=np.ascontiguousarray(self.mask).reshape(windows),
            inputs=np.ascontiguousarray(nodes.inputs), basis=np.ascontiguousarray(batched.transpose(nodes.basis)),
            weights=np.ascontiguousarray(nodes.weights), across=across, down=down, terms=terms,
            low=float(profile.edges[0]), per_unit=1 / profile.pixel_size, read_noise=self.read_noise, gain=self.gain,
        )  # fmt: skip


@lru_cache(maxsize=_SIDE_BY_SIDE)
def _light_table(variance: float, pixel: float, order: int) -> FloatArray:
    """Taylor coefficients of the densities of pixels about a spot, for points in its own pixel, (points, 4, pixels).

    They are those of powers of its distance from the point, in pixels; of the derivative of this ``order`` by the
    spot's position.
    """
    points = math.ceil(_POINTS * pixel / math.sqrt(variance))
    half = math.ceil(_REACH * math.sqrt(variance) / pixel) + 1
    if points * half > _MOST_LIGHT:
        raise EstimatorError(
            f"a spot is {math.sqrt(variance) / pixel:.3g} pixels wide (sd): check sensor.kernel, sensor.field and the"
            " plant's noise"
        )
    places = (np.arange(points) + 0.5) * pixel / points
    masses = pixel_masses(variance, pixel * np.arange(-half, half + 1.0), places, order + 3)[order:]
    return np.stack([mass * pixel ** (k - 1) / math.factorial(k) for k, mass in enumerate(masses)], axis=1)
