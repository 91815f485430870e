"""Observation models of an exposure for a Kalman filter, and that of the paper: moments of the path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np

from aolink.estimation.frames.frame_data import Flux, Measurement, Needs
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.kalman.information_form import information_update
from aolink.estimation.kalman.update import blocked_update, joseph_update, small_update, two_state_update
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.numerics import batched, entrywise
from aolink.numerics.arrays import FloatArray
from aolink.numerics.entrywise import Entry
from aolink.plant.alike import MANY_STATES
from aolink.rig import Plant

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
    constant one, (n_states, n_measurements), instead of the optimal one; ``flux`` is as in `Needs`.
    """

    models_noise = False

    def __init__(
        self, plant: Plant, orders: Sequence[int], gain: FloatArray | None = None, *, flux: Flux = "known"
    ) -> None:
        self.orders, self.gain = tuple(orders), gain
        self.needs = Needs(what="moments", orders=self.orders, flux=flux)
        self.n_measurements = plant.n_outputs * len(self.orders)

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Measurement) -> Update:
        """One step of the (extended) Kalman filter, in the form for these numbers of states and measurements."""
        n_states, n_outputs = model.plant.n_states, model.plant.n_outputs
        if n_outputs > 2:  # many spots, of which each has noise of its own
            expected, slope = many_moments(model, response, prior.mean, self.orders)
            update = information_update if n_states > MANY_STATES else blocked_update
            return update(prior, measured.value - expected, slope, measured.covariance, self.gain)
        R = measured.single_block
        if max(self.n_measurements, n_states) > entrywise.MOST_ROWS:
            expected, slope = predicted_moments(model, response, prior.mean, self.orders)
            return joseph_update(prior, measured.value - expected, slope, R, self.gain)
        h, H = _moment_entries(model, response, prior.mean, self.orders)
        innovation = [y - expected for y, expected in zip(entrywise.columns(measured.value), h, strict=True)]
        if self.gain is None and self.n_measurements == n_states == 2:
            return two_state_update(prior, innovation, H, R)
        return small_update(prior, innovation, H, R, self.gain)


class SecondOrderMoments(PathMoments):
    """`PathMoments` with the second-order terms that their linearisation leaves out: the second-order extended Kalman
    filter.

    The second moment is quadratic in the start state: with x ~ N(m, P) its mean is h_2(m) + tr(M P), and its covariance
    with that of another output H_2 P H_2' + 2 tr(M P M' P), both exactly. Athans, Wishner, Bertolini, IEEE Trans.
    Automatic Control 13 (1968). It is for plants of one spot a copy.
    """

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Measurement) -> Update:
        """One step of the second-order extended Kalman filter."""
        MP = batched.matmul(model.quadratic[None], prior.covariance[:, None])  # (axes, n_outputs, n, n)
        second = np.arange(self.n_measurements)[len(self.orders) - 1 :: len(self.orders)]
        value, covariance = measured.value.copy(), measured.single_block + np.zeros((len(MP), 1, 1))
        value[:, second] -= np.einsum("aoii->ao", MP)
        covariance[:, second[:, None], second] += 2 * np.einsum("aoij,apji->aop", MP, MP)
        widened = replace(measured, value=value, covariance=covariance)
        return super().update(model, response, prior, widened)


def predicted_moments(
    model: ExposureModel, response: InputResponse, state: FloatArray, orders: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Moments of the path without process noise, h (axes, m), and their Jacobian by the start state, H (axes, m,
    n_states); an output's orders are together.

    h_1 = C-bar x + mean(c), h_2 = x'Mx + 2 b'x + s for each output; H_1 = C-bar, H_2 = 2 (Mx + b)'. Mishra & Wen (12),
    (13) and (15), with the inputs inside the exposure that they leave out. States are (axes, n_states); orders a subset
    of 1 and 2, in order.
    """
    h, H = _moment_entries(model, response, state, orders)
    return entrywise.pack_vector(h, len(state)), entrywise.pack(H, len(state))


def _moment_entries(
    model: ExposureModel, response: InputResponse, state: FloatArray, orders: Sequence[int]
) -> tuple[list[Entry], entrywise.Matrix]:
    """`predicted_moments`, entry by entry."""
    x = entrywise.columns(state)
    moments: list[Entry] = []
    slopes: entrywise.Matrix = []
    for o in range(model.plant.n_outputs):
        if 1 in orders:
            mean_row = model.mean_row[o].tolist()
            moments.append(entrywise.dot_of_entries(mean_row, x) + entrywise.columns(response.mean)[o])
            slopes.append(mean_row)
        if 2 in orders:
            slope, square = entrywise.columns(response.slope[:, o]), entrywise.columns(response.square)[o]
            half = entrywise.add(_times_state(model.quadratic[o], state), slope)
            moments.append(entrywise.dot_of_entries(x, entrywise.add(half, slope)) + square)
            slopes.append([2 * each for each in half])
    return moments, slopes


def many_moments(
    model: ExposureModel, response: InputResponse, state: FloatArray, orders: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """`predicted_moments` of many outputs, all at once: row `spots_under_turbulence` of tools/bench."""
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


def _times_state(matrix: FloatArray, state: FloatArray) -> list[Entry]:
    """A matrix (n, n) times states (axes, n)."""
    if len(matrix) > entrywise.MOST_ROWS:
        return entrywise.columns(batched.matvec(matrix, state))
    return entrywise.times_vector(entrywise.unpack(matrix), entrywise.columns(state))
