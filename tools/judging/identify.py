"""The sets of identification by mean and width of the blur, on recordings of scenes whose processes are known."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from scipy import stats

from aolink.identification import Process, identified, maxima, readings, space_of
from judging.rows import Given, Judge, Line, Row, grouped
from judging.scenes import PlantProcess, Scene, draw, exposures_of

EXPOSURES = 96
_NAMES = {"resonance": "resonance", "Ornstein-Uhlenbeck": "ornstein-uhlenbeck", "random walk": "random-walk"}


def rows(seed: int, given: Given) -> Iterator[Row]:
    """Whether the set of each parameter of the scene's first process holds the truth."""
    scene = draw(seed)
    scene = replace(
        scene, geometry="line", modes=scene.modes[:1], command="none", lost=0.0, masked=0.0, exposures=EXPOSURES
    )
    rig, exposures = exposures_of(scene, 1)
    (mode,) = scene.modes
    seen = [readings(rig, exposures)]
    space = space_of([_NAMES[mode.kind]], seen)
    for each, value in zip(identified(space, maxima(space, seen), seen), _truth(scene, mode).values, strict=True):
        yield {"what": each.name, "scene": str(scene), "holds": bool(each.holds(value))}


def _truth(scene: Scene, mode: PlantProcess) -> Process:
    """The process as `aolink identify` has it."""
    exposure_s, values = scene.steps * scene.fast_step_s, tuple[float, ...]()
    if mode.kind == "random walk":
        values = (mode.sd**2 / (scene.exposures * scene.period * scene.fast_step_s),)
    elif mode.kind == "Ornstein-Uhlenbeck":
        memory_s = exposure_s / (2 * math.pi * mode.swings)
        values = (memory_s, 2 * mode.sd**2 / memory_s)
    else:
        values = (mode.swings / exposure_s, mode.damping, mode.sd)
    return Process(_NAMES[mode.kind], values)


def table(rows: Sequence[Row]) -> tuple[Line, Iterable[Line]]:
    """A line for each parameter, beside the least number that chance explains (1 in 40)."""
    lines = []
    for what, each in grouped(rows).items():
        hits, least = sum(row["holds"] for row in each), stats.binom.ppf(0.025, len(each), 0.95)
        lines.append((what, str(len(each)), str(hits), f"{least:.0f}"))
    return ("parameter", "recordings", "95 % sets that hold the truth", "least by chance"), lines


IDENTIFY = Judge(summary="the sets of identification, on one process each", rows=rows, table=table)
