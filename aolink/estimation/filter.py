"""The recursion from exposure to exposure: moments in, states out. It knows no pixels and no clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from aolink.estimation import stacked
from aolink.estimation.estimate import Status
from aolink.estimation.exposure_model import ExposureModel, InputResponse, by_axis
from aolink.estimation.moments import Measurement
from aolink.plant import input_response, lift
from aolink.rig import Plant

FloatArray = NDArray[np.float64]
Noise = Literal["lifted", "printed"]

# A measurement beyond this quantile of chi-square is not used. It is wide: the paper's filters leave the
# process noise inside an exposure out, and have every right to innovations larger than they expect.
_GATE_PROBABILITY = 1 - 1e-9
_PATIENCE = 3


@dataclass(frozen=True, eq=False)
class Belief:
    """What is believed of the state of each axis."""

    mean: FloatArray
    """(axes, n_states)"""
    covariance: FloatArray
    """(axes, n_states, n_states)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Posterior:
    """What one exposure came to."""

    start: Belief
    end: Belief
    status: NDArray[np.int64]
    """`Status` of each axis, (axes,)."""
    innovation: FloatArray
    """(axes, n_measurements)"""
    innovation_covariance: FloatArray
    """(axes, n_measurements, n_measurements)"""
    nis: FloatArray
    """(axes,)"""


