"""Disturbances of a loop, step by step, with the best prediction by one who has seen the true slopes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy import linalg, optimize, signal

from aolink.identification import Process, ProcessSum
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import psd_root
from aolink.optics.turbulence import FrozenFlow, Layer
from aolink.rig import Rig, load_rig

STEP_S = 1e-3
PUPIL_M = 0.5
WINDS_M_S = (5.0, 11.0)
"""Winds of the two layers, which blow in directions drawn by the seed."""
DAMPING = 0.002
_SHORTEST_M = PUPIL_M / 8
_PIXELS = 16
"""Pixels of HCIPy's screens across the pupil."""
_ORDER = 64
_RIDGE = 1e-9
_HIGHEST_HZ = 100.0
"""Highest frequency at which a model is fitted to the spectrum of turbulence, Hz."""


@dataclass(frozen=True, eq=False)
class DisturbanceRun:
    """Slopes at each fast step, and the state from which one who has seen all of them up to a step predicts the next.

    Row k of ``states``, (steps, n), goes with ``slopes[k]``, which is C x(k); the prediction is x(k+1) = A x(k).
    """

    slopes: FloatArray
    states: FloatArray
    A: FloatArray
    C: FloatArray
    model: ProcessSum
    """The model that an estimator is given."""


def played(believes: Rig, slopes: FloatArray, path: Path) -> Rig:
    """A rig with a file of its own that these slopes (steps, 1) disturb, whatever its model is."""
    np.save(path.with_suffix(".npy"), slopes)
    table = f'[disturbance]\nplant_noise = false\nrecorded = "{path.stem}.npy"\n\n[simulation]'
    path.write_text(believes.toml.replace("[simulation]", table, 1))
    return load_rig(path)


