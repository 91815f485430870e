"""The distance of each estimator from the limit of the pixels' information: `sampled`, run twice, is that limit."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from judging.sampled import estimator as estimator_named
from numpy.typing import NDArray
from scipy import special

from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import SpotSensor
from aolink.rig import Rig, load_rig
from aolink.simulation.model import simulate
from paper_report import ensemble as runs_of
from paper_report.blocks import Block, Heading, PageFigure, Table, Text
from paper_report.ensemble import IntervalEstimate, measure_errors, normalised, ratio, side_by_side, variant
from paper_report.numbers import Effort
from paper_report.shake import shaken

NAMES = ("open-loop", "o1", "o3", "moments", "profile", "sampled")
BETTER_THAN_O1 = ("moments", "profile")
"""Estimators that have to be at least as good as o1 in every scene."""


@dataclass(frozen=True)
class SceneErrors:
    """One estimator in one scene."""

    path: float
    """RMSE of the path."""
    end: float
    """RMS of the end state's norm."""
    nees: float
    """NEES of the end state, over its number of states."""
    nees_low: float
    nees_high: float
    """95 % bounds of that for errors that are independent from exposure to exposure."""
    inside: float
    """Share of the path within its 95 % intervals."""
    distance: float
    """RMS distance of the path from the limit's, in its standard deviations, without the sampler's own noise."""
    time_ms: float
    """Time for an axis and an exposure, ms."""
    single: tuple[float, float, float]
    """Exposures in which `profile` found a single mode: their share, the distance and the NEES there."""


@dataclass(frozen=True)
class Scene:
    """One row of the table."""

    name: str
    found: dict[str, SceneErrors]


def scenes(runs: int, count: int) -> Iterator[tuple[str, Rig, list[Exposure]]]:
    """Rigs and a number of exposures of each; the runs are side by side as axes."""
    printed, lively = load_rig("section-vi"), variant(load_rig("section-vi-lively"), offset=0.0)
    rigs = [("section VI as printed", variant(printed, offset=0.0))]
    rigs += [(f"lively, V = {V:g}", variant(lively, noise_density=V)) for V in (0.1, 0.01, 0.001)]
    rigs += [(f"12 Hz shake, V = {V:g}", shaken(printed, 12.0, V)) for V in (0.1, 0.01, 0.001, 0.0001)]
    for k, (name, rig) in enumerate(rigs):
        yield name, *_side_by_side(rig, runs, count, np.zeros(count * 200), 700 + k)
    time_s = 1e-3 * np.arange(count * 200)
    end_s = time_s[-1]
    step = np.where(time_s > 0.55 * end_s, 0.03, -0.03)
    chirp = 0.05 * np.sin(2 * math.pi * time_s * (0.5 + 3.5 * time_s / (2 * end_s)))
    for name, u in (("commanded step", step), ("commanded chirp, 0.5 to 4 Hz", chirp)):
        yield f"{name}, V = 0.01", *_side_by_side(lively, runs, count, u, 720)
    plane = load_rig("single-lenslet")
    assert isinstance(plane.sensor, SpotSensor)
    u = plane.drive.inputs(0, count * plane.timing.exposure_steps, plane.timing.fast_step_s)
    plant, sensor = dataclasses.replace(plane.plant, axes=2 * runs), dataclasses.replace(plane.sensor, grid=(1, runs))
    many = dataclasses.replace(plane, plant=plant, sensor=sensor)
    yield "2-D spots", many, simulate(many, count, 730, inputs=np.tile(u, (1, runs)))


def _side_by_side(rig: Rig, runs: int, count: int, u: FloatArray, seed: int) -> tuple[Rig, list[Exposure]]:
    many = side_by_side(rig, runs)
    silent = dataclasses.replace(many, sensor=dataclasses.replace(many.sensor, noise_density=0.0))
    inputs = np.tile(u[:, None], (1, runs))
    return many, runs_of.with_pixel_noise(many, simulate(silent, count, seed, inputs=inputs), seed + 1)


def limit_table(effort: Effort) -> list[Scene]:
    """All estimators in all scenes, on the same frames."""
    table = []
    for name, rig, exposures in scenes(effort.limit_runs, effort.limit_exposures):
        estimates: dict[str, list[Estimate]] = {}
        seconds: dict[str, float] = {}
        single: list[NDArray[np.bool_]] = []
        for each in (*NAMES, "again"):
            name, seed = ("sampled", 1) if each == "again" else (each, 0)
            estimator = estimator_named(rig, name, particles=effort.particles, seed=seed)
            start = time.perf_counter()
            estimates[each] = []
            for exposure in exposures:
                estimates[each].append(estimator.step(exposure))
                if each == "profile" and estimator.several is not None:
                    single.append(~estimator.several)
            seconds[each] = time.perf_counter() - start
        limits = estimates["sampled"], estimates.pop("again")
        per = rig.plant.axes * len(exposures)
        table.append(
            Scene(name, {
                each: _found(exposures, estimates[each], limits, single, effort.limit_skip, seconds[each] * 1e3 / per)
                for each in NAMES
            })
        )  # fmt: skip
    return table


def against_o1(effort: Effort) -> list[tuple[str, dict[str, IntervalEstimate]]]:
    """Ratio of the path's RMSE to o1's in each scene, in more runs than the sampler has time for."""
    table = []
    for name, rig, exposures in scenes(effort.o1_runs, effort.o1_exposures):
        found = measure_errors(rig, exposures, ["o1", *BETTER_THAN_O1], effort.limit_skip)
        table.append((name, {each: ratio(found[each].path, found["o1"].path) for each in BETTER_THAN_O1}))
    return table


