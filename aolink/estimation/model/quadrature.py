"""Quadrature in time: a few nodes with weights instead of an exposure's fast steps.

Blur is a mean over the steps, and paths are smooth, so a weighted mean over a few nodes is enough. For a spot that
moves little, the nodes are those of Gauss's quadrature for a sum over equal steps, exact for polynomials in time of
degree 2 n - 1 (zeros of Gram's polynomials: Golub & Welsch, Calculation of Gauss quadrature rules, Math. Comp. 23
(1969)); between two steps the path is a straight line. For a spot that goes back and forth, the nodes are means over
equal parts of the steps. There are enough nodes for the light of the plant's typical paths to be right to a share of
the camera's noise; and more for an axis whose predicted path moves further between two nodes than a spot is wide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.estimation.model.exposure_model import exposure_model
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray, Indices
from aolink.numerics.covariance import psd_root
from aolink.optics.camera import effective_noise_density, shot_gain
from aolink.optics.kernel import gaussian_below
from aolink.optics.sensor import BaseSensor, Sensor

# Largest rms difference between the light of a path at the nodes and at all steps, in standard deviations of noise.
_WRONG = 0.05
_LEAST = 3
# For a spot that swings by ten widths of the kernel, more nodes than these bring the path no nearer to that of all
# steps.
_MOST = 100
# Paths whose light differs from the mean by less than this are not used to choose the number of nodes.
_LEAST_LIGHT = 0.01
# Longest way of the predicted path from node to node, in standard deviations of kernel and pixel: a mean over Gaussians
# at such distances has hardly any ripple, exp(-2 pi^2 / 1.2^2).
_STRIDE = 1.2
# Random paths from which the number of nodes is found.
_PATHS = 64
# Resolutions that are kept: more than the estimators that a scan of frequencies runs side by side.
_SIDE_BY_SIDE = 256


@dataclass(frozen=True, eq=False)
class QuadratureRule:
    """Nodes in time as means over fast steps, and their weights."""

    rows: FloatArray
    """Weights of the steps in each node, (nodes, n_steps)."""
    weights: FloatArray
    """(nodes,), one in sum."""

    def at(self, steps: FloatArray) -> FloatArray:
        """Values at the nodes from values at all steps, along the last axis."""
        return batched.long_matmul(steps.reshape(-1, 1, steps.shape[-1]), self.rows.T).reshape(*steps.shape[:-1], -1)


@lru_cache(maxsize=64)
def equal_parts(n_steps: int, most: int) -> QuadratureRule:
    """Means over equal parts of the steps, no more than ``most`` of them; the last may be shorter."""
    length = -(-n_steps // most)
    first = np.arange(0, n_steps, length)
    sizes = np.diff(np.append(first, n_steps))
    rows = np.zeros((len(first), n_steps))
    rows[np.repeat(np.arange(len(first)), sizes), np.arange(n_steps)] = np.repeat(1 / sizes, sizes)
    return QuadratureRule(rows, sizes / n_steps)


@lru_cache(maxsize=64)
def gauss(n_steps: int, count: int) -> QuadratureRule:
    """Gauss's quadrature for a sum over equal steps, with ``count`` nodes, fewer than steps."""
    k = np.arange(1, count)
    beside = np.sqrt(k**2 * (n_steps**2 - k**2) / (4 * (4 * k**2 - 1.0)))
    values, vectors = np.linalg.eigh(np.diag(beside, 1) + np.diag(beside, -1))
    # In pairs about the middle: a path and its reversal are alike.
    place = (n_steps - 1) / 2 + (values - values[::-1]) / 2
    before = np.clip(place.astype(np.intp), 0, n_steps - 2)
    rows = np.zeros((count, n_steps))
    rows[np.arange(count), before], rows[np.arange(count), before + 1] = before + 1 - place, place - before
    share = vectors[0] ** 2
    return QuadratureRule(rows, (share + share[::-1]) / 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class QuadraturePaths:
    """Paths at the nodes of an exposure."""

    basis: FloatArray
    """The exposure basis there, (n_outputs, nodes, n_coefficients)."""
    weights: FloatArray
    """Each node's share of the exposure, (nodes,)."""
    inputs: FloatArray
    """The response to the inputs, (axes, n_outputs, nodes)."""
    widening: float = 0.0
    """Variance of the slopes about each node that no coefficient has, slope units squared."""

    def part(self, axes: slice | Indices) -> QuadraturePaths:
        """The part of these axes."""
        return replace(self, inputs=self.inputs[axes])


def quadrature_paths(model: ExposureModel, response: InputResponse, q: QuadratureRule) -> QuadraturePaths:
    """An exposure at its nodes, and at two more where it starts between two steps."""
    seen = model.seen(model.basis)
    basis, weights = np.ascontiguousarray(q.at(seen.swapaxes(1, 2)).swapaxes(1, 2)), q.weights
    inputs = q.at(model.seen_path(response.path))
    if model.moved:
        # This share of the exposure is not in its first step but in the one after its last.
        ends = (model.basis[:, 0], model.rows_after)
        late = (response.path[:, :, 0], model.last_response(response.end))
        basis = np.concatenate([basis, np.stack(ends, axis=1)], axis=1)
        weights = np.append(weights, [-model.moved, model.moved])
        inputs = np.concatenate([inputs, np.stack(late, axis=2)], axis=2)
    return QuadraturePaths(basis=basis, weights=weights, inputs=inputs, widening=model.unmodelled_rest)


@dataclass(frozen=True, eq=False)
class Resolution:
    """Quadrature rules for an exposure, and the choice among them: the more a path moves, the more nodes it needs."""

    levels: tuple[QuadratureRule, ...]
    """From the rule for typical paths of the plant at rest up to all steps."""
    stride: float
    """Longest distance that a path may move from node to node, slope units."""

    def of(self, path: FloatArray) -> Indices:
        """The level of each axis for its predicted path, (axes, n_outputs, n_steps) -> (axes,)."""
        level = np.zeros(len(path), dtype=np.intp)
        far = np.arange(len(path))
        for k, q in enumerate(self.levels[:-1]):
            at = q.at(path[far])
            far = far[np.abs(np.diff(at, axis=-1)).reshape(len(far), -1).max(axis=1, initial=0.0) > self.stride]
            level[far] = k + 1
            if not len(far):
                break
        return level


def resolution(paths: FloatArray, variance: float, sensor: Sensor) -> Resolution:
    """The coarsest resolution whose error in a spot's light stays below a share of the pixels' noise.

    ``paths``, (paths, n_steps), are typical ones of the plant at rest, of one spot each; ``variance`` is that of the
    kernel, slope units squared.
    """
    n_steps = paths.shape[1]
    paths = paths - paths.mean(axis=1, keepdims=True)
    edges = sensor.edges - sensor.edges.mean()

    def light(q: QuadratureRule) -> FloatArray:
        left: FloatArray = np.zeros((len(paths), len(edges)))
        for w, place in zip(q.weights, q.at(paths).T, strict=True):
            left += w * gaussian_below(variance, edges, place)[0]
        return np.diff(left, axis=1) / sensor.pixel_width

    right = light(equal_parts(n_steps, n_steps))
    noise = effective_noise_density(sensor) / sensor.pixel_size + shot_gain(sensor) * np.maximum(right, 0.0)
    seen = float(right.sum()) * sensor.pixel_width

    def enough(q: QuadratureRule) -> bool:
        return float(((light(q) - right) ** 2 / noise).sum()) <= _WRONG**2 * seen

    count, found = _LEAST, equal_parts(n_steps, _MOST)
    while count < min(n_steps, _MOST) and seen > _LEAST_LIGHT * len(paths):
        tried = next((q for q in (gauss(n_steps, count), equal_parts(n_steps, count)) if enough(q)), None)
        if tried is not None:
            found = tried
            break
        count += max(1, count // 6)
    levels = [found]
    while len(levels[-1].weights) < n_steps:
        levels.append(equal_parts(n_steps, min(n_steps, 2 * max(len(levels[-1].weights), 8))))
    return Resolution(tuple(levels), _STRIDE * math.sqrt(variance + sensor.pixel_width**2 / 12))


@lru_cache(maxsize=_SIDE_BY_SIDE)
def resolution_of(model: ExposureModel, sensor: BaseSensor) -> Resolution:
    """The resolution for a plant's typical paths before a sensor, made once."""
    if model.moved:  # it is the same whenever in a step an exposure starts
        return resolution_of(exposure_model(model.plant, model.n_steps), sensor)
    variance = float(np.linalg.eigvalsh(sensor.kernel.covariance)[0])
    return resolution(typical_paths(model, _PATHS), variance, sensor.profile)


def typical_paths(model: ExposureModel, count: int) -> FloatArray:
    """Random paths of the outputs by the plant's prior, (count * n_outputs, exposed_steps)."""
    basis = model.seen(model.basis)
    z, n = np.random.default_rng(0).standard_normal((count, basis.shape[-1])), model.plant.n_states
    z[:, :n] = z[:, :n] @ psd_root(model.plant.initial_covariance).T
    return np.asarray(np.tensordot(z, basis, axes=(1, 2))).reshape(-1, model.exposed_steps)


def paths_for(model: ExposureModel, sensor: BaseSensor, mean: FloatArray, response: InputResponse) -> QuadraturePaths:
    """An exposure at the nodes that paths about the predicted ones need; ``mean`` is that of the first coefficients,
    (axes, any)."""
    seen = resolution_of(model, sensor)
    level = seen.of(model.seen_path(model.path(mean, response.path))).max(initial=0)
    return quadrature_paths(model, response, seen.levels[int(level)])
