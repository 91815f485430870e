"""Recordings whose rig file is right, or wrong in one thing: what the verdict on the model is judged on.

A recording is one run of a scene of the family (`paper_report.family`): the rig file that the estimators get, and
exposures of a rig that may differ from it. Its frames are made here, so that kernels and light may be other than the
simulated rig's.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from scipy import integrate, special

from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import pixel_noise_sd, to_counts
from aolink.optics.sensor import SpotSensor
from aolink.rig import Rig
from aolink.simulation.model import simulate
from paper_report.family import Scene, commands_of, draw, plant_of, rig_of, with_flaws

Fault = Literal[
    "none", "fading light", "unmodelled line", "late exposure", "zero off", "process noise", "frequency", "airy",
    "coma", "wide kernel", "shot noise", "hot pixel", "second object",
]  # fmt: skip
FAULTS: tuple[Fault, ...] = get_args(Fault)[1:]
PIXELS = ("airy", "coma", "wide kernel", "shot noise", "hot pixel", "second object")
"""Faults whose evidence is in the pixels; that of the others is in the motion. `_EITHER` may count as both."""
EITHER = ("fading light", "zero off")
EXPOSURES = 100
_SIZES = {
    "fading light": (0.3, 0.9), "unmodelled line": (0.3, 3.0), "late exposure": (0.03, 0.1), "zero off": (0.1, 2.0),
    "process noise": (1.5, 4.0), "frequency": (0.02, 0.1), "airy": (1.0, 1.0), "coma": (0.5, 1.5),
    "wide kernel": (0.1, 0.4), "shot noise": (0.3, 3.0), "hot pixel": (4.0, 40.0), "second object": (0.02, 0.2),
}  # fmt: skip
"""Least and largest size: change of the light from the exposure's start to its middle; amplitude, in sds of the kernel;
share of the exposure; sds of the kernel; factor of W; relative changes; length of the tail, in sds of the kernel;
variance by shot noise in the brightest pixel over that by read-out; height, in sds of noise; share of the light."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Exposures with their truth, the rig file that estimators get, and what is wrong in it."""

    rig: Rig
    exposures: list[Exposure]
    fault: Fault
    size: float
    scene: Scene


def recording(seed: int, fault: Fault, exposures: int = EXPOSURES) -> Recording:
    """The recording of a seed with that fault; the scene is the seed's, with commands where the fault needs them."""
    rng = np.random.default_rng([55, seed, FAULTS.index(fault) + 1 if fault != "none" else 0])
    scene = draw(seed)
    low, high = _SIZES.get(fault, (0.0, 0.0))
    size = float(np.exp(rng.uniform(math.log(low), math.log(high)))) if low else 0.0
    if fault == "late exposure":
        scene = dataclasses.replace(
            scene, command="sine", command_sd=float(rng.uniform(0.5, 1.5)),
            command_period=float(np.exp(rng.uniform(math.log(0.3), math.log(3.0)))),
        )  # fmt: skip
    rig = rig_of(scene, 1, exposures)
    true = dataclasses.replace(rig, plant=_true_plant(scene, rig, exposures, fault, size))
    late = max(1, round(size * scene.steps)) if fault == "late exposure" else 0
    inputs = commands_of(scene, rig.plant, exposures * scene.period + late)
    made = simulate(true, exposures, seed, inputs=inputs[late:])
    return Recording(
        rig=rig, exposures=list(with_flaws(scene, rig, _frames(rig, made, inputs, rng, fault, size))), fault=fault,
        size=size, scene=scene,
    )  # fmt: skip


def _true_plant(scene: Scene, rig: Rig, exposures: int, fault: Fault, size: float):  # type: ignore[no-untyped-def]
    plant = rig.plant
    if fault == "frequency":
        modes = tuple(dataclasses.replace(each, swings=each.swings * (1 + size)) for each in scene.modes)
        moved = plant_of(dataclasses.replace(scene, modes=modes), plant.axes, exposures)
        return dataclasses.replace(moved, B=plant.B)
    if fault == "process noise":
        return dataclasses.replace(
            plant, process_noise=plant.process_noise * size, initial_covariance=plant.initial_covariance * size
        )
    return plant