def by_model(
    rig: Rig, steps: int, random: np.random.Generator, state: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Slopes (steps, 1) by a rig's own model of its disturbance, and the state after them; without a state to begin
    with it is drawn."""
    model = None if rig.disturbance is None else rig.disturbance.model
    assert model is not None
    if state is None:
        state = psd_root(model.initial_covariance) @ random.standard_normal(len(model.A))
    root, slopes = model.B_w @ psd_root(model.process_noise), np.empty((steps, 1))
    for k, push in enumerate(random.standard_normal((steps, root.shape[1]))):
        slopes[k] = model.C @ state
        state = model.A @ state + root @ push
    return slopes, state


def together(parts: Sequence[DisturbanceRun]) -> DisturbanceRun:
    """The sum of independent disturbances."""
    return DisturbanceRun(
        np.sum([part.slopes for part in parts], axis=0), np.hstack([part.states for part in parts]),
        np.asarray(linalg.block_diag(*(part.A for part in parts))), np.hstack([part.C for part in parts]),
        ProcessSum(tuple(process for part in parts for process in part.model.processes)),
    )  # fmt: skip


def vibration(frequency_hz: float, sd: float, steps: int, seed: int) -> DisturbanceRun:
    """A vibration: a resonance that noise drives. Its model is the true one."""
    model = ProcessSum((Process("resonance", (frequency_hz, DAMPING, sd)),))
    space, random = model.state_space(STEP_S), np.random.default_rng([seed, 1])
    pushes = random.standard_normal((steps, len(space.A))) @ psd_root(space.W).T @ space.B_w.T
    states = np.empty((steps, len(space.A)))
    state = psd_root(space.initial_covariance) @ random.standard_normal(len(space.A))
    for k, push in enumerate(pushes):
        states[k] = state
        state = space.A @ state + push
    return DisturbanceRun(states @ space.C[0], states, space.A, space.C, model)


def turbulence(kind: str, sd: float, steps: int, past: int, seed: int) -> DisturbanceRun:
    """Tilt of two von Karman layers in frozen flow: ``own`` waves, or HCIPy's screens, ``hcipy``.

    It has no finite model. Two models are fitted to its true slopes in the first ``past`` steps: an autoregressive one,
    and for the estimators the sum of two processes of second order with the highest likelihood (Whittle).
    """
    slopes = sd * _tilt(kind, steps, seed)
    order = min(_ORDER, past // 4)
    A = _autoregressive(slopes[:past], order)
    led = np.concatenate([np.full(order - 1, slopes[0]), slopes])
    states = np.lib.stride_tricks.sliding_window_view(led, order)[:, ::-1]
    return DisturbanceRun(slopes, states, A, np.eye(1, order), likeliest(slopes[:past]))


@lru_cache(maxsize=16)
def _tilt(kind: str, steps: int, seed: int) -> FloatArray:
    """Tilt of mean zero and sd 1, (steps,)."""
    random = np.random.default_rng([seed, 2])
    made = np.sum([(_waves if kind == "own" else _screen)(wind, steps, random) for wind in WINDS_M_S], axis=0)
    return np.asarray((made - made.mean()) / made.std())


def _wind(speed_m_s: float, random: np.random.Generator) -> tuple[float, float]:
    turn = random.uniform(0, 2 * math.pi)
    return speed_m_s * math.cos(turn), speed_m_s * math.sin(turn)


def _waves(speed_m_s: float, steps: int, random: np.random.Generator) -> FloatArray:
    """Mean slope over a square pupil."""
    flow = FrozenFlow(Layer(r0_m=0.1, wind_m_s=_wind(speed_m_s, random)), random, shortest_m=_SHORTEST_M)
    k = flow.wave_numbers
    tilts = 1j * k[:, 0] * flow.amplitudes * np.prod(np.sinc(k * PUPIL_M / (2 * math.pi)), axis=1)
    times = STEP_S * np.arange(steps, dtype=np.float64)
    return np.concatenate([np.real(tilts @ flow.blown(times[k : k + 4096])) for k in range(0, steps, 4096)])


def _screen(speed_m_s: float, steps: int, random: np.random.Generator) -> FloatArray:
    """The mean slope by HCIPy's infinitely long screen: the difference of the phase between two sides of the pupil."""
    import hcipy

    side = _PIXELS + 1
    grid = hcipy.make_pupil_grid(side, PUPIL_M * side / _PIXELS)
    layer = hcipy.InfiniteAtmosphericLayer(
        grid, hcipy.Cn_squared_from_fried_parameter(0.1, 500e-9), 25.0, np.array(_wind(speed_m_s, random)),
        seed=int(random.integers(1 << 31)),
    )  # fmt: skip
    tilts = np.empty(steps)
    for k in range(steps):
        layer.evolve_until(k * STEP_S)
        phase = np.asarray(layer.phase_for(500e-9)).reshape(side, side)
        tilts[k] = (phase[:, -1] - phase[:, 0]).mean()
    return tilts


def _autoregressive(slopes: FloatArray, order: int) -> FloatArray:
    """The companion matrix of the least-squares fit, whose state is the last values, the newest first."""
    rows = np.lib.stride_tricks.sliding_window_view(slopes, order + 1)
    before, after = rows[:, -2::-1], rows[:, -1]
    normal = before.T @ before
    normal += _RIDGE * np.trace(normal) / order * np.eye(order)
    return np.vstack([np.linalg.solve(normal, before.T @ after), np.eye(order - 1, order)])


def likeliest(slopes: FloatArray, start: ProcessSum | None = None) -> ProcessSum:
    """The sum of processes with the highest likelihood (Whittle), searched from a start, whose kinds it keeps.

    Without a start: two processes of second order.
    """
    frequency, power = signal.periodogram(slopes, 1 / STEP_S, window="hann", detrend="constant")
    used = slice(2, int(np.searchsorted(frequency, _HIGHEST_HZ)))  # the taper mixes the first two with the mean
    omega, power, sd = 2 * math.pi * frequency[used], power[used] / 2, float(slopes.std())
    if start is None:
        two = ((0.3, 0.03, 0.7 * sd), (0.05, 0.01, 0.7 * sd))
        start = ProcessSum(tuple(Process("second-order", each) for each in two))

    def model(x: FloatArray) -> ProcessSum:
        values, processes = np.exp(x).tolist(), []
        for each in start.processes:
            processes.append(Process(each.kind, tuple(values[: len(each.values)])))
            values = values[len(each.values) :]
        return ProcessSum(tuple(processes))

    def minus_log_likelihood(x: FloatArray) -> float:
        density = np.zeros_like(omega)
        for each in model(x).processes:
            poles = each.poles[:, None]
            density += (each.residues[:, None] * -2 * poles / (poles**2 + omega**2)).sum(axis=0).real
        return float(np.sum(np.log(density) + power / density))

    limits = {
        "correlation_s": (1e-3, 10.0), "second_correlation_s": (1e-3, 10.0), "sd": (1e-3 * sd, 3 * sd),
        "frequency_hz": (frequency[1], _HIGHEST_HZ), "damping": (1e-4, 0.5),
    }  # fmt: skip
    bounds = [
        (math.log(low), math.log(high))
        for each in start.processes for low, high in (limits[name] for name in each.names)
    ]  # fmt: skip
    values = [value for each in start.processes for value in each.values]
    return model(optimize.minimize(minus_log_likelihood, np.log(values), method="L-BFGS-B", bounds=bounds).x)
