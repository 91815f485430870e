"""Rows about the benefit of closing the loop under turbulence and a vibration, beside pyRTC's predictors and
the limit."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy import stats

from aolink import identification
from aolink.control import ControllerRow
from aolink.control.loop import centroids
from aolink.exposure import Exposure, residual_rms
from aolink.identification import Process, ProcessSum, by_pixels, candidates, identified_text, maxima, readings
from aolink.jobs.closed_loop import closed_loop
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig, load_rig, parse_rig
from bench_rows.disturbances import STEP_S, DisturbanceRun, likeliest, played, together, turbulence, vibration
from bench_rows.rivals import PREDICTORS, predicted, with_true_state
from bench_rows.row import Effort, Row

FROM_PATH = "o1 from the true path"
"""The estimator `o1` with a model that is fitted to the true slopes of the past, of the kinds that are identified."""
GAINS = (0.1, 0.3, 0.5, 0.7, 0.9, 1.1, 1.3)
_KERNEL_SD = 0.1 / math.sqrt(2)
"""Standard deviation of the kernel of the rig `loop`, slope units."""


@dataclass(frozen=True)
class Cell:
    """A disturbance, a camera, and the estimators that serve `lqg`."""

    turbulence: str
    """``own``, ``hcipy``, or empty for none."""
    vibration: float
    """Frequency of the vibration over the frame rate; 0 for none. Where there are both, their sd is equal."""
    widths: float = 1.5
    """Sd of the path over that of the kernel."""
    steps: int = 50
    """Fast steps in an exposure, and from frame to frame."""
    noise: float = 0.02
    """Sd of the centroid's noise (of a sum over all pixels) over that of the path."""
    estimators: tuple[str, ...] = ("o1", "moments", "profile")
    """Estimators with the known model of the disturbance."""
    identified: tuple[str, ...] = ()
    """Estimators with the model that is identified from the past exposures alone."""

    def __str__(self) -> str:
        kind = {"own": "turbulence", "hcipy": "HCIPy's turbulence", "": ""}[self.turbulence]
        at = f"vibration at {self.vibration:g}" if self.vibration else ""
        text = " + ".join(filter(None, (kind, at)))
        others = [
            f"{self.widths:g} widths" if self.widths != 1.5 else "", f"N = {self.steps}" if self.steps != 50 else "",
            f"noise {100 * self.noise:g} %" if self.noise != 0.02 else "",
        ]  # fmt: skip
        return ", ".join(filter(None, (text, *others)))

    @property
    def kinds(self) -> list[str]:
        """Kinds of the processes that are identified, as `aolink identify --model` names them."""
        return [kind for kind, there in (("second-order", self.turbulence), ("resonance", self.vibration)) if there]

    @property
    def sd(self) -> float:
        """Standard deviation of the path, slope units."""
        return self.widths * _KERNEL_SD

    def disturbance(self, steps: int, past: int, seed: int) -> DisturbanceRun:
        """Slopes of that many fast steps, the first ``past`` of them known."""
        parts, sd = [], self.sd / math.sqrt(bool(self.turbulence) + bool(self.vibration))
        if self.turbulence:
            parts.append(turbulence(self.turbulence, sd, steps, past, seed))
        if self.vibration:
            parts.append(vibration(self.vibration / (self.steps * STEP_S), sd, steps, seed))
        return together(parts)

    def rig(self, model: ProcessSum) -> Rig:
        """The rig `loop` with this camera and ``model``."""
        text = load_rig("loop").toml.replace("exposure_steps = 50", f"exposure_steps = {self.steps}")
        # The variance of the centroid is 2/3 V.
        text = text.replace("noise_density = 1e-5", f"noise_density = {1.5 * (self.noise * self.sd) ** 2:.6g}")
        return parse_rig(identified_text(text, parse_rig(text), [model]))


