"""The plant lifted over many fast steps, and what the camera can know of it.

Everything here follows from x(k+1) = A x(k) + B u(k) + B_w w(k), theta(k) = C x(k), Mishra & Wen (1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink import blas
from aolink.blocks import Indices, alike, blockwise, components, eigenvalues, null_space
from aolink.rig import Plant, Rig

FloatArray = NDArray[np.float64]

_BLOCK_STEPS = 32
_SMALL_PRODUCT = 100_000
MANY_STATES = 64
"""With more states than this a plant's matrices are large: a mirror is taken by its actuators."""
_LARGEST_CHECK = 200_000
# A mode that shrinks to this over one exposure is gone before the next, whatever the camera saw of it.
_FORGOTTEN = 1e-3
# Eigenvalues closer than this are one; and a vector that A moves less from its multiple is an eigenvector.
_SAME = 1e-7
# What an eigenvector makes of the outputs, relative to their size, below which they do not see it.
_UNSEEN = 1e-9


def psd_root(covariance: FloatArray) -> FloatArray:
    """A root R of a covariance that may be singular, R R' = covariance, (n, n)."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def output_rows(plant: Plant, n_steps: int) -> FloatArray:
    """C A^i for i = 0 .. n_steps - 1, (n_outputs, n_steps, n_states)."""
    rows, power = plant.C[None], plant.A
    while len(rows) < n_steps:
        rows = np.concatenate([rows, rows @ power])
        power = power @ power
    return np.ascontiguousarray(rows[:n_steps].transpose(1, 0, 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class AlikeSystems:
    """A plant of many inputs, each of which moves a small system of its own, all alike: outputs mix what these do.

    A = I (x) A_1 and so on, C = gains (x) C_1.
    """

    one: Plant
    """One of them, with unit noise; its output is what the plant's outputs see of it."""
    gains: FloatArray
    """(n_outputs, systems)"""
    noise_sd: FloatArray
    """Standard deviation of the noise of each, (systems,)."""
    order: Indices
    """States of each, (systems, n)."""


@lru_cache(maxsize=16)
def alike_systems(plant: Plant) -> AlikeSystems | None:
    """The systems of a large plant that falls apart into such; None for another one.

    A plant is large with more than `MANY_STATES` states, and also with more outputs than states where each output has
    a coefficient of its own (`UnmodelledSlopes`): `moments` with dense matrices takes 4 s for 48 spots, a fiftieth of
    that with these.
    """
    W = plant.process_noise
    large = plant.n_states > MANY_STATES or (plant.unmodelled is not None and plant.n_outputs > plant.n_states)
    if not large or np.count_nonzero(W - np.diag(np.diag(W))):
        return None
    order = alike(plant.A, plant.B, plant.B_w)
    if order is None:
        return None
    seen = np.flatnonzero(np.abs(plant.C).max(axis=0)[order].max(axis=0))
    if len(seen) != 1:
        return None
    first, n = order[0], order.shape[1]
    one = Plant(
        A=plant.A[np.ix_(first, first)], B=plant.B[first, :1], B_w=plant.B_w[first, :1], C=np.eye(n)[seen],
        process_noise=np.eye(1), initial_mean=np.zeros(n), initial_covariance=np.eye(n), axes=1,
    )  # fmt: skip
    return AlikeSystems(
        one=one, gains=np.ascontiguousarray(plant.C[:, order[:, seen[0]]]), noise_sd=np.sqrt(np.diag(W)), order=order
    )


@lru_cache(maxsize=64)
def lift(plant: Plant, n_steps: int) -> tuple[FloatArray, FloatArray]:
    """The plant over ``n_steps`` fast steps: A^N and Q_N = sum_i A^i B_w W B_w' A^i', both (n_states, n_states).

    By doubling, so that a gap of an hour costs no more than one of a second.
    """
    Q = plant.B_w @ plant.process_noise @ plant.B_w.T
    transition, noise = blockwise(partial(_lifted, n_steps), (plant.A, Q), components(plant.A, Q))
    return transition, noise


