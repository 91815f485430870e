"""The verdict on the model, on recordings whose rig file is right, or wrong in one thing.

A recording is one run of a scene: the rig file that the estimators get, and exposures of a rig that may differ from it.
Its frames are made here, so that kernels and light may be other than the simulated rig's.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from scipy import integrate, special

from aolink.estimation import make_estimator
from aolink.estimation.verdict import Fit, Verdict
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import pixel_noise_sd, to_counts
from aolink.optics.sensor import SpotSensor
from aolink.rig import Rig
from aolink.simulation.model import simulate
from judging.rows import BEYOND_95, Given, Judge, Line, Row, grouped, mean
from judging.scenes import commands_of, draw, plant_of, rig_of, with_flaws

Fault = Literal[
    "none", "fading light", "unmodelled line", "late exposure", "zero off", "process noise", "frequency", "airy",
    "coma", "wide kernel", "shot noise", "hot pixel", "second object",
]  # fmt: skip
FAULTS: tuple[Fault, ...] = get_args(Fault)[1:]
PIXELS = ("airy", "coma", "wide kernel", "shot noise", "hot pixel", "second object")
"""Faults whose evidence is in the pixels; that of the others is in the motion."""
EITHER = ("fading light", "zero off")
"""Faults that may be seen as either."""
HARMFUL = 0.85
"""Coverage below which a fault does harm."""
EXPOSURES = 100
_SETTLING = 4
_RIGHT = 20
"""Recordings with a right file for every one of a fault."""
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


def recording(seed: int, fault: Fault, exposures: int = EXPOSURES) -> Recording:
    """The recording of a seed with that fault; the scene is the seed's, with commands where the fault needs them."""
    rng = np.random.default_rng([55, seed, FAULTS.index(fault) + 1 if fault != "none" else 0])
    scene = dataclasses.replace(draw(seed), exposures=exposures)
    low, high = _SIZES.get(fault, (0.0, 0.0))
    size = float(np.exp(rng.uniform(math.log(low), math.log(high)))) if low else 0.0
    if fault == "late exposure":
        scene = dataclasses.replace(
            scene, command="sine", command_sd=float(rng.uniform(0.5, 1.5)),
            command_period=float(np.exp(rng.uniform(math.log(0.3), math.log(3.0)))),
        )  # fmt: skip
    rig, true = rig_of(scene, 1), scene
    if fault == "frequency":
        modes = tuple(dataclasses.replace(each, swings=each.swings * (1 + size)) for each in scene.modes)
        true = dataclasses.replace(scene, modes=modes)
    plant = dataclasses.replace(plant_of(true, rig.plant.axes), B=rig.plant.B)
    if fault == "process noise":
        plant = dataclasses.replace(
            plant, process_noise=plant.process_noise * size, initial_covariance=plant.initial_covariance * size
        )
    late = max(1, round(size * scene.steps)) if fault == "late exposure" else 0
    inputs = commands_of(scene, rig.plant, exposures * scene.period + late)
    made = simulate(dataclasses.replace(rig, plant=plant), exposures, seed, inputs=inputs[late:])
    seen = with_flaws(scene, rig, list(_frames(rig, made, inputs, rng, fault, size)))
    return Recording(rig=rig, exposures=list(seen), fault=fault, size=size)


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


def rows(seed: int, given: Given) -> Iterator[Row]:
    """The verdict of each estimator on the recordings of a seed: one with each fault, and as many with a right file as
    there are to one fault."""
    for name in given.estimators:
        for fault in FAULTS:
            yield verdict_on(recording(seed, fault), name)
        for k in range(_RIGHT):
            yield verdict_on(recording(seed + 1000 * (k + 1), "none"), name)


def verdict_on(made: Recording, name: str) -> Row:
    """The row of one recording by an estimator: the share of the path in the filter's own 95 % intervals; whether the
    model was said not to fit, the evidence of the last such verdict, and the share in the intervals from the first one
    on, -1 where there was none."""
    estimator = make_estimator(made.rig, name)
    own, after, called, last = [], [], False, Verdict(fit=Fit.UNKNOWN)
    for k, exposure in enumerate(made.exposures):
        estimate, truth = estimator.step(exposure), exposure.truth
        assert truth is not None
        verdict = estimate.verdict or last
        error, reach = np.abs(estimate.path - truth.path), BEYOND_95 * estimate.path_sd
        if k >= _SETTLING:
            own.append(np.mean(error < reach / verdict.widening))
        if verdict.fit is Fit.DOES_NOT_FIT:
            called, last = True, verdict
            after.append(np.mean(error < reach))
        elif not called:
            last = verdict
    return {
        "what": name, "fault": made.fault, "size": made.size, "inside": float(np.mean(own)), "called": called,
        "kind": last.kind, "after": float(np.mean(after)) if after else -1.0,
    }  # fmt: skip


def table(rows: Sequence[Row]) -> tuple[Line, Iterable[Line]]:
    """A line for each fault: how many recordings are called wrong, and the same of those whose intervals hold less than
    .85 of the path; how often the kind of evidence is right, and the coverage afterwards."""
    heads = ("estimator", "fault", "recordings", "called", "of harmful", "kind right", "inside", "afterwards")
    lines = []
    for name, each in grouped(rows).items():
        by_fault = grouped(each, "fault")
        by_fault["all faults"] = [row for row in each if row["fault"] != "none"]
        lines += [_line(name, fault, of_one) for fault, of_one in by_fault.items()]
    return heads, lines


def _line(name: str, fault: str, rows: Sequence[Row]) -> Line:
    harmful = [row for row in rows if row["inside"] < HARMFUL]
    found, called = [row for row in harmful if row["called"]], [row for row in rows if row["called"]]
    right = [row["fault"] in EITHER or (row["kind"] == "pixels") == (row["fault"] in PIXELS) for row in called]
    return (
        name, fault, str(len(rows)), str(len(called)), f"{len(found)} of {len(harmful)}",
        f"{sum(right)} of {len(right)}", mean([row["inside"] for row in found]), mean([row["after"] for row in found]),
    )  # fmt: skip


VERDICT = Judge(
    summary="the verdict on the model: false and true calls by fault, a recording of each, and 20 right ones, a seed",
    rows=rows, table=table, scenes=20,
)  # fmt: skip