HEADLINE = tuple(Cell("own", at, identified=("o1", "profile")) for at in (2.4, 2.7))
# At 3.0 whole periods fit into an exposure: the centroid is zero.
TURBULENCE_AND_VIBRATION = (
    *(Cell("own", at) for at in (0.24, 0.6, 1.2, 1.5, 3.0, 3.3)), *(Cell("hcipy", at) for at in (2.4, 2.7)),
)  # fmt: skip
VIBRATION = (*(Cell("", at) for at in (0.24, 1.2, 1.5, 2.4, 2.7, 3.0, 3.3)), Cell("", 0.6, identified=("o1",)))
TURBULENCE = (Cell("hcipy", 0.0), Cell("own", 0.0, identified=("o1",)))
FACTORS = tuple(
    cell
    for at in (0.6, 2.4)
    for cell in (
        *(Cell("own", at, widths=widths) for widths in (0.5, 4.0)),
        *(Cell("own", at, steps=steps) for steps in (20, 200)),
        Cell("own", at, noise=0.1),
    )
)  # fmt: skip
"""Cells in which one factor is changed at a time from 1.5 widths, 50 steps and 2 %."""


@dataclass(frozen=True)
class Size:
    """How much of each cell is run."""

    seeds: Sequence[int] = range(701, 706)
    past: int = 200
    """Exposures with the mirror at rest, to which predictors are fitted and from which models are identified."""
    exposures: int = 100
    """Exposures after those, with the loop closed."""
    settled: int = 20
    """Number of the first of these, which are left out."""
    gains: Sequence[float] = GAINS


FULL = Size()
FRESH = Size(seeds=range(910, 914))
"""Other seeds than those with which the identification was built."""
SHORT = Size(seeds=range(1, 3), past=64, exposures=6, settled=3, gains=GAINS[:1])


@dataclass(frozen=True)
class Goal:
    """A goal: the bound of a ratio is at most ``limit``."""

    name: str
    over: str
    """What the ratio is to; empty for the best integrator."""
    limit: float


@dataclass(frozen=True)
class Measured:
    """Residual slopes at the fast rate of each seed, root mean square, slope units, by what closed the loop."""

    cell: Cell
    rms: Mapping[str, FloatArray]
    vibrations: tuple[float, ...]
    """Identified frequency of the vibration over the frame rate, by seed; empty where it was not searched for."""

    @cached_property
    def best(self) -> str:
        """The integrator with the best gain for these seeds, with hindsight."""
        return min((name for name in self.rms if name.startswith("integrator")), key=lambda name: self.rms[name].mean())

    @property
    def ours(self) -> list[str]:
        """The estimators that served `lqg`."""
        return [*self.cell.estimators, *(f"identified {name}" for name in self.cell.identified)]

    @property
    def goals(self) -> list[Goal]:
        """The goals of the cell, named before anything was measured."""
        cell, at, found = self.cell, self.cell.vibration, []
        as_named = (cell.widths, cell.steps, cell.noise) == (1.5, 50, 0.02)
        if not at:
            found += [Goal(name, "", 1.02) for name in self.ours]
        elif cell.turbulence and at in (2.4, 2.7) and as_named:
            found += [Goal(name, "", 0.95) for name in ("identified profile", "profile") if name in self.ours]
        elif 0.6 <= at <= 1.5 and cell.widths == 1.5:
            found.append(Goal("profile", "o1", 0.9))
        if at and "identified o1" in self.ours:
            found.append(Goal("identified o1", "o1", 1.05))
        return found

    def reaches(self, goal: Goal) -> bool:
        """Whether the bound keeps the goal."""
        return self.ratio(goal.name, goal.over).bound <= goal.limit

    def ratio(self, name: str, over: str = "") -> Ratio:
        """The ratio to the best integrator, or to another controller."""
        return Ratio.of(self.rms[name] / self.rms[over or self.best])


@dataclass(frozen=True)
class Ratio:
    """Mean of a ratio over seeds, and its one-sided 95 % bound (Student)."""

    mean: float
    bound: float

    @classmethod
    def of(cls, shares: FloatArray) -> Ratio:
        n = len(shares)
        more = stats.t.ppf(0.95, n - 1) * shares.std(ddof=1) / math.sqrt(n)
        return cls(float(shares.mean()), float(shares.mean() + more))

    def __str__(self) -> str:
        return f"{self.mean:.2f} (<{self.bound:.2f})"


