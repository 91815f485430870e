"""What an exposure shows of its coefficients, and how it corrects them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from aolink.estimation import stacked
from aolink.estimation.exposure_model import ExposureModel, InputResponse
from aolink.estimation.moments import Measurement

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Belief:
    """A Gaussian for each axis."""

    mean: FloatArray
    """(axes, n)"""
    covariance: FloatArray
    """(axes, n, n)"""


@dataclass(frozen=True, eq=False)
class Correction:
    """What a measurement made of a belief."""

    posterior: Belief
    innovation: FloatArray
    """(axes, n_measurements)"""
    innovation_covariance: FloatArray
    """(axes, n_measurements, n_measurements)"""
    nis: FloatArray
    """(axes,)"""


Measured = TypeVar("Measured", contravariant=True)


class Observation(Protocol[Measured]):
    """A way to look at an exposure."""

    models_noise: bool
    """Whether the coefficients go on after the start state, to the process noise inside the exposure."""
    n_measurements: int

    def correct(self, model: ExposureModel, response: InputResponse, prior: Belief, measured: Measured) -> Correction:
        """Correct the exposure's coefficients with what was measured."""


class PathMoments:
    """Moments of the path, as the paper's filters take them: no process noise inside the exposure.

    Parameters
    ----------
    n_outputs:
        Outputs of one copy of the plant.
    orders:
        Moments, of 1 and 2.
    gain:
        A constant gain (n_states, n_measurements) instead of the optimal one.
    crosses:
        Whether the cross moments of each two outputs follow, y_11 of a lenslet's x and y.
    """

    models_noise = False

    def __init__(
        self, n_outputs: int, orders: Sequence[int], gain: FloatArray | None = None, *, crosses: bool = False
    ) -> None:
        self.orders, self.gain, self.crosses = tuple(orders), gain, crosses
        self.n_measurements = n_outputs * len(self.orders) + crosses * math.comb(n_outputs, 2)

    def correct(
        self, model: ExposureModel, response: InputResponse, prior: Belief, measured: Measurement
    ) -> Correction:
        """One step of the (extended) Kalman filter."""
        h, H = predicted_moments(model, response, prior.mean, self.orders, crosses=self.crosses)
        return corrected(prior, measured.value - h, H, measured.covariance, self.gain)


def predicted_moments(
    model: ExposureModel, response: InputResponse, state: FloatArray, orders: Sequence[int], *, crosses: bool = False
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
    h (axes, m) and H (axes, m, n_states); an output's orders are together, cross moments come last.
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
    for o, p in itertools.combinations(range(model.plant.n_outputs), 2) if crosses else ():
        # mean (a'x + c)(b'x + d) = x'M_ab x + (b_ad + b_bc)'x + s_cd
        mixed = stacked.matvec(model.cross_quadratic(o, p), state)
        slope, square = model.cross_response(response, o, p)
        moments.append(stacked.dot(state, mixed + slope) + square)
        slopes.append(2 * mixed + slope)
    h = np.empty((len(moments), len(state)))
    H = np.empty((len(moments), model.plant.n_states, len(state)))
    for m, (moment, slope) in enumerate(zip(moments, slopes, strict=True)):
        h[m], H[m] = moment, slope.T
    return h.T, np.moveaxis(H, -1, 0)


def corrected(
    prior: Belief, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None = None
) -> Correction:
    """A Kalman correction in Joseph form.

    Mishra & Wen (18) to (20), with the innovation y - h(x). ``gain`` (n_states, n_measurements) stands in
    for the optimal one; Joseph's form gives the covariance that it really has.
    """
    R = stacked.batch_last(R)
    PH = stacked.matmul(prior.covariance, stacked.transpose(H))
    S = stacked.matmul(H, PH) + R
    S_inverse = stacked.inverse(S)
    K = stacked.matmul(PH, S_inverse) if gain is None else gain
    mean = prior.mean + stacked.matvec(K, innovation)
    keep = np.eye(prior.mean.shape[1]) - stacked.matmul(K, H)
    covariance = stacked.symmetric(stacked.congruence(keep, prior.covariance) + stacked.congruence(K, R))
    nis = stacked.dot(innovation, stacked.matvec(S_inverse, innovation))
    return Correction(Belief(mean, covariance), innovation, S, nis)


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
