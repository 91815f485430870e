"""Few points in time in the place of an exposure's fast steps.

Blur is a mean over the steps, and paths are smooth: so it is a mean over few nodes as well. Of a spot that moves little
these are the nodes of Gauss's quadrature for a sum over equal steps, exact for polynomials in time of degree 2 n - 1
(zeros of Gram's polynomials: Golub & Welsch, Calculation of Gauss quadrature rules, Math. Comp. 23 (1969)), between two
steps on a straight line. Of one that goes back and forth they are means over equal blocks of steps. As many are taken
as show the light of paths like the plant's as right as the noise of the camera asks for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from aolink.estimation import stacked
from aolink.estimation.exposure_model import ExposureModel, InputResponse
from aolink.optics.camera import effective_noise_density, shot_gain
from aolink.rig import Sensor

FloatArray = NDArray[np.float64]

# The light of a path at the nodes differs from that at all steps by so many standard deviations of noise, rms.
_WRONG = 0.03
_LEAST = 3
# More than these bring the path no nearer to what all steps say, of a spot that swings by ten widths of the kernel.
_MOST = 100


@dataclass(frozen=True, eq=False)
class Quadrature:
    """What the nodes are of the steps, and what each counts."""

    rows: FloatArray
    """(nodes, n_steps)"""
    weights: FloatArray
    """(nodes,), one in sum."""

    def at(self, steps: FloatArray) -> FloatArray:
        """At the nodes, what is known at all steps, along the last axis."""
        return stacked.long_matmul(steps.reshape(-1, 1, steps.shape[-1]), self.rows.T).reshape(*steps.shape[:-1], -1)


@lru_cache(maxsize=64)
def blocks(n_steps: int, most: int) -> Quadrature:
    """Means over equal blocks, no more than ``most`` of them; the last may be shorter."""
    length = -(-n_steps // most)
    first = np.arange(0, n_steps, length)
    sizes = np.diff(np.append(first, n_steps))
    rows = np.zeros((len(first), n_steps))
    rows[np.repeat(np.arange(len(first)), sizes), np.arange(n_steps)] = np.repeat(1 / sizes, sizes)
    return Quadrature(rows, sizes / n_steps)


@lru_cache(maxsize=64)
def gauss(n_steps: int, count: int) -> Quadrature:
    """Gauss's, of fewer nodes than steps."""
    k = np.arange(1, count)
    beside = np.sqrt(k**2 * (n_steps**2 - k**2) / (4 * (4 * k**2 - 1.0)))
    values, vectors = np.linalg.eigh(np.diag(beside, 1) + np.diag(beside, -1))
    # In pairs about the middle: a path and its reversal are alike.
    place = (n_steps - 1) / 2 + (values - values[::-1]) / 2
    before = np.clip(place.astype(np.intp), 0, n_steps - 2)
    rows = np.zeros((count, n_steps))
    rows[np.arange(count), before], rows[np.arange(count), before + 1] = before + 1 - place, place - before
    share = vectors[0] ** 2
    return Quadrature(rows, (share + share[::-1]) / 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Nodes:
    """Paths at the nodes of an exposure."""

    basis: FloatArray
    """The exposure basis there, (n_outputs, nodes, n_coefficients)."""
    weights: FloatArray
    """Each node's share of the exposure, (nodes,)."""
    inputs: FloatArray
    """The response to the inputs, (axes, n_outputs, nodes)."""

    def part(self, axes: slice) -> Nodes:
        """Of these axes alone."""
        return Nodes(basis=self.basis, weights=self.weights, inputs=self.inputs[axes])


def nodes_of(model: ExposureModel, response: InputResponse, q: Quadrature) -> Nodes:
    """An exposure at its nodes, and at two more where it starts between two steps."""
    basis, weights = np.ascontiguousarray(q.at(model.basis.swapaxes(1, 2)).swapaxes(1, 2)), q.weights
    inputs = q.at(response.path)
    if model.moved:
        # So much of the first step is not in the exposure, but in the step after its last.
        ends = (model.basis[:, 0], model.plant.C @ model.end_rows)
        late = (response.path[:, :, 0], model.last_response(response.end))
        basis = np.concatenate([basis, np.stack(ends, axis=1)], axis=1)
        weights = np.append(weights, [-model.moved, model.moved])
        inputs = np.concatenate([inputs, np.stack(late, axis=2)], axis=2)
    return Nodes(basis=basis, weights=weights, inputs=inputs)


@dataclass(frozen=True, eq=False)
class Resolution:
    """How finely the time of an exposure is to be looked at."""

    quadrature: Quadrature
    mean: float
    """By how much the mean of a path may be wrong, slope units."""
    square: float
    """And its mean square, slope units squared."""

    def with_inputs(self, path: FloatArray) -> Quadrature:
        """Of paths that inputs move, too, (axes, n_outputs, n_steps): finer where so few nodes do not show that."""
        if not path.any():
            return self.quadrature
        n_steps = path.shape[-1]
        # Where on the camera they are does not matter.
        path = path - path[..., :1]
        mean, square = stacked.mean_over_path(path), stacked.mean_over_path(path * path)
        q = self.quadrature
        while len(q.weights) < n_steps:
            at = q.at(path)
            wrong = np.abs(at @ q.weights - mean)
            if wrong.max() <= self.mean and np.abs((at * at) @ q.weights - square).max() <= self.square:
                break
            q = blocks(n_steps, min(n_steps, 2 * max(len(q.weights), 8)))
        return q


def resolution(paths: FloatArray, variance: float, sensor: Sensor) -> Resolution:
    """The coarsest that shows a spot's light as right as the noise of the pixels asks for.

    Parameters
    ----------
    paths:
        Like the plant's, of one spot each, (paths, n_steps).
    variance:
        Of the kernel, slope units squared.
    sensor:
        Pixels and their noise.
    """
    n_steps = paths.shape[1]
    paths = paths - paths.mean(axis=1, keepdims=True)
    edges = (sensor.edges - sensor.edges.mean()) / math.sqrt(2 * variance)

    def light(q: Quadrature) -> FloatArray:
        left: FloatArray = np.zeros((len(paths), len(edges)))
        for w, place in zip(q.weights, q.at(paths).T / math.sqrt(2 * variance), strict=True):
            left += w / 2 * erf(edges - place[:, None])
        return np.diff(left, axis=1) / sensor.pixel_width

    every = blocks(n_steps, n_steps)
    right = light(every)
    noise = effective_noise_density(sensor) / sensor.pixel_size + shot_gain(sensor) * np.maximum(right, 0.0)

    def enough(q: Quadrature) -> bool:
        return float(((light(q) - right) ** 2 / noise).sum()) <= _WRONG**2 * len(paths)

    count, found = _LEAST, blocks(n_steps, _MOST)
    while count < min(n_steps, _MOST):
        tried = next((q for q in (gauss(n_steps, count), blocks(n_steps, count)) if enough(q)), None)
        if tried is not None:
            found = tried
            break
        count += max(1, count // 8)
    # A spot that rests: what a shift of it changes, and what a spread of it, in standard deviations of noise.
    bell = np.exp(-edges * edges) / math.sqrt(2 * math.pi * variance)
    quiet = noise.min()
    shift = np.diff(bell) / sensor.pixel_width
    wider = np.diff(edges * bell) / math.sqrt(2 * variance) / sensor.pixel_width
    by_shift, by_spread = (math.sqrt(float((each**2).sum() / quiet)) for each in (shift, wider))
    return Resolution(found, _WRONG / by_shift, _WRONG / by_spread)
