"""The plant lifted over many fast steps.

Everything here follows from x(k+1) = A x(k) + B u(k) + B_w w(k), theta(k) = C x(k), Mishra & Wen (1).
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from aolink.numerics.arrays import FloatArray
from aolink.numerics.batched import SMALL_PRODUCT
from aolink.numerics.block_diagonal import blockwise, components
from aolink.numerics.single_thread import matmul_one_thread
from aolink.plant.alike import alike_systems
from aolink.rig import Plant

_BLOCK_STEPS = 32


def output_rows(plant: Plant, n_steps: int) -> FloatArray:
    """C A^i for i = 0 .. n_steps - 1, (n_outputs, n_steps, n_states)."""
    rows, power = plant.C[None], plant.A
    while len(rows) < n_steps:
        rows = np.concatenate([rows, rows @ power])
        power = power @ power
    return np.ascontiguousarray(rows[:n_steps].transpose(1, 0, 2))


@lru_cache(maxsize=256)
def lift(plant: Plant, n_steps: int) -> tuple[FloatArray, FloatArray]:
    """The plant over ``n_steps`` fast steps: A^N and Q_N = sum_i A^i B_w W B_w' A^i', both (n_states, n_states).

    They are computed by doubling, so that a gap of an hour costs hardly more than one of a second.
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
    """Response of outputs and state to the inputs, from rest.

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
        paths = [matmul_one_thread(systems.gains, each) for each in own.reshape(axes, n_u, k)]
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
    """The product blocks @ matrix, axis by axis in pieces so small that BLAS uses one thread, so that no bit depends on
    the number of axes."""
    piece = max(1, SMALL_PRODUCT // matrix.size)
    products = [blocks[:, k : k + piece] @ matrix for k in range(0, max(1, blocks.shape[1]), piece)]
    return products[0] if len(products) == 1 else np.concatenate(products, axis=1)