def _frames(
    rig: Rig, made: list[Exposure], inputs: FloatArray, rng: np.random.Generator, fault: Fault, size: float
) -> Iterator[Exposure]:
    """The exposures as the faulty camera sees them, with the inputs that the file's timing gives them."""
    sensor, line = rig.sensor, rig.sensor.profile
    kernel, n = math.sqrt(sensor.kernel.variance), rig.timing.exposure_steps
    axes = rig.n_outputs
    tau = (np.arange(n) + 0.5) / n
    weights = (1 + (size if fault == "fading light" else 0.0) * (1 - 2 * tau)) / n
    turns = float(np.exp(rng.uniform(math.log(0.3), math.log(min(4.0, n / 10))))) / n
    phase = rng.uniform(0, 2 * math.pi, axes)
    where = rng.choice([-1, 1], axes) * rng.uniform(1.5, 4.0) * kernel
    centre = math.ceil(len(line.centres) / 2) + round(float(rng.uniform(-2, 2)) * kernel / line.pixel_width)
    table = _table(fault, size)
    for each in made:
        assert each.truth is not None
        path = each.truth.path
        if fault == "unmodelled line":
            k = each.first_step + np.arange(n)
            path = path + size * kernel * np.sin(2 * math.pi * turns * k + phase[:, None])
        if fault == "zero off":
            path = path + size * kernel
        wide = kernel * (1 + size) if fault == "wide kernel" else kernel
        light = _light(rig, path, weights, wide, table)
        if fault == "second object":
            light = (1 - size) * light + size * _light(rig, np.tile(where[:, None], n), weights, wide, None)
        read = pixel_noise_sd(sensor)
        noise = np.full(light.shape, read**2)
        if fault == "shot noise":
            noise = noise + size * read**2 * light / sensor.peak_density
        density = light + np.sqrt(noise) * rng.standard_normal(light.shape)
        if fault == "hot pixel":
            density[density.shape[0] // 2, centre] += size * read
        start, end = each.first_step, each.first_step + n
        lead = len(each.lead_inputs)
        yield dataclasses.replace(
            each, pixels=to_counts(sensor, density), inputs=inputs[start:end].copy(),
            lead_inputs=inputs[start - lead : start].copy(), truth=dataclasses.replace(each.truth, path=path),
        )  # fmt: skip


def _light(
    rig: Rig, path: FloatArray, weights: FloatArray, width: float, table: tuple[FloatArray, FloatArray] | None
) -> FloatArray:
    """Mean density in each pixel, (rows, columns), of spots on these paths, (n_outputs, n_steps)."""
    sensor, line = rig.sensor, rig.sensor.profile

    def masses(positions: FloatArray, shaped: bool) -> FloatArray:
        u = (line.edges - positions[:, None]) / width
        below = np.interp(u, *table) if table is not None and shaped else special.ndtr(u)
        return np.asarray(np.diff(below, axis=1))

    if not isinstance(sensor, SpotSensor):
        return (weights @ masses(path[0], True))[None] / sensor.pixel_size
    whole = np.zeros(sensor.shape)
    for spot in range(sensor.spots):
        x, y = masses(path[2 * spot], True), masses(path[2 * spot + 1], True)
        whole[sensor.window_of(spot)] = (y * weights[:, None]).T @ x / sensor.pixel_size
    return whole


@lru_cache(maxsize=8)
def _table(fault: Fault, size: float) -> tuple[FloatArray, FloatArray] | None:
    """Places, in sds of the file's Gaussian, and the share of the light below them, of a kernel of another shape."""
    u = np.linspace(-40, 40, 4001)
    if fault == "airy":  # the line spread of a round aperture, of the Gaussian's width at half height
        r = np.abs(u)[:, None] * 1.0
        y = np.linspace(0, 40, 801)[None]
        rho = 1.3721 * np.hypot(r, y) + 1e-12  # half height of the Airy pattern at 1.6163, of the Gaussian at 1.1774
        line = integrate.simpson((2 * special.j1(rho) / rho) ** 2, x=y[0], axis=1)
    elif fault == "coma":  # a Gaussian with an exponential tail, its mean in the middle
        line = np.zeros_like(u)
        v = np.linspace(0, 12, 200)
        for tail in v:
            line += np.exp(-tail) * np.exp(-((u - size * (tail - 1.0)) ** 2) / 2)
    else:
        return None
    below = np.concatenate([[0.0], np.cumsum((line[1:] + line[:-1]) / 2)])
    return u, below / below[-1]
