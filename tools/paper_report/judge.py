"""The judgement of estimators over the family: a row for each scene and estimator. It can be stopped and continued."""

from __future__ import annotations

import dataclasses
import itertools
import json
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from judging.sampled import NAME as LIMIT
from judging.sampled import estimator as estimator_named

from aolink.estimation import Estimate, smooth
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import SpotSensor
from aolink.rig import Rig
from paper_report.ensemble import SensorRows
from paper_report.family import SEEDS, Scene, draw, exposures_of

QUICK_NAMES = ("open-loop", "o1", "o3", "moments")
PIXEL_NAMES = ("profile",)
NAMES = (*QUICK_NAMES, *PIXEL_NAMES, LIMIT)
RECORDED = Path(__file__).with_name("family.jsonl")
"""Rows that the repository keeps, since they take hours: of reporting seeds, made by the commits that they name."""
_DIGITS = 6
"""Significant digits of numbers in a file of rows."""
BEYOND_95 = 1.959964
"""Standard deviations on either side of a 95 % interval."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """How much of each scene is judged."""

    runs: int = 24
    exposures: int = 24
    """Exposures of each run; a random walk gains its sd over these."""
    skip: int = 4
    """Exposures at the start that are not scored."""
    pixel_runs: int = 24
    """Runs, the first ones, for `profile`."""
    limit_runs: int = 3
    """Runs, the first ones, for `sampled`."""
    particles: int | None = None
    smoothed: bool = False
    """Whether smoothed estimates are scored, which all later exposures of their run have corrected."""

    def runs_of(self, name: str) -> int:
        """Runs for an estimator."""
        wanted = self.limit_runs if name == LIMIT else self.pixel_runs if name in PIXEL_NAMES else self.runs
        return min(wanted, self.runs)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One estimator in one scene; lists have a number for each run."""

    seed: int
    estimator: str
    states: int
    """States of the plant, the degrees of freedom of ``nees``."""
    scored: int
    """Number of scored exposures, in all runs."""
    path: list[float]
    """Mean squared error of the path, slope units squared."""
    inside: list[float]
    """Share of the path inside its 95 % intervals."""
    nees: list[float]
    """Mean of the end state's normalised squared error."""
    several: float
    """Share of exposures with more than one mode, where the estimator searches for modes; otherwise 0."""
    statuses: dict[str, int]
    """Exposures by their status, the worst of all runs: where a tenth of the runs does not see a faint spot, hardly an
    exposure is OK."""
    seconds: float
    """Time of the processor, s, for an exposure of one run."""
    commit: str = ""
    """The commit that was checked out when the row was made, with a + if files differed from it."""


def stratified(seeds: Sequence[int], count: int) -> list[int]:
    """Seeds whose scenes are spread evenly over the number of processes, and over fewer or more swings than one."""
    strata: dict[tuple[int, bool], list[int]] = {}
    for seed in seeds:
        scene = draw(seed)
        strata.setdefault((len(scene.modes), scene.swings > 1), []).append(seed)
    in_turn = (each[k] for k in range(len(seeds)) for _, each in sorted(strata.items()) if k < len(each))
    return list(itertools.islice(in_turn, count))


def judge(scene: Scene, names: Sequence[str], size: Size) -> Iterator[Row]:
    """The rows of a scene, one after the other; all estimators get the same frames, slow ones of fewer runs."""
    rig, exposures = exposures_of(scene, size.runs, size.exposures)
    for name in names:
        runs = size.runs_of(name)
        some = first_runs(rig, exposures, runs)
        estimator = estimator_named(some[0], name, particles=size.particles)
        start = time.process_time()
        estimates, several = [], []
        for exposure in some[1]:
            estimates.append(estimator.step(exposure))
            several.append(0.0 if estimator.several is None else float(estimator.several.mean()))
        if size.smoothed:
            estimates = smooth(some[0].plant, some[1], estimates)
        seconds = (time.process_time() - start) / (len(estimates) * runs)
        yield _row(
            scene.seed, name, some[1][size.skip :], estimates[size.skip :], runs, float(np.mean(several)), seconds
        )


def _row(
    seed: int, name: str, exposures: Sequence[Exposure], estimates: Sequence[Estimate], runs: int, several: float,
    seconds: float,
) -> Row:  # fmt: skip
    path: list[FloatArray] = []
    inside: list[FloatArray] = []
    nees: list[FloatArray] = []
    statuses: dict[str, int] = {}
    for exposure, e in zip(exposures, estimates, strict=True):
        truth = exposure.truth
        assert truth is not None
        error = (e.path - truth.path).reshape(runs, -1)
        path.append(np.mean(error**2, axis=1))
        inside.append(np.mean(np.abs(error) < BEYOND_95 * e.path_sd.reshape(runs, -1), axis=1))
        away = e.end_state - truth.end_state
        weighted = np.linalg.pinv(e.end_covariance, hermitian=True) @ away[..., None]
        nees.append((away * weighted[..., 0]).sum(axis=1).reshape(runs, -1).mean(axis=1))
        statuses[e.status.name] = statuses.get(e.status.name, 0) + 1
    of_runs = [np.mean(each, axis=0).tolist() for each in (path, inside, nees)]
    return Row(
        seed=seed, estimator=name, states=estimates[0].end_state.shape[1], scored=len(estimates) * runs,
        path=of_runs[0], inside=of_runs[1], nees=of_runs[2], several=several, statuses=statuses, seconds=seconds,
    )  # fmt: skip