def measured(cell: Cell, size: Size) -> Measured:
    """Close the loop of a cell by each controller, on the same disturbances."""
    each, models = zip(*(_of_seed(cell, seed, size) for seed in size.seeds), strict=True)
    vibrations = [
        process["frequency_hz"] * cell.steps * STEP_S
        for model in models if model for process in model.processes if process.kind == "resonance"
    ]  # fmt: skip
    return Measured(cell, {name: np.array([found[name] for found in each]) for name in each[0]}, tuple(vibrations))


def all_measured(cells: Sequence[Cell], short: bool, size: Size = FULL) -> Iterator[Measured]:
    """Each cell measured; in a short run only the first, with short exposures. Standard error output has the time of
    each."""
    for cell in [replace(cells[0], steps=20)] if short else cells:
        start = time.monotonic()
        yield measured(cell, SHORT if short else size)
        print(f"  {cell}: {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)


def _of_seed(cell: Cell, seed: int, size: Size) -> tuple[dict[str, float], ProcessSum | None]:
    past = size.past * cell.steps
    whole = cell.disturbance(past + (size.exposures + 1) * cell.steps, past, seed)
    ahead = replace(whole, slopes=whole.slopes[past:], states=whole.states[past:])
    rms: dict[str, float] = {}
    identified = None
    with TemporaryDirectory() as folder:

        def run(name: str, rig: Rig, controller: str | ControllerRow, estimator: str = "") -> None:
            series = [seen.exposure for seen in closed_loop(rig, controller, estimator, size.exposures, seed=seed)]
            rms[name] = residual_rms(series[size.settled :])

        def disturbed(model: ProcessSum) -> Rig:
            return played(cell.rig(model), ahead.slopes[:, None], Path(folder) / "ahead.toml")

        rig = disturbed(whole.model)
        run("open", rig, "")
        for gain in size.gains:
            run(f"integrator {gain:g}", replace(rig, control=replace(rig.control, gain=gain)), "integrator")
        before = played(cell.rig(whole.model), whole.slopes[:past, None], Path(folder) / "before.toml")
        earlier = [seen.exposure for seen in closed_loop(before, "", "", size.past, seed=seed + 10_000)]
        for name in PREDICTORS:
            run(name, rig, predicted(name, np.array([centroids(rig, exposure) for exposure in earlier])))
        for estimator in cell.estimators:
            run(estimator, rig, "lqg", estimator)
        if cell.identified:
            identified = _identified(cell, before, earlier)
            own = disturbed(identified)
            for estimator in cell.identified:
                run(f"identified {estimator}", own, "lqg", estimator)
            run(FROM_PATH, disturbed(_from_path(cell, whole, past)), "lqg", "o1")
        run("true state", rig, with_true_state(ahead))
    return rms, identified


def _identified(cell: Cell, rig: Rig, exposures: list[Exposure]) -> ProcessSum:
    """The model that `aolink identify --model` finds from blurred frames alone, without its intervals."""
    seen = [readings(rig, exposures)]
    space = identification.space_of(cell.kinds, seen)

    def rig_of(x: FloatArray) -> Rig:
        return cell.rig(space.model(x))

    tops = maxima(space, seen)
    found = [
        *candidates(space, tops, seen),
        *identification.scanned(space, tops, seen, rig_of, exposures).candidates,
    ]
    left = by_pixels(found, rig_of, exposures)
    return space.model(identification.refined(space, left[0].x, rig_of, exposures))


def _from_path(cell: Cell, whole: DisturbanceRun, past: int) -> ProcessSum:
    """The model of the same kinds that fits the true slopes of the past best: what no identification can exceed by
    much."""
    parts = [Process("second-order", (0.1, 0.03, cell.sd / math.sqrt(2)))] if cell.turbulence else []
    parts += [process for process in whole.model.processes if process.kind == "resonance"]
    return likeliest(whole.slopes[:past], ProcessSum(tuple(parts)))


def worth_headline(effort: Effort) -> list[Row]:
    """Turbulence and a vibration of equal sd at 2.4 and 2.7 times the frame rate, which centroids cannot reach; in a
    whole run on other seeds as well."""
    fresh = [] if effort.share < 1 else _rows(HEADLINE, effort, FRESH, "other seeds")
    return [*_rows(HEADLINE, effort), *fresh]


def worth_past(effort: Effort) -> list[Row]:
    """How much past a model needs in the same two cells, on ten other seeds: `o1` with a model that is fitted to the
    true path of 200 and of 600 exposures, over `o1` with the known model."""
    short = effort.share < 1
    seeds, pasts = (range(901, 903), (20, 40)) if short else (range(901, 911), (200, 600))
    return [
        Row(
            f"loop, {cell}: {FROM_PATH} of {past} exposures over the known model",
            str(Ratio.of(np.array([_fitted_over_known(cell, seed, past, pasts[-1], short) for seed in seeds]))),
            "1: the known model", 0.0, 0.0,
        )
        for cell in HEADLINE for past in pasts
    ]  # fmt: skip


def _fitted_over_known(cell: Cell, seed: int, past: int, longest: int, short: bool) -> float:
    """What `o1` leaves with the model that fits the last ``past`` of ``longest`` exposures' true path, over what it
    leaves with the known one."""
    size = SHORT if short else FULL
    known, before = (longest * cell.steps, (longest - past) * cell.steps)
    whole = cell.disturbance(known + (size.exposures + 1) * cell.steps, known, seed)
    fitted = _from_path(cell, replace(whole, slopes=whole.slopes[before:]), past * cell.steps)
    left = []
    with TemporaryDirectory() as folder:
        for model in (fitted, whole.model):
            rig = played(cell.rig(model), whole.slopes[known:, None], Path(folder) / "ahead.toml")
            series = [seen.exposure for seen in closed_loop(rig, "lqg", "o1", size.exposures, seed=seed)]
            left.append(residual_rms(series[size.settled :]))
    return left[0] / left[1]


def worth_vibrations(effort: Effort) -> list[Row]:
    """The same with the vibration at other frequencies, and with HCIPy's turbulence."""
    return _rows(TURBULENCE_AND_VIBRATION, effort)


def worth_resonance(effort: Effort) -> list[Row]:
    """A resonance alone."""
    return _rows(VIBRATION, effort)


def worth_air(effort: Effort) -> list[Row]:
    """Turbulence alone, where nothing is to be gained, and nothing to be lost."""
    return _rows(TURBULENCE, effort)


def worth_factors(effort: Effort) -> list[Row]:
    """Amplitude, exposure and noise, one at a time."""
    return _rows(FACTORS, effort)


def _rows(cells: Sequence[Cell], effort: Effort, size: Size = FULL, note: str = "") -> list[Row]:
    """A row for each cell, and one for each of its goals."""
    rows = []
    for each in all_measured(cells, effort.share < 1, size):
        figure = ", ".join(filter(None, ("loop", str(each.cell), note)))
        rows += [_row(figure, each), *(_goal_row(figure, each, goal) for goal in each.goals)]
    return rows


def _row(figure: str, each: Measured) -> Row:
    limits = ("true state", *([FROM_PATH] if each.cell.identified else []))
    theirs = [f"{name} {each.ratio(name)}" for name in (*PREDICTORS, *limits)]
    found = f"; vibration identified at {', '.join(f'{at:.2f}' for at in each.vibrations)}" if each.vibrations else ""
    return Row(
        figure, ", ".join(f"{name} {each.ratio(name)}" for name in each.ours) + found,
        f"{', '.join(theirs)}; {each.best} {each.rms[each.best].mean():.4f}, open {each.rms['open'].mean():.4f}",
        1 / min(each.ratio(name).mean for name in each.ours), 0.0,
    )  # fmt: skip


def _goal_row(figure: str, each: Measured, goal: Goal) -> Row:
    ratio = each.ratio(goal.name, goal.over)
    limit = f"; {FROM_PATH} {each.ratio(FROM_PATH, 'o1')}" if goal.name == "identified o1" and goal.over else ""
    return Row(
        f"{figure}: {goal.name} over {goal.over or 'the best integrator'}", str(ratio), f"below {goal.limit:g}{limit}",
        goal.limit / ratio.bound, 1.0,
    )  # fmt: skip
