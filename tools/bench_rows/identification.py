"""Rows about `aolink identify`: on recordings (logs) drawn at random, whether its sets hold the truth; and the
diffusion of the film of spheres."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from paper_report.spheres import FILE as SPHERES
from paper_report.spheres import spheres as film_of_spheres
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
    space = space_of(log.kinds, seen, log.rig.sensor.kernel.variance, with_noise=False, with_kernel=False)
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


_PICTURES = 12
"""Frames from one key frame of the film's compression to the next."""
_KEY = (8, 10)
"""The steps between frames, counted in such a group, that are taken as those at its key frame."""


@dataclass(frozen=True)
class Diffusion:
    """Variance that each sphere gains in a frame period along one direction, pixels squared, (spheres,)."""

    ours: NDArray[np.float64]
    pylake: NDArray[np.float64]
    """With the noise of the positions that single frames have."""
    unknown: NDArray[np.float64]
    """By pylake too, with a noise of the positions that is estimated with it."""
    noise: float
    """That noise, the mean over the tracks, pixels squared."""


def spheres(effort: Effort) -> list[Row]:
    """Diffusion of the film of spheres from sums of frames, with the standard error over the spheres, beside pylake's
    estimate on the tracks of the same frames. The ratio is the joint standard error over the difference.

    Pylake's estimate depends on the blur only if the noise of the positions is known, so it is given that of single
    frames. The estimate that is printed after it comes with a noise of its own, which has no bounds.

    The film's compression delays motion, so that single frames one after the other show less of it than frames further
    apart (`compression`). So sums are compared with single frames as far apart as they are, too.
    """
    frames = (1, 2, 3, 4, 6, 8, 12) if effort == FULL else (8,)
    rig, single, _ = film_of_spheres(1)
    tracks, seen = _positions(rig, single), readings(rig, single, kernel_known=False)
    noise = float(by_pylake(tracks, 1).noise.mean())
    found = {count: diffusion(count, noise) for count in frames}
    first = found[frames[0]]
    rows = []
    for count, each in found.items():
        off = _apart(each.ours, each.pylake)
        rows.append(Row(
            f"spheres, sums of {count}: pixels squared a frame", _shown(each.ours),
            f"pylake {_shown(each.pylake)}, {off:+.1f} sd; by sphere {_shown(each.ours - each.pylake)}; with noise"
            f" {each.noise:+.3f} {_shown(each.unknown)}", 1 / max(abs(off), 1e-3), 1.0,
        ))  # fmt: skip
        if count != frames[0]:
            off = _apart(each.ours, first.ours)
            rows.append(Row(
                f"spheres, sums of {count} less single frames", f"{off:+.1f} sd",
                f"pylake {_apart(each.pylake, first.pylake):+.1f} sd", 1 / max(abs(off), 1e-3), 1.0,
            ))  # fmt: skip
    for count in frames:
        if count == 1:
            continue
        starts = range(effort.of(count))
        ours = np.mean([_ours(rig, every(seen, count, start)) for start in starts], axis=0)
        theirs = np.mean([
            _of_spheres(by_pylake(tracks[:, start::count], count, noise, exposed=1)) for start in starts
        ], axis=0)  # fmt: skip
        off = _apart(found[count].ours, ours)
        rows.append(Row(
            f"spheres, single frames {count} apart: pixels squared a frame", _shown(ours),
            f"sums of {count} {off:+.1f} sd; pylake {_shown(theirs)}, its sums"
            f" {_apart(found[count].pylake, theirs):+.1f} sd", 1 / max(abs(off), 1e-3), 1.0,
        ))  # fmt: skip
    return [*rows, *compression()]


def every(seen: Readings, count: int, start: int) -> Readings:
    """Readings of which only each slot of so many is used, from ``start`` on; inputs stay as they are."""
    slots = np.arange(seen.slots)
    return replace(seen, usable=seen.usable & (slots % count == start))