def first_runs(rig: Rig, exposures: Sequence[Exposure], runs: int) -> tuple[Rig, list[Exposure]]:
    """The rig and the exposures of a scene's first runs alone."""
    sensor, plant = rig.sensor, rig.plant
    fewer: SensorRows | SpotSensor
    if isinstance(sensor, SensorRows):
        many, fewer = sensor.rows, dataclasses.replace(sensor, rows=runs)
    else:
        assert isinstance(sensor, SpotSensor)
        many, fewer = sensor.spots, dataclasses.replace(sensor, grid=(1, runs))
    rows, columns = fewer.shape
    axes = plant.axes // many * runs
    inputs, outputs = axes * plant.n_inputs, axes * plant.n_outputs
    some = []
    for exposure in exposures:
        truth = exposure.truth
        assert truth is not None
        known = dataclasses.replace(
            truth, start_state=truth.start_state[:axes], end_state=truth.end_state[:axes], path=truth.path[:outputs]
        )
        some.append(
            dataclasses.replace(
                exposure, pixels=exposure.pixels[:rows, :columns], mask=exposure.mask[:rows, :columns], truth=known,
                inputs=exposure.inputs[:, :inputs], lead_inputs=exposure.lead_inputs[:, :inputs],
            )
        )  # fmt: skip
    return dataclasses.replace(rig, plant=dataclasses.replace(plant, axes=axes), sensor=fewer), some


def read_rows(path: Path) -> list[Row]:
    """The rows of a file that `judge_all` has written, a last line that was cut off left out."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            rows.append(Row(**json.loads(line)))
        except json.JSONDecodeError:
            break
    return rows


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The plan of which scenes are judged by which estimators, where recorded rows are not taken."""

    scenes: int
    """Number of scenes that are judged by all but the slow estimators; the first of the reporting seeds."""
    pixel_scenes: int
    """How many of these scenes are judged by `profile`, stratified."""
    limit_scenes: int
    """How many of those scenes are judged by `sampled`."""
    size: Size


def judge_plan(path: Path, plan: Plan) -> list[Row]:
    """Judge the scenes of a plan, on reporting seeds; rows that the file has already are not made again."""
    seeds = SEEDS["reporting"][: plan.scenes]
    rows = judge_all(path, seeds, QUICK_NAMES, plan.size)
    for count, names in ((plan.pixel_scenes, PIXEL_NAMES), (plan.limit_scenes, (LIMIT,))):
        rows = judge_all(path, stratified(seeds, count), names, plan.size)
    return rows


def judge_all(
    path: Path, seeds: Iterable[int], names: Sequence[str], size: Size, say: Callable[[str], None] = lambda text: None
) -> list[Row]:
    """Judge scenes one after the other; rows that the file has already are not made again.

    The file is JSON, a row to a line. Rows that were made with other code or another size are kept as well: start a new
    file for those.
    """
    rows = read_rows(path)
    path.write_text("".join(map(_line, rows)), encoding="utf-8")
    commit = _commit()
    there = {(row.seed, row.estimator) for row in rows}
    with path.open("a", encoding="utf-8") as file:
        for seed in seeds:
            missing = [name for name in names if (seed, name) not in there]
            if not missing:
                continue
            scene = draw(seed)
            say(f"{seed}: {scene}")
            for made in judge(scene, missing, size):
                row = dataclasses.replace(made, commit=commit)
                rows.append(row)
                file.write(_line(row))
                file.flush()
                say(
                    f"  {row.estimator:9} path rms {np.sqrt(np.mean(row.path)):.4f}  inside {np.mean(row.inside):.3f}"
                    f"  NEES {np.mean(row.nees):.2f} of {row.states}  {1e3 * row.seconds:.2f} ms"
                )
    return rows


def _line(row: Row) -> str:
    """A row as a line of a file."""
    return f"{json.dumps({key: _short(value) for key, value in dataclasses.asdict(row).items()})}\n"


def _short(value: Any) -> Any:
    if isinstance(value, list):
        return [_short(each) for each in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def _commit() -> str:
    """`Row.commit` of rows made now; empty where this is no checkout."""
    try:
        head, changed = (
            subprocess.run(
                ["git", *arguments], cwd=RECORDED.parents[2], capture_output=True, text=True, check=True
            ).stdout.strip()
            for arguments in (
                ["rev-parse", "--short=7", "HEAD"],
                ["status", "--porcelain", "--untracked-files=no", "--", "aolink", "tools", ":!*.jsonl"],
            )
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return ""
    return f"{head}{'+' if changed else ''}"