def predicted_moments(
    model: ExposureModel, response: InputResponse, state: FloatArray, orders: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """Moments of the path without process noise, and their Jacobian by the start state.

    h_1 = C-bar x + mean(c), h_2 = x'Mx + 2 b'x + s for each output; H_1 = C-bar, H_2 = 2 (Mx + b)'.
    Mishra & Wen (12), (13) and (15), with the inputs inside the exposure that they leave out.

    Parameters
    ----------
    state:
        (axes, n_states)
    orders:
        A subset of 1 and 2, in order.

    Returns
    -------
    h (axes, n_outputs * orders) and H (axes, n_outputs * orders, n_states); an output's orders are together.
    """
    moments, slopes = [], []
    for o in range(model.plant.n_outputs):
        if 1 in orders:
            moments.append(stacked.dot(state, model.mean_row[o]) + response.mean[:, o])
            slopes.append(np.broadcast_to(model.mean_row[o], state.shape))
        if 2 in orders:
            half = stacked.matvec(model.quadratic[o], state) + response.slope[:, o]
            moments.append(stacked.dot(state, half + response.slope[:, o]) + response.square[:, o])
            slopes.append(2 * half)
    h = np.empty((len(moments), len(state)))
    H = np.empty((len(moments), model.plant.n_states, len(state)))
    for m, (moment, slope) in enumerate(zip(moments, slopes, strict=True)):
        h[m], H[m] = moment, slope.T
    return h.T, np.moveaxis(H, -1, 0)


def corrected(
    prior: Belief, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None = None
) -> tuple[Belief, FloatArray, FloatArray]:
    """A Kalman correction in Joseph form; posterior, innovation covariance S and normalised innovation squared.

    Mishra & Wen (18) to (20), with the innovation y - h(x). ``gain`` (n_states, n_measurements) stands in
    for the optimal one; Joseph's form gives the covariance that it really has.
    """
    PH = stacked.matmul(prior.covariance, stacked.transpose(H))
    S = stacked.symmetric(stacked.matmul(H, PH) + R)
    S_inverse = stacked.inverse(S)
    K = stacked.matmul(PH, S_inverse) if gain is None else gain
    mean = prior.mean + stacked.matvec(K, innovation)
    keep = np.eye(prior.mean.shape[1]) - stacked.matmul(K, H)
    covariance = stacked.symmetric(stacked.congruence(keep, prior.covariance) + stacked.congruence(K, R))
    nis = stacked.dot(innovation, stacked.matvec(S_inverse, innovation))
    return Belief(mean, covariance), S, nis


def added_noise(model: ExposureModel, kind: Noise) -> FloatArray:
    """What the process noise of one exposure adds to the state's covariance, (n_states, n_states)."""
    plant = model.plant
    return model.process_noise if kind == "lifted" else plant.B_w @ plant.process_noise @ plant.B_w.T


def steady_gain(model: ExposureModel, Q: FloatArray, R: FloatArray) -> FloatArray | None:
    """Steady-state gain of the centroid filter on the lifted plant (A^N, C-bar), (n_states, n_outputs).

    It corrects the state at the start of the exposure with that exposure's centroid. None where the
    Riccati equation has no stabilising solution: the centroid loses a mode that does not die out.
    """
    H = model.mean_row
    try:
        P = linalg.solve_discrete_are(model.transition.T, H.T, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray(P @ H.T @ np.linalg.inv(H @ P @ H.T + R))


class BlurFilter:
    """State and prior of all axes, carried from exposure to exposure.

    Timing: an exposure's moments correct the state at its start; the state at its end is the prediction
    through the exposure, and is where the next one begins.

    Parameters
    ----------
    orders:
        Moments that it takes, of 1 and 2; none for prediction only.
    process_noise:
        Covariance that one exposure adds: "lifted", what N fast steps do, or "printed", the paper's B_w W B_w'.
    gain:
        A constant gain (n_states, n_measurements) instead of the optimal one.
    gate:
        Whether measurements that are too far from their prediction are left out.
    """

    def __init__(
        self, plant: Plant, orders: Sequence[int], *, process_noise: Noise = "lifted",
        gain: FloatArray | None = None, gate: bool = True,
    ) -> None:  # fmt: skip
        self.plant, self.orders = plant, tuple(orders)
        self._process_noise, self._gain = process_noise, gain
        prior = Belief(stacked.tile(plant.initial_mean, plant.axes), stacked.tile(plant.initial_covariance, plant.axes))
        self.belief = self._unseen = prior  # with, and without what the camera said
        self._missed = np.zeros(plant.axes, dtype=np.int64)
        n_measurements = plant.n_outputs * len(self.orders)
        self._gate = stats.chi2.ppf(_GATE_PROBABILITY, n_measurements) if gate and n_measurements else np.inf

    def bridge(self, inputs: FloatArray) -> None:
        """Predict over fast steps that no exposure covers, with their inputs, (k, axes * n_inputs)."""
        if len(inputs):
            transition, noise = lift(self.plant, len(inputs))
            _, kick = input_response(self.plant, by_axis(self.plant, inputs))
            self.belief = _predicted(self.belief, transition, noise, kick)
            self._unseen = _predicted(self._unseen, transition, noise, kick)

    def step(self, model: ExposureModel, response: InputResponse, measurement: Measurement | None) -> Posterior:
        """One exposure, with its measurement or without."""
        axes = self.plant.axes
        diverged = self._missed >= _PATIENCE
        prior = _where(diverged, self._unseen, self.belief)
        if measurement is None or not self.orders:
            start, S = prior, np.zeros((axes, 0, 0))
            innovation, nis, used = np.zeros((axes, 0)), np.zeros(axes), np.zeros(axes, dtype=bool)
            status = np.full(axes, Status.PREDICTED if not self.orders else Status.INPUT_INVALID, dtype=np.int64)
        else:
            h, H = predicted_moments(model, response, prior.mean, self.orders)
            innovation = measurement.value - h
            start, S, nis = corrected(prior, innovation, H, measurement.covariance, self._gain)
            sane = np.isfinite(start.mean).all(axis=1) & np.isfinite(start.covariance).all(axis=(1, 2))
            used = (nis <= self._gate) & sane
            start = _where(used, start, prior)
            self._missed = np.where(used, 0, np.where(diverged, 1, self._missed + 1))
            status = np.where(used, np.where(diverged, Status.REINITIALISED, Status.OK), Status.GATED)
            status = np.where(~used & (self._missed >= _PATIENCE), Status.DIVERGED, status)
        Q = added_noise(model, self._process_noise)
        self.belief = _predicted(start, model.transition, Q, response.end)
        self._unseen = _predicted(self._unseen, model.transition, model.process_noise, response.end)
        return Posterior(
            start=start, end=self.belief, status=status,
            innovation=innovation, innovation_covariance=S, nis=nis,
        )  # fmt: skip


def _predicted(belief: Belief, transition: FloatArray, noise: FloatArray, kick: FloatArray) -> Belief:
    """x -> A x + d, P -> A P A' + Q. Mishra & Wen (16) and (17), with the inputs."""
    mean = stacked.matvec(transition, belief.mean) + kick
    return Belief(mean, stacked.symmetric(stacked.congruence(transition, belief.covariance) + noise))


def _where(chosen: NDArray[np.bool_], first: Belief, second: Belief) -> Belief:
    """Axis by axis, the first belief where chosen."""
    if chosen.all():
        return first
    if not chosen.any():
        return second
    return Belief(
        np.where(chosen[:, None], first.mean, second.mean),
        np.where(chosen[:, None, None], first.covariance, second.covariance),
    )
