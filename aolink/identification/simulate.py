"""Readings of recordings that a model would make, drawn at random."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from aolink.identification.models import ProcessSum
from aolink.identification.readings import Readings, before
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import psd_root

_POINTS_PER_CYCLE = 12
_FEWEST_POINTS = 24


def simulated(seen: Readings, model: ProcessSum, count: int, seed: int) -> Readings:
    """Readings like ``seen`` with other disturbances and noise: ``count`` draws of each output, draw by draw."""
    random = np.random.default_rng(seed)
    outputs = len(seen.mean)
    points = _points(seen, model)
    stride = seen.n_steps // points
    response = seen.response[:, :, :-1].reshape(outputs, seen.slots, points, stride).mean(axis=3)
    paths = _paths(seen, model, count * outputs, points, random) + np.tile(response, (count, 1, 1))
    mean_noise, square_noise = (np.tile(each, (count, 1)) for each in (seen.mean_noise, seen.square_noise))
    usable = np.tile(seen.usable, (count, 1))
    mean = paths.mean(axis=2) + np.sqrt(mean_noise) * random.standard_normal(mean_noise.shape)
    expected = np.tile(response.mean(axis=2), (count, 1))
    if seen.follows:
        centre = expected + before(mean - expected, usable)
    else:
        centre = expected + np.tile((seen.centre - response.mean(axis=2)).mean(axis=1), count)[:, None]
    square = ((paths - centre[:, :, None]) ** 2).mean(axis=2)
    square += np.sqrt(square_noise) * random.standard_normal(square.shape)
    return replace(
        seen, mean=mean - centre, square=square, mean_noise=mean_noise, square_noise=square_noise, centre=centre,
        usable=usable, response=np.tile(seen.response, (count, 1, 1)), inputs=np.tile(seen.inputs, (count, 1, 1)),
    )  # fmt: skip


def _points(seen: Readings, model: ProcessSum) -> int:
    """Points in an exposure that are drawn: a divisor of its fast steps, enough for the fastest process."""
    fastest = max(float(np.abs(process.poles.imag).max()) for process in model.processes) / (2 * math.pi)
    wanted = max(_FEWEST_POINTS, _POINTS_PER_CYCLE * fastest * seen.n_steps * seen.step_s)
    return next(n for n in range(1, seen.n_steps + 1) if seen.n_steps % n == 0 and (n >= wanted or n == seen.n_steps))


def _paths(seen: Readings, model: ProcessSum, count: int, points: int, random: np.random.Generator) -> FloatArray:
    """Disturbances at the middles of equal parts of the exposures, (count, slots, points)."""
    stride = seen.n_steps // points
    space = model.state_space(stride * seen.step_s)
    x = random.standard_normal((count, len(space.A))) @ psd_root(space.initial_covariance).T
    root, A, C = psd_root(space.W).T, space.A.T, space.C[0]
    gap = seen.period_steps - seen.n_steps
    over_gap = model.state_space(gap * seen.step_s) if gap else None
    out = np.empty((seen.slots, points, count))
    for slot in range(seen.slots):
        w = random.standard_normal((points, count, len(root))) @ root
        for k in range(points):
            out[slot, k] = x @ C
            x = x @ A + w[k]
        if over_gap is not None:
            x = x @ over_gap.A.T + random.standard_normal(x.shape) @ psd_root(over_gap.W).T
    return np.moveaxis(out, 2, 0)
