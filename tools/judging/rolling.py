"""Estimated paths of a camera that exposes row by row: row time known, said to be unknown, ignored.

Each scene is a plane of 4 x 4 spots that move by themselves and by a mirror with random commands, with a readout of a
fifth to nine tenths of the frame period, from the top or from the bottom. By the skew inside a spot the table has
coverage against the readout of four standard deviations of its light, over the exposure.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from aolink.estimation import run
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig
from aolink.rig.rows import possible_skew_ns
from aolink.simulation.model import simulate
from judging.rows import BEYOND_95, Given, Judge, Line, Row, grouped
from judging.scenes import PlantProcess, Scene, commands_of, draw, rig_of

_FIRST = 6
_SKEWS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6)


def _made(seed: int, grid: int) -> tuple[Rig, Scene, np.random.Generator]:
    """A rig without a row time, its scene, and the random numbers for all else."""
    rng = np.random.default_rng([22, seed])
    steps = int(rng.integers(60, 160))
    mode = PlantProcess(
        kind="resonance", swings=float(rng.uniform(0.3, 1.5)), damping=float(rng.uniform(0.005, 0.05)),
        sd=float(rng.uniform(0.05, 0.1)), direction=0.0,
    )  # fmt: skip
    scene = replace(
        draw(seed), geometry="plane", modes=(mode,), steps=steps, period=steps + int(rng.integers(0, steps)),
        path_widths=mode.sd / 0.05, kernel_pixels=1.5, peak_snr=float(rng.uniform(20, 100)), command="steps",
        command_sd=float(rng.uniform(0.5, 1.5)), command_period=float(rng.uniform(0.2, 1.0)),
    )  # fmt: skip
    return rig_of(scene, grid**2, (grid, grid)), scene, rng


def _seen(rig: Rig, scene: Scene, seed: int) -> tuple[list[Exposure], FloatArray]:
    """Exposures, and the inputs of all steps."""
    inputs = commands_of(scene, rig.plant, (scene.exposures + 1) * scene.period + rig.readout_steps)
    return simulate(rig, scene.exposures, seed, inputs=inputs), inputs


def at_once(exposures: list[Exposure], rig: Rig, inputs: FloatArray, *, said: bool) -> list[Exposure]:
    """The exposures with the inputs that a camera without a row time has, and what is said of it."""
    out, end = [], 0
    for each in exposures:
        first, after = each.first_step, each.first_step + rig.timing.exposure_steps
        sigma = possible_skew_ns(rig) if said else None
        out.append(replace(each, inputs=inputs[first:after], lead_inputs=inputs[end:first], row_sigma_ns=sigma))
        end = after
    return out


def _with_row_time(rig: Rig, row_time_s: float | None) -> Rig:
    return replace(rig, sensor=dataclasses.replace(rig.sensor, row_time_s=row_time_s))


def _coverage(rig: Rig, exposures: list[Exposure], given: Given) -> Iterator[tuple[str, float]]:
    """Share of the true path's points within 95 % of the estimates, by estimator."""
    for name, estimates in run(rig, exposures, given.estimators).items():
        hits = [
            np.abs(e.path - x.truth.path) < BEYOND_95 * e.path_sd
            for x, e in list(zip(exposures, estimates, strict=True))[_FIRST:] if x.truth is not None
        ]  # fmt: skip
        yield name, float(np.mean(hits))


def rows(seed: int, given: Given) -> Iterator[Row]:
    """Coverage where the row time is known, said to be unknown, and ignored."""
    flat, scene, rng = _made(seed, 4)
    share = rng.choice([-1, 1]) * rng.uniform(0.2, 0.9)
    period_s = scene.period * flat.timing.fast_step_s
    rig = _with_row_time(flat, float(share * period_s / flat.sensor.shape[0]))
    exposures, inputs = _seen(rig, scene, seed)
    for kind, own, seen in (
        ("known", rig, exposures), ("unknown", flat, at_once(exposures, flat, inputs, said=True)),
        ("ignored", flat, at_once(exposures, flat, inputs, said=False)),
    ):  # fmt: skip
        for name, inside in _coverage(own, seen, given):
            yield {"what": f"{name}, row time {kind}", "inside": inside}


def rows_of_skews(seed: int, given: Given) -> Iterator[Row]:
    """Coverage by the skew inside a spot."""
    for skew in _SKEWS:
        flat, scene, _ = _made(seed, 2)
        spot_rows = 4 * math.sqrt(flat.sensor.kernel.variance) / flat.sensor.pixel_width
        rig = _with_row_time(flat, skew * scene.steps * flat.timing.fast_step_s / spot_rows)
        for name, inside in _coverage(rig, _seen(rig, scene, seed)[0], given):
            yield {"what": f"{name}, rows {skew:.2f} of an exposure apart in a spot", "inside": inside}


def table(rows: Sequence[Row]) -> tuple[Line, Iterable[Line]]:
    """A line for each estimator and row time or skew."""
    lines = []
    for what, each in grouped(rows).items():
        inside = [row["inside"] for row in each]
        lines.append((what, str(len(inside)), f"{np.median(inside):.3f}", f"{min(inside):.3f}", f"{max(inside):.3f}"))
    return ("estimator", "scenes", "coverage: median", "least", "most"), lines


ROLLING = Judge(summary="cameras that expose row by row, by what is known of the row time", rows=rows, table=table)
SKEW = Judge(summary="the same by the skew inside a spot", rows=rows_of_skews, table=table, scenes=20)