def _lifted(n_steps: int, power: FloatArray, power_noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    n = len(power)
    transition, noise = np.eye(n), np.zeros((n, n))
    while n_steps:
        if n_steps & 1:
            transition, noise = power @ transition, power @ noise @ power.T + power_noise
        power, power_noise = power @ power, power @ power_noise @ power.T + power_noise
        n_steps >>= 1
    return transition, (noise + noise.T) / 2


@lru_cache(maxsize=16)
def _block_maps(plant: Plant) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Maps over one block of L steps, transposed: inputs and start state to outputs, inputs and start state to end."""
    n_u, n_y, n = plant.n_inputs, plant.n_outputs, plant.n_states
    length = max(1, min(_BLOCK_STEPS, 2048 // max(n_u, n_y)))
    rows = output_rows(plant, length).transpose(1, 0, 2)  # C A^i, (L, n_y, n)
    impulse = rows @ plant.B
    toeplitz = np.zeros((length, n_y, length, n_u))
    kicks = np.empty((n, length, n_u))
    kick = plant.B
    for j in range(length):
        toeplitz[j + 1 :, :, j] = impulse[: length - 1 - j]
        kicks[:, length - 1 - j] = kick
        kick = plant.A @ kick
    maps = (
        toeplitz.reshape(length * n_y, length * n_u),
        rows.reshape(length * n_y, n),
        kicks.reshape(n, length * n_u),
        np.linalg.matrix_power(plant.A, length),
    )
    toeplitz_t, rows_t, kicks_t, transition_t = (np.ascontiguousarray(m.T) for m in maps)
    return toeplitz_t, rows_t, kicks_t, transition_t


def input_response(plant: Plant, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What the inputs do from rest.

    Parameters
    ----------
    u:
        Inputs at each fast step, (axes, k, n_inputs).

    Returns
    -------
    c:
        Response of the outputs within the steps, c_i = sum_{j<i} C A^(i-1-j) B u_j, (axes, n_outputs, k).
    d:
        Response of the state one step after the last, sum_j A^(k-1-j) B u_j, (axes, n_states). (The paper's
        printed predictor has the inputs in reverse order and one step early.)
    """
    axes, k, n_u = u.shape
    if not u.any():
        return np.zeros((axes, plant.n_outputs, k)), np.zeros((axes, plant.n_states))
    systems = alike_systems(plant)
    if systems is not None:
        own, ends = input_response(systems.one, u.transpose(0, 2, 1).reshape(axes * n_u, k, 1))
        paths = [blas.matmul(systems.gains, each) for each in own.reshape(axes, n_u, k)]
        end = np.empty((axes, plant.n_states))
        end[:, systems.order] = ends.reshape(axes, n_u, -1)
        return np.stack(paths), end
    toeplitz, rows, kicks, transition = _block_maps(plant)
    length = toeplitz.shape[0] // n_u
    # Zeros in front leave a plant at rest at rest, so the last block ends where the inputs do.
    n_blocks = -(-k // length)
    padded = np.zeros((axes, n_blocks * length, n_u))
    padded[:, n_blocks * length - k :] = u
    blocks = padded.reshape(axes, n_blocks, length * n_u)
    pushed = _times(blocks, kicks)
    starts = np.empty((axes, n_blocks, plant.n_states))
    state = np.zeros((axes, 1, plant.n_states))
    for b in range(n_blocks):
        starts[:, b] = state[:, 0]
        state = state @ transition + pushed[:, b, None]
    path = _times(blocks, toeplitz)
    path += _times(starts, rows)
    path = path.reshape(axes, n_blocks * length, plant.n_outputs)
    return np.ascontiguousarray(path[:, n_blocks * length - k :].transpose(0, 2, 1)), state[:, 0]


def _times(blocks: FloatArray, matrix: FloatArray) -> FloatArray:
    """blocks @ matrix, axis by axis in pieces so small that BLAS uses one thread: no bit depends on their number."""
    piece = max(1, _SMALL_PRODUCT // matrix.size)
    products = [blocks[:, k : k + piece] @ matrix for k in range(0, max(1, blocks.shape[1]), piece)]
    return products[0] if len(products) == 1 else np.concatenate(products, axis=1)


@dataclass(frozen=True, kw_only=True)
class Mode:
    """One eigenvalue of A (of a complex pair, the one above the axis)."""

    eigenvalue: complex
    frequency_hz: float
    time_constant_s: float
    """Time in which it falls to 1/e; infinite where it does not."""
    seen: bool
    """Whether the outputs see it at the fast rate, (A, C)."""
    seen_by_centroid: bool
    """Whether the mean over each exposure sees it, (A^N, C-bar)."""

    def __str__(self) -> str:
        lasts = "undamped" if math.isinf(self.time_constant_s) else f"time constant {self.time_constant_s:.3g} s"
        return f"the mode at {self.frequency_hz:.4g} Hz ({lasts})"


@dataclass(frozen=True, kw_only=True)
class ObservabilityReport:
    """What can be known of the plant's state (remarks 1 and 2 of Mishra & Wen)."""

    n_states: int
    rank: int
    """Dimension of the state space that the outputs see at the fast rate."""
    centroid_rank: int
    """Dimension that the means over exposures see; remark 1 holds where it equals ``rank``, and it need not."""
    modes: tuple[Mode, ...]
    o2_needs: str
    """What an estimator of the second moment alone (`o2`) needs before it can work."""

    @property
    def detectable(self) -> bool:
        """Whether every mode that the outputs do not see dies out by itself."""
        return all(m.seen or abs(m.eigenvalue) < 1 - 1e-9 for m in self.modes)

    @property
    def unseen(self) -> tuple[Mode, ...]:
        """Modes that the outputs do not see at the fast rate."""
        return tuple(m for m in self.modes if not m.seen)

    @property
    def lost_by_centroid(self) -> tuple[Mode, ...]:
        """Modes that the outputs see and the means over exposures do not."""
        return tuple(m for m in self.modes if m.seen and not m.seen_by_centroid)


def observability(plant: Plant, n_steps: int, fast_step_s: float) -> ObservabilityReport:
    """Rank of what the camera sees, mode by mode (Popov-Belevitch-Hautus), for exposures of ``n_steps``."""
    A, parts = plant.A, components(plant.A)
    transition, mean, square = blockwise(partial(_powers, n_steps), (A,), parts)
    values = _distinct(eigenvalues(A, parts))
    blind = [_unobservable(A, plant.C / np.linalg.norm(plant.C), value, parts) for value in values]
    # The outputs' mean over an exposure, in units of what they are in its steps.
    centroid = plant.C @ mean / math.sqrt(float(((plant.C @ square) * plant.C).sum()))
    lifted = values**n_steps
    distinct = _distinct(lifted)
    lost = [_unobservable(transition, centroid, value, parts) for value in distinct]
    modes = []
    for value, value_n, unseen in zip(values, lifted, blind, strict=True):
        if value.imag < 0:
            continue
        radius = abs(value)
        modes.append(
            Mode(
                eigenvalue=complex(value),
                frequency_hz=float(abs(np.angle(value))) / (2 * math.pi * fast_step_s),
                time_constant_s=math.inf if radius >= 1 - 1e-12 else -fast_step_s / math.log(max(radius, 1e-300)),
                seen=not unseen.shape[1],
                seen_by_centroid=abs(value_n) < _FORGOTTEN
                or not any(
                    _has_part_in(A, value, space, parts)
                    for other, space in zip(distinct, lost, strict=True)
                    if abs(other - value_n) < _SAME
                ),
            )
        )
    n = plant.n_states
    stable = bool(np.abs(lifted).max() < 1 - 1e-9)
    # Eigenvectors of different eigenvalues are independent.
    rank, centroid_rank = (n - sum(space.shape[1] for space in spaces) for spaces in (blind, lost))
    return ObservabilityReport(
        n_states=n,
        rank=rank,
        centroid_rank=centroid_rank,
        modes=tuple(modes),
        o2_needs=_o2_needs(stable, centroid_rank == n),
    )


def _powers(n_steps: int, A: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A^N, and the means of A^i and of A^i A^i' for i from 0 to N - 1."""
    power, total, squares = np.eye(len(A)), np.zeros_like(A), np.zeros_like(A)
    for _ in range(n_steps):
        total += power
        squares += power @ power.T
        power = power @ A
    return power, total / n_steps, squares / n_steps


def _distinct(values: NDArray[Any]) -> NDArray[Any]:
    """Values without repetition: a mirror's actuators are alike, and what holds for one holds for all."""
    keep: list[complex] = []
    for value in values:
        if all(abs(value - other) > _SAME for other in keep):
            keep.append(value)
    return np.array(keep)


def _unobservable(A: FloatArray, C: FloatArray, value: complex, parts: list[Indices]) -> NDArray[Any]:
    """Basis of the eigenvectors for a value that (A, C) cannot tell from zero, (n_states, dimension), orthonormal."""
    vectors = null_space(A, value, parts, _SAME)
    seen = C @ vectors
    if not vectors.shape[1]:
        return vectors
    if len(seen) > vectors.shape[1]:
        seen = np.linalg.qr(seen)[1]
    _, sizes, rows = np.linalg.svd(seen)
    hidden = np.concatenate([sizes, np.zeros(len(rows) - len(sizes))]) < _UNSEEN
    return np.asarray(vectors @ rows[hidden].conj().T)


def _has_part_in(A: FloatArray, value: complex, space: NDArray[Any], parts: list[Indices]) -> bool:
    """Whether the invariant subspace of an eigenvalue of A has a part in ``space``."""
    if not space.shape[1]:
        return False
    # The eigenvalue's own left space: what it cannot annihilate has a part in the mode.
    left = null_space(A, value, parts, _SAME, left=True, power=len(A))
    return bool(np.linalg.norm(left.conj().T @ space) > 1e-6)


def _o2_needs(stable: bool, observable: bool) -> str:
    needs = [
        "a spot off centre (drive.offset or drive.amplitude, or plant.initial_mean): at zero state and input"
        " the second moment's slope is zero, and x and -x look alike"
    ]
    if not stable:
        needs.append("a plant that forgets (every eigenvalue of A inside the unit circle): this one does not")
    if not observable:
        needs.append("a state that the centroid sees whole, (A^N, C-bar) observable: this one is not")
    return "; ".join(needs)


def nominal_path(rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Where the spot goes under the drive without noise, and how far noise takes it from there.

    Returns
    -------
    The path from the initial mean until the drive has been round twice after the plant settled,
    (axes * n_outputs, steps), and the largest standard deviation of each output in that time, (axes * n_outputs,).
    """
    plant, timing = rig.plant, rig.timing
    radius = float(np.abs(eigenvalues(plant.A, components(plant.A))).max())
    settle = 5 / -math.log(radius) if 0 < radius < 1 - 1e-9 else 100 * timing.exposure_steps
    turns = 2 * rig.drive.period_s / timing.fast_step_s if rig.drive.kind == "sine" else 0
    n_steps = int(min(_LARGEST_CHECK, max(timing.exposure_steps, settle) + turns))
    u = rig.drive.inputs(0, n_steps, timing.fast_step_s).reshape(n_steps, plant.axes, plant.n_inputs)
    response, _ = input_response(plant, u.transpose(1, 0, 2))
    path = response
    if plant.initial_mean.any():
        path = path + output_rows(plant, n_steps) @ plant.initial_mean
    transition, noise = lift(plant, n_steps)
    late = plant.C @ (transition @ plant.initial_covariance @ transition.T + noise) @ plant.C.T
    early = plant.C @ plant.initial_covariance @ plant.C.T
    sd = np.sqrt(np.maximum(np.diag(late), np.diag(early)))
    return path.reshape(rig.n_outputs, n_steps), np.tile(sd, plant.axes)
