"""Windowed moments of line sensors: the module `windowed` says what is computed, compiled code does it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from aolink.estimation.compiled.windowed import Fits, Lines, linearise, noise_spread
from aolink.estimation.frames.frame_data import HALF, Needs, Profile
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.estimation.model.quadrature import QuadraturePaths, equal_parts, quadrature_paths
from aolink.estimation.moments.windowed import (
    KERNEL_REACH,
    MOST_MEMORY,
    MOST_NODES,
    PASSES,
    PATH_REACH,
    error_memory,
    slowest,
)
from aolink.numerics.arrays import FloatArray
from aolink.numerics.workers import in_threads, thread_count
from aolink.optics.camera import effective_noise_density
from aolink.optics.sensor import Sensor

ORDERS = (0, 1, 2, 3)
"""Of the moments; 0 is the light in the window."""
# With fewer axes a second thread costs more than it saves.
_AXES_OF_A_THREAD = 16


class WindowedMoments:
    """Windowed moments of line-sensor profiles, of the `ORDERS`, one output for each axis."""

    models_noise = True
    n_measurements = len(ORDERS)
    needs = Needs(what="profile", least_usable=HALF)

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Profile) -> Update:
        """Iterated statistical linearisation, from the prior to the posterior."""
        nodes = quadrature_paths(model, response, equal_parts(model.exposed_steps, MOST_NODES))
        axes, n_states = len(prior.mean), len(model.transition)
        lines = _lines(self.sensor, nodes, measured, n_states, model.end_rows)
        mean, covariance = _contiguous(prior.mean), _contiguous(prior.covariance)
        fits = _no_fits(prior, self.n_measurements, n_states)
        rho = slowest(model.transition[None])

        def update(some: slice) -> None:
            frames = lines._replace(
                density=lines.density[some], usable=lines.usable[some], light=lines.light[some],
                inputs=lines.inputs[some],
            )  # fmt: skip
            here = Fits(*(each[some] for each in fits))
            memory = np.full(len(here.nis), error_memory(rho, MOST_MEMORY)[0])
            for to_come in reversed(range(PASSES)):
                linearise(frames, mean[some], covariance[some], memory, PATH_REACH, KERNEL_REACH, not to_come, here)
                if to_come:
                    memory = error_memory(np.sqrt(rho * slowest(here.closed_loop)), MOST_MEMORY)

        threads = min(thread_count(), -(-axes // _AXES_OF_A_THREAD))
        ends = [axes * k // threads for k in range(threads + 1)]
        in_threads(update, [slice(*each) for each in pairwise(ends)])
        return Update(Gaussian(fits.mean, fits.covariance), fits.innovation, fits.innovation_covariance, fits.nis)


def updated(
    sensor: Sensor, nodes: QuadraturePaths, prior: Gaussian, measured: Profile, memory: FloatArray, passes: int
) -> Gaussian:
    """Priors of a path's coefficients, of any covariance, updated with the moments.

    ``memory`` is the factor of the covariance of what the linearisation leaves out, (axes,), the same in all passes.
    """
    n = prior.mean.shape[1]
    lines = _lines(sensor, nodes, measured, n, np.empty((0, n)))
    fits, mean, covariance = _no_fits(prior, len(ORDERS), 0), _contiguous(prior.mean), _contiguous(prior.covariance)
    for to_come in reversed(range(passes)):
        linearise(lines, mean, covariance, memory, PATH_REACH, KERNEL_REACH, not to_come, fits)
    return Gaussian(fits.mean, fits.covariance)


def _no_fits(prior: Gaussian, m: int, n_states: int) -> Fits:
    """The fits before the first pass, which is about the prior."""
    axes, n = prior.mean.shape
    return Fits(
        mean=prior.mean.copy(order="C"), covariance=np.empty((axes, n, n)), known=np.zeros((axes, n, m)),
        innovation=np.empty((axes, m)), innovation_covariance=np.empty((axes, m, m)), nis=np.empty(axes),
        closed_loop=np.empty((axes, n_states, n_states)),
    )  # fmt: skip


def _lines(sensor: Sensor, nodes: QuadraturePaths, measured: Profile, free: int, end_rows: FloatArray) -> Lines:
    """The frames for compiled code."""
    edges, pixel, rows = sensor.edges, sensor.pixel_size, _contiguous(nodes.basis[0].T)
    light = np.ones(len(measured.density)) if measured.light is None else measured.light
    return Lines(
        density=_contiguous(measured.density), usable=np.ascontiguousarray(measured.mask), light=_contiguous(light),
        inputs=_contiguous(nodes.inputs[:, 0]), basis=rows, weights=_contiguous(nodes.weights), free=free,
        shared=noise_spread(rows, free), end_rows=_contiguous(end_rows), low=float(edges[0]), high=float(edges[-1]),
        pixel=pixel, read_noise=effective_noise_density(sensor) * pixel,
        shot_noise=pixel / sensor.photoelectrons if sensor.photoelectrons else 0.0,
        kernel_variance=float(sensor.kernel.variance), widening=float(nodes.widening), orders=np.array(ORDERS),
    )  # fmt: skip


def _contiguous(values: FloatArray) -> FloatArray:
    return np.ascontiguousarray(values, dtype=np.float64)