def against_o1_section(table: Sequence[tuple[str, dict[str, IntervalEstimate]]], effort: Effort) -> list[Block]:
    """The ratios, and the largest of them."""
    worst = {each: max(table, key=lambda row: row[1][each].high) for each in BETTER_THAN_O1}
    bounds = "; ".join(f"{each} {row[1][each].high:.3f} ({row[0]})" for each, row in worst.items())
    return [
        Heading("Not worse than o1, anywhere"),
        Text(
            f"RMSE of the path over o1's on the same frames, {effort.o1_runs} runs of {effort.o1_exposures} exposures,"
            f" the first {effort.limit_skip} not scored, all others counted, with the 95 % interval of a bootstrap over"
            f" the runs. The largest upper bounds: {bounds}."
        ),
        Table(["scene", *BETTER_THAN_O1], [[name, *(row[n].interval for n in BETTER_THAN_O1)] for name, row in table]),
    ]


def _found(
    exposures: Sequence[Exposure], estimates: Sequence[Estimate], limits: tuple[list[Estimate], list[Estimate]],
    single: Sequence[NDArray[np.bool_]], skip: int, time_ms: float,
) -> SceneErrors:  # fmt: skip
    path, end, nees, inside, product, variance = [], [], [], [], [], []
    for exposure, e, one, two in list(zip(exposures, estimates, *limits, strict=True))[skip:]:
        truth = exposure.truth
        assert truth is not None
        error = e.path - truth.path
        path.append(np.mean(error**2))
        inside.append(np.mean(np.abs(error) < 1.96 * e.path_sd))
        away = e.end_state - truth.end_state
        end.append(np.mean(np.sum(away**2, axis=1)))
        nees.append(normalised(e, away))
        # Two independent runs of the sampler: their own noise has no part in the product.
        product.append(_of_axes((e.path - one.path) * (e.path - two.path), len(away)))
        variance.append(_of_axes(one.path_sd**2, len(away)))
    axes, states = estimates[0].end_state.shape
    samples = axes * len(nees)
    low, high = (2 * float(special.gammaincinv(samples * states / 2, p)) / (samples * states) for p in (0.025, 0.975))
    alone = np.array(single[skip:])
    return SceneErrors(
        path=math.sqrt(np.mean(path)), end=math.sqrt(np.mean(end)), nees=float(np.mean(nees)) / states, nees_low=low,
        nees_high=high, inside=float(np.mean(inside)),
        distance=_root(np.array(product), np.array(variance)), time_ms=time_ms,
        single=(
            float(alone.mean()), _root(np.array(product)[alone], np.array(variance)[alone]),
            float(np.array(nees)[alone].mean()) / states if alone.any() else math.nan,
        ),
    )  # fmt: skip


def _of_axes(values: FloatArray, axes: int) -> FloatArray:
    """Mean over outputs and steps, (axes,), of (axes * outputs, steps)."""
    return np.asarray(values.reshape(axes, -1).mean(axis=1))


def _root(square: FloatArray, variance: FloatArray) -> float:
    return math.sqrt(max(0.0, float(square.mean() / variance.mean()))) if len(square) else math.nan


def limit_section(table: Sequence[Scene], effort: Effort, picture: PageFigure) -> list[Block]:
    """One table for each quantity, scenes down and estimators across."""

    def rows(text: str, names: Sequence[str] = NAMES) -> list[list[str]]:
        return [[scene.name, *(format(getattr(scene.found[n], text), "#.3g") for n in names)] for scene in table]

    singles = [
        [scene.name, *(format(x, ".2f") if math.isfinite(x) else "-" for x in scene.found["profile"].single)]
        for scene in table
    ]
    first = table[0].found["o1"]
    below = NAMES[1:-1]
    times = [[n, f"{np.median([s.found[n].time_ms for s in table]):#.3g}"] for n in NAMES]
    return [
        Heading("How near to the limit"),
        Text(
            "Not the paper's: sampled, tempered sequential Monte Carlo on the pixels, is what the frames hold if the"
            f" model is right. {effort.limit_runs} runs of {effort.limit_exposures} exposures, the first"
            f" {effort.limit_skip} not scored; all estimators on the same frames, all frames counted. RMSE of the path:"
        ),
        Table(["scene", *NAMES], rows("path")),
        picture,
        Text(
            "Distance of the path from the limit's, rms, in the limit's own standard deviations; two runs of the"
            " sampler with other random numbers take its noise out. 0.32 costs 5 % in RMSE, 0.46 10 %."
        ),
        Table(["scene", *below], rows("distance", below)),
        Text(
            "Exposures in which profile saw one reading of the blur, no second mode of 5 %: their share, its distance"
            " and its NEES there:"
        ),
        Table(["scene", "share", "distance", "NEES"], singles),
        Text("RMSE of the end state's norm:"),
        Table(["scene", *NAMES], rows("end")),
        Text(
            "NEES of the end state, over the number of states: 1 where a covariance is right, and for errors that do"
            f" not hang together within {first.nees_low:.2f} to {first.nees_high:.2f}. Where the posterior has several"
            " modes the share of the path inside its 95 % intervals, below, says more."
        ),
        Table(["scene", *NAMES], rows("nees")),
        Table(["scene", *NAMES], rows("inside")),
        Text("Time for an axis and exposure, ms, median over the scenes:"),
        Table(["estimator", "ms"], times),
    ]  # fmt: skip
