"""What an exposure shows of its coefficients, and how it corrects them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from aolink.estimation.frames.frame_data import Flux, Measurement, Needs
from aolink.estimation.kalman import information, two_states
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.numerics import batched, entrywise
from aolink.numerics.entrywise import Entry
from aolink.plant.alike import MANY_STATES

FloatArray = NDArray[np.float64]


MOST_COVARIANCES = 32
"""Measurements of which an estimate has the whole innovation covariance; of more it has the diagonal."""


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
    """(axes, n_measurements, n_measurements), or its diagonal, (axes, n_measurements)."""
    nis: FloatArray
    """(axes,)"""


Measured = TypeVar("Measured", contravariant=True)


class Observation(Protocol[Measured]):
    """A way to look at an exposure."""

    needs: Needs
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
    flux:
        As of `Needs`.
    """

    models_noise = False

    def __init__(
        self, n_outputs: int, orders: Sequence[int], gain: FloatArray | None = None, *, crosses: bool = False,
        flux: Flux = "known",
    ) -> None:  # fmt: skip
        self.orders, self.gain, self.crosses = tuple(orders), gain, crosses
        self.needs = Needs(what="moments", orders=self.orders, flux=flux)
        self.n_measurements = n_outputs * len(self.orders) + crosses * math.comb(n_outputs, 2)

    def correct(
        self, model: ExposureModel, response: InputResponse, prior: Belief, measured: Measurement
    ) -> Correction:
        """One step of the (extended) Kalman filter."""
        if measured.covariance.ndim == 4:
            blocks = measured.covariance.shape[1]
            if blocks > 1 and not self.crosses:
                expected, slope = many_moments(model, response, prior.mean, self.orders)
                innovation = measured.value - expected
                if prior.mean.shape[1] > MANY_STATES:
                    return _corrected_large(prior, innovation, slope, measured.covariance, self.gain)
                return corrected_by_blocks(prior, innovation, slope, measured.covariance, self.gain)
            measured = replace(measured, covariance=measured.covariance[:, 0])
        h, H = _moment_entries(model, response, prior.mean, self.orders, crosses=self.crosses)
        axes = len(prior.mean)
        if max(len(H), model.plant.n_states) > entrywise.MOST_ROWS:
            innovation = measured.value - entrywise.pack_vector(h, axes)
            return corrected(prior, innovation, entrywise.pack(H, axes), measured.covariance, self.gain)
        innovations = [y - expected for y, expected in zip(entrywise.columns(measured.value), h, strict=True)]
        if self.gain is None and len(H) == model.plant.n_states == 2:
            return _corrected_two(prior, innovations, H, measured.covariance)
        return _corrected_small(prior, innovations, H, measured.covariance, self.gain)


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
    h, H = _moment_entries(model, response, state, orders, crosses=crosses)
    return entrywise.pack_vector(h, len(state)), entrywise.pack(H, len(state))


def _moment_entries(
    model: ExposureModel, response: InputResponse, state: FloatArray, orders: Sequence[int], *, crosses: bool = False
) -> tuple[list[Entry], entrywise.Matrix]:
    """`predicted_moments`, entry by entry."""
    x = entrywise.columns(state)
    moments: list[Entry] = []
    slopes: entrywise.Matrix = []
    for o in range(model.plant.n_outputs):
        if 1 in orders:
            mean_row = model.mean_row[o].tolist()
            moments.append(entrywise.dot(mean_row, x) + entrywise.columns(response.mean)[o])
            slopes.append(mean_row)
        if 2 in orders:
            slope = entrywise.columns(response.slope[:, o])
            half = entrywise.add(_times_state(model.quadratic[o], state), slope)
            moments.append(entrywise.dot(x, entrywise.add(half, slope)) + entrywise.columns(response.square)[o])
            slopes.append([2 * each for each in half])
    for o, p in itertools.combinations(range(model.plant.n_outputs), 2) if crosses else ():
        # mean (a'x + c)(b'x + d) = x'M_ab x + (b_ad + b_bc)'x + s_cd
        mixed = _times_state(model.cross_quadratic(o, p), state)
        both, square = model.cross_response(response, o, p)
        slope = entrywise.columns(both)
        moments.append(entrywise.dot(x, entrywise.add(mixed, slope)) + square)
        slopes.append([2 * a + b for a, b in zip(mixed, slope, strict=True)])
    return moments, slopes


