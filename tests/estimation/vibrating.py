"""A rig whose spot several vibrations move."""

import dataclasses
import math

import numpy as np
from scipy.linalg import block_diag, expm, solve_discrete_lyapunov

from aolink.rig import load_rig

LIVELY = load_rig("section-vi-lively")


def vibrating(axes, frequencies_hz=(5.3, 11.7), damping=0.03, sd=0.15, noise_density=0.002):
    """Axes with two vibrations, each free in phase; the spot moves by several widths."""
    blocks = []
    for frequency in frequencies_hz:
        w = 2 * math.pi * frequency
        A = expm(np.array([[0, 1], [-w * w, -2 * damping * w]]) * LIVELY.timing.fast_step_s)
        push = np.array([[0.0], [1.0]])
        unit = solve_discrete_lyapunov(A, push @ push.T)
        gain = sd / math.sqrt(unit[0, 0])
        blocks.append((A, gain * push, gain**2 * unit))
    A, B_w, P = (block_diag(*each) for each in zip(*blocks, strict=True))
    plant = dataclasses.replace(
        LIVELY.plant, A=A, B=B_w[:, :1], B_w=B_w, C=np.array([[1.0, 0.0] * len(blocks)]),
        process_noise=np.eye(len(blocks)), initial_mean=np.zeros(len(A)), initial_covariance=P, axes=axes,
    )  # fmt: skip
    sensor = dataclasses.replace(LIVELY.sensor.profile, noise_density=noise_density, counts_per_density=1500.0)
    drive = dataclasses.replace(LIVELY.drive, kind="none", amplitude=np.zeros(axes), offset=np.zeros(axes))
    return dataclasses.replace(LIVELY, plant=plant, sensor=sensor, drive=drive)
