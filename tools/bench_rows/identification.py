"""Rows about `aolink identify`: on recordings (logs) drawn at random, whether its sets hold the truth."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy import stats

import aolink
from aolink.exposure import Exposure
from aolink.identification import Identified, Process, ProcessSum, Readings, identified, maxima, readings, space_of
from aolink.jobs.identify import Wanted, from_readings
from aolink.rig import Rig, parse_rig
from bench_rows.row import FULL, Effort, Row

_KINDS = (
    "resonance", "ornstein-uhlenbeck", "random-walk", "ornstein-uhlenbeck+resonance", "resonance", "second-order",
)  # fmt: skip
_STEP_S = 1e-3
_KERNEL_SD = 0.06
_FIRST_SEED, _FIRST_SEED_WITH_PIXELS = 30_000, 31_000


@dataclass(frozen=True)
class Log:
    """A log's disturbance and rig, drawn by its seed."""

    seed: int
    model: ProcessSum
    rig: Rig
    exposures: int

    @property
    def kinds(self) -> list[str]:
        return [process.kind for process in self.model.processes]


def drawn(seed: int) -> Log:
    """The log of a seed: kinds in turn; exposures of 50 or 100 steps, 64 to 128 of them; 0.3 to 3.6 cycles an exposure
    of damping 0.003 to 0.06; path sd of 0.5 to 4 kernel sds; noise densities V from 2e-5 to 1e-3."""
    random = np.random.default_rng(seed)
    steps, count = int(random.choice([50, 100])), int(random.choice([64, 96, 128]))
    exposure_s = steps * _STEP_S
    sd = _KERNEL_SD * math.exp(random.uniform(math.log(0.5), math.log(4)))
    noise = math.exp(random.uniform(math.log(2e-5), math.log(1e-3)))
    kinds = _KINDS[seed % len(_KINDS)].split("+")
    own = sd / math.sqrt(len(kinds))
    processes = []
    for kind in kinds:
        values: tuple[float, ...]
        if kind == "resonance":
            damping = math.log(0.003), math.log(0.06)
            values = (random.uniform(0.3, 3.6) / exposure_s, math.exp(random.uniform(*damping)), own)
        elif kind == "ornstein-uhlenbeck":
            correlation = exposure_s * math.exp(random.uniform(0, math.log(10)))
            values = (correlation, 2 * own**2 / correlation)
        elif kind == "second-order":
            correlation = exposure_s * math.exp(random.uniform(math.log(2), math.log(10)))
            values = (correlation, correlation * random.uniform(0.1, 0.5), own)
        else:
            share = math.exp(random.uniform(math.log(0.03), math.log(0.3)))
            values = (min(sd, 0.1) ** 2 / exposure_s * share / (count / 64),)
        processes.append(Process(kind, values))
    model = ProcessSum(tuple(processes))
    return Log(seed, model, parse_rig(_rig_text(model, steps, noise)), count)


def _rig_text(model: ProcessSum, steps: int, noise: float) -> str:
    space = model.state_space(_STEP_S, start_variance=0.01)
    A, B_w, C, W, P = (
        json.dumps(each.tolist()) for each in (space.A, space.B_w, space.C, space.W, space.initial_covariance)
    )
    return f"""
name = "drawn"
[plant]
A = {A}
B = {json.dumps([[0.0]] * len(space.A))}
B_w = {B_w}
C = {C}
process_noise = {W}
initial_covariance = {P}
[timing]
fast_step_s = {_STEP_S}
exposure_steps = {steps}
[sensor]
kind = "line"
pixels = 40
field = [-1.0, 1.0]
noise_density = {noise}
black_level = 8000
counts_per_density = 2000
kernel = {{ shape = "gaussian", sigma = {_KERNEL_SD * math.sqrt(2)} }}
[mirror]
input_min = -1.0
input_max = 1.0
"""


def held(seed: int) -> dict[str, bool]:
    """Whether the set of each parameter holds the truth, by kind and parameter, by mean and width of the blur alone."""
    log, seen, _ = _seen(seed)
    space = space_of(log.kinds, seen)
    return _held(log, identified(space, maxima(space, seen), seen))


def held_by_job(seed: int) -> dict[str, bool]:
    """The same for the sets that `aolink identify` gives, where all pixels decide between aliases."""
    log, seen, exposures = _seen(seed)
    (found,) = from_readings(log.rig, seen, exposures, Wanted(models=("+".join(log.kinds),))).found
    return _held(log, found.parameters)


def _seen(seed: int) -> tuple[Log, list[Readings], list[Exposure]]:
    log = drawn(seed)
    exposures = list(aolink.simulate(log.rig, log.exposures, seed=seed))
    return log, [readings(log.rig, exposures)], exposures


def _held(log: Log, sets: Sequence[Identified]) -> dict[str, bool]:
    truth = [value for process in log.model.processes for value in process.values]
    return {each.name.split(".")[-1]: each.holds(value) for each, value in zip(sets, truth, strict=True)}


def coverage(effort: Effort) -> list[Row]:
    """The share of the 95 % sets that hold the truth, against the least share that chance explains (1 in 40)."""
    seeds = range(_FIRST_SEED, _FIRST_SEED + (200 if effort == FULL else 1))
    return _coverage("95 % sets of", held, seeds)


def coverage_with_pixels(effort: Effort) -> list[Row]:
    """The same for `aolink identify` as a whole, on recordings of one vibration: of others the pixels decide nothing,
    and of a sum they take minutes."""
    drawn_seeds = range(_FIRST_SEED_WITH_PIXELS, _FIRST_SEED_WITH_PIXELS + 120)
    seeds = [seed for seed in drawn_seeds if _KINDS[seed % len(_KINDS)] == "resonance"]
    return _coverage("a vibration alone, with its pixels: 95 % sets of", held_by_job, seeds[: effort.of(40)])


def _coverage(what: str, judge: Callable[[int], dict[str, bool]], seeds: Sequence[int]) -> list[Row]:
    with ProcessPoolExecutor() as pool:
        logs = list(pool.map(judge, seeds))
    rows = []
    for name in dict.fromkeys(name for log in logs for name in log):
        hits = [log[name] for log in logs if name in log]
        least = float(stats.binom.ppf(0.025, len(hits), 0.95))
        rows.append(Row(
            f"{what} {name} that hold the truth", f"{sum(hits)} of {len(hits)}", f"{least:.0f}, binomial",
            sum(hits) / max(least, 1.0), 1.0,
        ))  # fmt: skip
    return rows