def many_moments(
    model: ExposureModel, response: InputResponse, state: FloatArray, orders: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """`predicted_moments` of a plant with many outputs, all of them at once."""
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


def corrected(
    prior: Belief, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None = None
) -> Correction:
    """A Kalman correction in Joseph form.

    Mishra & Wen (18) to (20), with the innovation y - h(x). ``gain`` (n_states, n_measurements) stands in
    for the optimal one; Joseph's form gives the covariance that it really has.
    """
    R = batched.batch_last(R)
    PH = batched.matmul(prior.covariance, batched.transpose(H))
    S = batched.matmul(H, PH) + R
    S_inverse = batched.inverse(S)
    K = batched.matmul(PH, S_inverse) if gain is None else gain
    mean = prior.mean + batched.matvec(K, innovation)
    keep = np.eye(prior.mean.shape[1]) - batched.matmul(K, H)
    covariance = batched.symmetric(batched.congruence(keep, prior.covariance) + batched.congruence(K, R))
    nis = batched.dot(innovation, batched.matvec(S_inverse, innovation))
    return Correction(Belief(mean, covariance), innovation, S, nis)


def corrected_by_blocks(
    prior: Belief, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None = None
) -> Correction:
    """`corrected` for few states and many measurements, whose noise is shared within blocks only.

    With G = H' R^-1 H and M = (I + P G)^-1 P, the optimal gain is M H' R^-1 and S^-1 y = R^-1 (y - H K y): nothing
    has more rows than there are states, and P may be singular. Of S there is the diagonal where it is large.

    Parameters
    ----------
    R:
        (axes, blocks, size, size)
    """
    axes, blocks, size, _ = R.shape
    n = prior.mean.shape[1]
    H, y = H.reshape(axes, blocks, size, n), innovation.reshape(axes, blocks, size, 1)
    P, transposed = prior.covariance, batched.transpose(H)
    weighted = np.linalg.solve(R, np.concatenate([H, y], axis=3))
    # Sums over blocks of products as small as these do not depend on threads.
    G = batched.symmetric((transposed @ weighted[..., :n]).sum(axis=1))
    M = batched.symmetric(np.asarray(np.linalg.solve(np.eye(n) + P @ G, P)))
    optimal = (M @ (transposed @ weighted[..., n:]).sum(axis=1))[..., 0]
    if gain is None:
        moved, keep, from_noise = optimal, np.eye(n) - M @ G, batched.congruence(M, G)
    else:
        K = np.moveaxis(gain.reshape(-1, n, blocks, size), 2, 1)  # (1 or axes, blocks, n, size)
        moved = (K @ y).sum(axis=1)[..., 0]
        keep = np.eye(n) - (K @ H).sum(axis=1)
        from_noise = (K @ R @ batched.transpose(K)).sum(axis=1)
    covariance = batched.symmetric(batched.congruence(keep, P) + from_noise)
    left = y - H @ optimal[:, None, :, None]
    nis = (weighted[..., n:] * left).sum(axis=(1, 2, 3))
    m = blocks * size
    flat = H.reshape(axes, m, n)
    if m > MOST_COVARIANCES:
        S = (flat @ P * flat).sum(axis=2) + np.einsum("abss->abs", R).reshape(axes, m)
    else:
        S = flat @ P @ batched.transpose(flat)
        for k in range(blocks):
            some = slice(k * size, (k + 1) * size)
            S[:, some, some] += R[:, k]
    return Correction(Belief(prior.mean + moved, covariance), innovation, S, nis)


def _corrected_large(
    prior: Belief, innovation: FloatArray, H: FloatArray, R: FloatArray, gain: FloatArray | None
) -> Correction:
    """`corrected_by_blocks` for many states; of the innovation covariance there is the diagonal."""
    axes = len(innovation)
    gains = [None] * axes if gain is None else np.broadcast_to(gain, (axes, *gain.shape[-2:]))
    every = zip(prior.mean, prior.covariance, innovation, H, R, gains, strict=True)
    mean, covariance, S, nis = (
        np.stack(each) for each in zip(*(information.corrected(*one) for one in every), strict=True)
    )
    return Correction(Belief(mean, covariance), innovation, S, nis)


def _corrected_small(
    prior: Belief, innovation: list[Entry], H: entrywise.Matrix, R: FloatArray, gain: FloatArray | None
) -> Correction:
    """`corrected` for one or two states and measurements, entry by entry."""
    axes, P, noise = len(prior.mean), entrywise.unpack(prior.covariance), entrywise.unpack(R)
    HP = entrywise.times_transposed(H, P)
    S = entrywise.symmetric_times_transposed(HP, H, noise)
    S_inverse = entrywise.inverse(S)
    K = entrywise.unpack(gain) if gain is not None else entrywise.times_transposed(entrywise.transpose(HP), S_inverse)
    mean = entrywise.add(entrywise.columns(prior.mean), entrywise.times_vector(K, innovation))
    keep = entrywise.one_minus(entrywise.times_transposed(K, entrywise.transpose(H)))
    from_noise = entrywise.symmetric_times_transposed(entrywise.times_transposed(K, noise), K)
    covariance = entrywise.congruence(keep, P, from_noise)
    nis = entrywise.dot(innovation, entrywise.times_vector(S_inverse, innovation))
    after = Belief(entrywise.pack_vector(mean, axes), entrywise.pack(covariance, axes))
    return Correction(
        after, entrywise.pack_vector(innovation, axes), entrywise.pack(S, axes), entrywise.pack_one(nis, axes)
    )


def _corrected_two(prior: Belief, innovation: list[Entry], H: entrywise.Matrix, R: FloatArray) -> Correction:
    """`corrected` for two states and two measurements, with the optimal gain."""
    axes = len(prior.mean)
    (p, q), (_, r) = entrywise.unpack(prior.covariance)
    (first, shared), (_, rest) = entrywise.unpack(R)
    x, v, p, q, r, s, both, t, nis = two_states.corrected(
        entrywise.columns(prior.mean), (p, q, r), innovation, H, (first, shared, rest), together=bool(np.any(shared))
    )
    after = Belief(entrywise.pack_vector([x, v], axes), entrywise.pack([[p, q], [q, r]], axes))
    S = entrywise.pack([[s, both], [both, t]], axes)
    return Correction(after, entrywise.pack_vector(innovation, axes), S, entrywise.pack_one(nis, axes))


def steady_gain(model: ExposureModel, Q: FloatArray, R: FloatArray) -> FloatArray | None:
    """Steady-state gain of the centroid filter on the lifted plant (A^N, C-bar), (n_states, n_outputs).

    It corrects the state at the start of the exposure with that exposure's centroid. None where the
    Riccati equation has no stabilising solution: the centroid loses a mode that does not die out.

    Parameters
    ----------
    R:
        Covariance of the centroids as blocks along its diagonal, (blocks, size, size), or whole.
    """
    H = model.mean_row
    if R.ndim == 3 and H.shape[1] > MANY_STATES:
        return information.steady_gain(model.transition, H, Q, R)
    if R.ndim == 3 and len(H) > H.shape[1]:
        return _compressed_gain(model, Q, R)
    R = linalg.block_diag(*R) if R.ndim == 3 else R
    try:
        P = linalg.solve_discrete_are(model.transition.T, H.T, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray(P @ H.T @ np.linalg.inv(H @ P @ H.T + R))


def _compressed_gain(model: ExposureModel, Q: FloatArray, R: FloatArray) -> FloatArray | None:
    """`steady_gain` for more outputs than states: of whitened ones, no more than there are states tell anything."""
    root = np.linalg.cholesky(R)
    blocks, size, _ = R.shape
    white = np.linalg.solve(root, model.mean_row.reshape(blocks, size, -1)).reshape(blocks * size, -1)
    rotation, H = np.linalg.qr(white)
    try:
        P = linalg.solve_discrete_are(model.transition.T, H.T, Q, np.eye(len(H)))
    except (np.linalg.LinAlgError, ValueError):
        return None
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(len(H)))
    told = np.linalg.solve(root.swapaxes(1, 2), rotation.reshape(blocks, size, -1)).reshape(blocks * size, -1)
    return np.asarray(gain @ told.T)
