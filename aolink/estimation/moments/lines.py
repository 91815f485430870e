"""Windowed moments of line sensors: the module `windowed` says what is computed, compiled code does it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from aolink.estimation.compiled.windowed import Fits, Lines, linearise, noise_spread
from aolink.estimation.frames.frame_data import HALF, Flux, Needs, Profile
from aolink.estimation.frames.moments import LEAST_FLUX
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.estimation.model.quadrature import QuadraturePaths, blocks, quadrature_paths
from aolink.estimation.moments.windowed import (
    KERNEL_REACH,
    MOST_MEMORY,
    MOST_NODES,
    NOT_BELIEVED,
    PASSES,
    PATH_REACH,
    Basis,
    error_memory,
    slowest,
)
from aolink.numerics.arrays import FloatArray
from aolink.numerics.workers import in_threads, thread_count
from aolink.optics.camera import effective_noise_density
from aolink.optics.sensor import Sensor

_BASES: tuple[Basis, ...] = ("monomial", "legendre", "fourier")
# With fewer axes a second thread costs more than it saves.
_AXES_OF_A_THREAD = 16


class WindowedMoments:
    """Windowed moments of line-sensor profiles, one output for each axis.

    Parameters
    ----------
    orders:
        Orders of the basis functions; 0 is the light in the window.
    basis, flux:
        As in `Windowed`.
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
        self.needs = Needs(what="profile", least_usable=HALF)

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Profile) -> Update:
        """Iterated statistical linearisation, from the prior to the posterior."""
        nodes = quadrature_paths(model, response, blocks(model.n_steps, MOST_NODES))
        lines = self._lines(model, nodes, measured)
        axes, m = len(prior.mean), self.n_measurements
        mean, covariance = np.ascontiguousarray(prior.mean), np.ascontiguousarray(prior.covariance)
        n_states = len(model.transition)
        fits = Fits(
            mean=mean.copy(), covariance=np.empty_like(covariance), known=np.zeros((axes, mean.shape[1], m)),
            innovation=np.empty((axes, m)), innovation_covariance=np.empty((axes, m, m)), nis=np.empty(axes),
            significance=np.empty(axes),
            closed_loop=np.empty((axes, n_states, n_states)),
        )  # fmt: skip
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
        nis = fits.nis
        if self.flux == "measured":
            nis = np.where(fits.significance < LEAST_FLUX, NOT_BELIEVED, nis)
        return Update(Gaussian(fits.mean, fits.covariance), fits.innovation, fits.innovation_covariance, nis)

    def _lines(self, model: ExposureModel, nodes: QuadraturePaths, measured: Profile) -> Lines:
        """The frames for compiled code."""
        sensor, edges, pixel = self.sensor, self.sensor.edges, self.sensor.pixel_size
        light = np.ones(len(measured.density)) if measured.light is None else measured.light
        basis = _contiguous(nodes.basis[0].T)
        return Lines(
            density=_contiguous(measured.density), usable=np.ascontiguousarray(measured.mask),
            light=_contiguous(light), inputs=_contiguous(nodes.inputs[:, 0]), basis=basis,
            weights=_contiguous(nodes.weights), shared=noise_spread(basis, len(model.transition)),
            end_rows=_contiguous(model.end_rows), low=float(edges[0]), high=float(edges[-1]), pixel=pixel,
            read_noise=effective_noise_density(sensor) * pixel,
            shot_noise=pixel / sensor.photoelectrons if sensor.photoelectrons else 0.0,
            kernel_variance=float(sensor.kernel.variance), widening=float(nodes.widening),
            orders=np.array(self.orders), functions=_BASES.index(self.basis), ratios=self.flux == "measured",
        )  # fmt: skip


def _contiguous(values: FloatArray) -> FloatArray:
    return np.ascontiguousarray(values, dtype=np.float64)
