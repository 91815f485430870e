"""Observation models of an exposure for a Kalman filter, and that of the paper: moments of the path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

import numpy as np

from aolink.estimation.frames.frame_data import Measurement, Needs
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.kalman.update import blocked_update
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.numerics.arrays import FloatArray
from aolink.rig import Plant

MOST_OUTPUTS = 2
"""Most outputs of a plant of one spot."""
Data = TypeVar("Data", contravariant=True)


class Observation(Protocol[Data]):
    """The measurement that a filter takes of an exposure, and its update with it."""

    needs: Needs
    models_noise: bool
    """Whether the coefficients go on after the start state, to the process noise inside the exposure."""
    n_measurements: int

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Data) -> Update:
        """Update the prior of the exposure's coefficients with the measurement."""


class PathMoments:
    """Moments of the path, as the paper's filters take them: no process noise inside the exposure.

    The plant's number of outputs is that of the measurements of each moment, of the orders 1 and 2. ``gain`` is a
    constant one, (n_states, n_measurements), instead of the optimal one.

    ``second_order`` takes the terms that the linearisation leaves out: the second-order extended Kalman filter of
    Athans, Wishner, Bertolini, IEEE Trans. Automatic Control 13 (1968). The second moment is quadratic in the start
    state: with x ~ N(m, P) its mean is h_2(m) + tr(M P), and its covariance with that of another output H_2 P H_2' +
    2 tr(M P M' P), both exactly. It is for plants of one spot a copy.
    """

    models_noise = False

    def __init__(
        self, plant: Plant, orders: Sequence[int], gain: FloatArray | None = None, *, second_order: bool = False
    ) -> None:
        self.orders, self.gain, self.second_order = tuple(orders), gain, second_order
        self.needs = Needs(what="moments", orders=self.orders)
        self.moment_orders = np.tile(self.orders, plant.n_outputs)
        self.n_measurements = len(self.moment_orders)

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Measurement) -> Update:
        """One step of the (extended) Kalman filter for many outputs: spots, of which each has noise of its own.

        Plants of one or two outputs have a compiled loop (`aolink.estimation.kalman.filter.PathFilter`).
        """
        expected, slope = predicted_moments(model, response, prior.mean, self.orders)
        noise = measured.covariance if measured.covariance.ndim == 4 else measured.covariance[:, None]
        return blocked_update(prior, measured.value - expected, slope, noise, self.gain)


def predicted_moments(
    model: ExposureModel, response: InputResponse, state: FloatArray, orders: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Moments of the path without process noise, h (axes, m), and their Jacobian by the start state, H (axes, m,
    n_states); an output's orders are together.

    h_1 = C-bar x + mean(c), h_2 = x'Mx + 2 b'x + s for each output; H_1 = C-bar, H_2 = 2 (Mx + b)'. Mishra & Wen (12),
    (13) and (15), with the inputs inside the exposure that they leave out. States are (axes, n_states); orders a subset
    of 1 and 2, in order.
    """
    axes, n = state.shape
    rows = model.mean_row
    moments, slopes = [], []
    if 1 in orders:
        moments.append(state @ rows.T + response.mean)
        slopes.append(np.broadcast_to(rows, (axes, *rows.shape)))
    if 2 in orders:
        half = model.times_quadratic(state) + response.slope
        moments.append(np.matmul(half + response.slope, state[:, :, None])[..., 0] + response.square)
        slopes.append(2 * half)
    return np.stack(moments, axis=2).reshape(axes, -1), np.stack(slopes, axis=2).reshape(axes, -1, n)
