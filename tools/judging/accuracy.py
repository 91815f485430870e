"""Estimators over scenes that are drawn by seed: their error, coverage and consistency."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import partial

import numpy as np
from scipy import stats

from aolink.estimation import make_estimator
from judging.rows import BEYOND_95, Given, Judge, Line, Row, grouped, ratio
from judging.scenes import Draw, draw, exposures_of

SKIPPED = 4
"""Exposures at the start of a run that are not scored."""
SCENE_INSIDE = (0.90, 0.99)


def rows(seed: int, given: Given, *, kind: Draw) -> Iterator[Row]:
    """A row for each estimator; lists have a number for each run. All get the same frames."""
    scene = draw(seed, kind)
    rig, exposures = exposures_of(scene, given.runs)
    for name in given.estimators:
        estimator = make_estimator(rig, name)
        path, inside, nees = [], [], []
        start = time.process_time()
        estimates = [estimator.step(exposure) for exposure in exposures]
        seconds = (time.process_time() - start) / (len(exposures) * given.runs)
        for exposure, e in list(zip(exposures, estimates, strict=True))[SKIPPED:]:
            assert exposure.truth is not None
            error = (e.path - exposure.truth.path).reshape(given.runs, -1)
            path.append(np.mean(error**2, axis=1))
            inside.append(np.mean(np.abs(error) < BEYOND_95 * e.path_sd.reshape(given.runs, -1), axis=1))
            away = e.end_state - exposure.truth.end_state
            weighted = np.linalg.pinv(e.end_covariance, hermitian=True) @ away[..., None]
            nees.append((away * weighted[..., 0]).mean(axis=1).reshape(given.runs, -1).mean(axis=1))
        of_runs = {"path": path, "inside": inside, "nees": nees}
        found = {key: np.mean(each, axis=0).tolist() for key, each in of_runs.items()}
        yield {"what": name, "scene": str(scene), "seconds": seconds, **found}


def table(rows: Sequence[Row]) -> tuple[Line, Iterable[Line]]:
    """A line for each estimator."""
    heads = (
        "estimator", "scenes", "error over open-loop", "over o1", "over moments", "coverage: 5 %", "median",
        f"in {SCENE_INSIDE[0]:.2f} to {SCENE_INSIDE[1]:.2f}", "NEES a state", "in bounds", "ms",
    )  # fmt: skip
    by_name = {name: {row["seed"]: row for row in each} for name, each in grouped(rows).items()}
    return heads, [_line(name, by_name) for name in by_name]


def _line(name: str, by_name: dict[str, dict[int, Row]]) -> Line:
    ours = by_name[name]
    over = [
        ratio([(ours[seed]["path"], theirs[seed]["path"]) for seed in sorted(ours.keys() & theirs.keys())])
        for theirs in (by_name.get(each, {}) for each in ("open-loop", "o1", "moments"))
    ]
    inside = np.array([np.mean(row["inside"]) for row in ours.values()])
    low, middle = np.quantile(inside, [0.05, 0.5])
    within = np.mean((inside >= SCENE_INSIDE[0]) & (inside <= SCENE_INSIDE[1]))
    nees = np.median([np.mean(row["nees"]) for row in ours.values()])
    bounds = [bounded for row in ours.values() if (bounded := _nees_in_bounds(row["nees"])) is not None]
    ms = 1e3 * np.median([row["seconds"] for row in ours.values()])
    return (
        name, str(len(ours)), *over, f"{low:.2f}", f"{middle:.2f}", f"{within:.0%}", f"{nees:.2f}",
        f"{np.mean(bounds):.0%}" if bounds else "-", f"{ms:.2g}",
    )  # fmt: skip


def _nees_in_bounds(nees: Sequence[float]) -> bool | None:
    """Whether Student's 95 % bounds of a scene's mean NEES, over its runs, have one inside; None of too few runs."""
    if len(nees) < 4:
        return None
    reach = stats.t.ppf(0.975, len(nees) - 1) * np.std(nees, ddof=1) / math.sqrt(len(nees))
    return bool(abs(np.mean(nees) - 1) <= reach)


FAST = ("open-loop", "o1", "o3", "moments", "profile")
FAMILY = Judge(
    summary="estimators on scenes with anything in the ranges that they are for",
    rows=partial(rows, kind="random"), table=table, estimators=FAST,
)  # fmt: skip
SHAKE = Judge(
    summary="estimators on lines at exact ratios to the frame rate, beside a state that stays",
    rows=partial(rows, kind="exact"), table=table, estimators=FAST, scenes=60, runs=5,
)  # fmt: skip