def _apart(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """The difference of two means over the spheres, in joint standard errors."""
    return float((one.mean() - other.mean()) / math.hypot(_error(one), _error(other)))


def _error(values: NDArray[np.float64]) -> float:
    """The standard error of the mean."""
    return float(values.std(ddof=1) / math.sqrt(len(values)))


def _shown(values: NDArray[np.float64]) -> str:
    return f"{values.mean():.3f} +- {_error(values):.3f}"


def diffusion(frames: int, noise: float) -> Diffusion:
    """The spheres' diffusion from sums of so many frames, each sphere with a noise and a kernel of its own, and by
    pylake's covariance estimator on the means of the positions in these frames, whose noise has the variance ``noise``
    in a single frame, pixels squared."""
    rig, exposures, _ = film_of_spheres(frames)
    ours, positions = _ours(rig, readings(rig, exposures, kernel_known=False)), _positions(rig, exposures)
    known, unknown = by_pylake(positions, frames, noise / frames), by_pylake(positions, frames)
    return Diffusion(ours, _of_spheres(known), _of_spheres(unknown), float(unknown.noise.mean()))


def _ours(rig: Rig, seen: Readings) -> NDArray[np.float64]:
    """Variance that each sphere gains in a frame along one direction, pixels squared, (spheres,)."""
    found = []
    for x in range(0, rig.n_outputs, 2):
        one = [seen.of_outputs(range(x, x + 2))]
        space = space_of(["random-walk"], one, rig.sensor.kernel.variance, with_noise=True, with_kernel=True)
        found.append(math.exp(maxima(space, one)[0].x[0]))
    return np.array(found) * rig.timing.fast_step_s / rig.sensor.pixel_width**2


def _positions(rig: Rig, exposures: Sequence[Exposure]) -> NDArray[np.float64]:
    """Each sphere's mean position in each exposure, (12, exposures), pixels; NaN where a frame has none."""
    moves = np.cumsum([each.inputs.sum(axis=0) for each in exposures], axis=0)
    moves = np.vstack([np.zeros(moves.shape[1]), moves[:-1]])
    return np.array([
        np.full(rig.n_outputs, np.nan) if each.truth is None else each.truth.path.mean(axis=1) - move
        for each, move in zip(exposures, moves, strict=True)
    ]).T / rig.sensor.pixel_width  # fmt: skip


class ByPylake(NamedTuple):
    """Pylake's results for each track, pixels squared."""

    intensity: NDArray[np.float64]
    """Variance gained in a frame."""
    noise: NDArray[np.float64]
    """Variance of the positions' noise."""


def _of_spheres(found: ByPylake) -> NDArray[np.float64]:
    """Each sphere's intensity, the mean of both directions, (spheres,)."""
    return np.asarray(found.intensity.reshape(-1, 2).mean(axis=1))


def by_pylake(
    tracks: NDArray[np.float64], frames: int, noise: float | None = None, *, exposed: int | None = None
) -> ByPylake:
    """Pylake's covariance estimator on tracks (tracks, exposures) of positions so many frames apart, NaN where there is
    none. They are means of ``exposed`` frames, of all if it is None; ``noise`` is the variance of the positions' noise,
    if it is known."""
    from lumicks.pylake.detail.pixel_calibration import PositionUnit
    from lumicks.pylake.kymotracker.detail.msd_estimation import estimate_diffusion_cve

    exact, blur = None if noise is None else 0.0, (frames if exposed is None else exposed) / frames / 6
    found = []
    for track in tracks:
        at = np.flatnonzero(np.isfinite(track))
        one = estimate_diffusion_cve(
            at, track[at], dt=frames, blur_constant=blur, unit=PositionUnit.pixel, localization_var=noise,
            var_of_localization_var=exact,
        )  # fmt: skip
        found.append((2 * float(one.value), float(one.localization_variance)))
    return ByPylake(*np.array(found).T)


def _tracks() -> NDArray[np.float64]:
    """The spheres' tracks in single frames, (12, frames), pixels."""
    xy = np.load(SPHERES)["tracked_xy"]
    return np.asarray(xy.transpose(0, 2, 1).reshape(-1, xy.shape[1]))


def compression() -> list[Row]:
    """What the film's compression does to single frames: motion comes late, and with a group's key frame at once.

    Noise and exposure add the same to each mean square, so its growth from lag to lag is the walk's intensity.
    """
    tracks = _tracks()
    steps = np.diff(tracks, axis=1)
    lagged = (steps[:, 2:] * steps[:, :-2]).mean(axis=1)
    sd = lagged.std(ddof=1) / math.sqrt(len(lagged))
    at = np.arange(steps.shape[1]) % _PICTURES
    key = (at >= _KEY[0]) & (at < _KEY[1])
    soon, later = _growth(tracks, 1, 2), _growth(tracks, 6, 12)
    return [
        Row(
            "tracks: covariance of steps two frames apart", f"{lagged.mean():.4f} +- {sd:.4f} px2",
            "0, whatever the shutter", abs(lagged.mean()) / sd, 0.0,
        ),
        Row(
            f"tracks: square of the steps at one of {_PICTURES} frames", f"{(steps[:, key] ** 2).mean():.3f} px2",
            f"{(steps[:, ~key] ** 2).mean():.3f} px2 elsewhere",
            float((steps[:, key] ** 2).mean() / (steps[:, ~key] ** 2).mean()), 0.0,
        ),
        Row(
            "tracks: growth of the mean square displacement, 6 to 12 frames", f"{_shown(later)} px2",
            f"{_shown(soon)} px2, 1 to 2 frames; by sphere {_shown(later - soon)} more",
            (later - soon).mean() / _error(later - soon), 0.0,
        ),
    ]  # fmt: skip


def _growth(tracks: NDArray[np.float64], first: int, last: int) -> NDArray[np.float64]:
    """Growth of each sphere's mean square displacement along one direction between two lags, a frame, (spheres,)."""
    one, other = (((tracks[:, lag:] - tracks[:, :-lag]) ** 2).mean(axis=1) for lag in (first, last))
    return np.asarray((other - one).reshape(-1, 2).mean(axis=1) / (last - first))
