"""The spot's path without noise, which a check of the rig file compares with the field of view."""

from __future__ import annotations

import math

import numpy as np

from aolink.numerics.arrays import FloatArray
from aolink.numerics.block_diagonal import components, eigenvalues
from aolink.plant.lifting import input_response, lift, output_rows
from aolink.rig import Rig

_LARGEST_CHECK = 200_000


def nominal_path(rig: Rig) -> tuple[FloatArray, FloatArray]:
    """The spot's path under the drive without noise, and the standard deviation about it, both in slope units.

    Returns
    -------
    The path from the initial mean until two periods of the drive have passed after the plant settled,
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
