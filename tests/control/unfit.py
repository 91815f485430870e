"""Controllers of another package that do not fit the rig on which they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from aolink.control import ControllerRow, Seen
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig
from tests.packages import package

EXPOSURES = 45
"""Exposures after which `late` fails: more than its stability is computed for."""


class Unfit:
    """Its inputs are those that a function gives of the number of exposures and the last slopes."""

    def __init__(self, given: Callable[[int, FloatArray], FloatArray]) -> None:
        self._given, self._exposures = given, 0
        self._slopes = np.zeros(0)

    def see(self, seen: Seen) -> None:
        self._exposures += 1
        self._slopes = seen.slopes

    def step(self, held: FloatArray) -> FloatArray:
        return self._given(self._exposures, self._slopes)


def row(name: str, given: Callable[[int, FloatArray], FloatArray]) -> ControllerRow:
    return ControllerRow(name=name, summary="for other rigs", build=lambda rig: Unfit(given), needs_state=False)


def _fails(rig: Rig) -> str | None:
    raise ValueError("no rig like this")


THREE = row("three", lambda exposures, slopes: np.zeros(3))
HUGE = row("huge", lambda exposures, slopes: 1e250 * slopes)
LATE = row("late", lambda exposures, slopes: np.full(1 if exposures <= EXPOSURES else 3, 0.5 * (exposures > 42)))
REFUSES = ControllerRow(name="refuses", summary="", build=lambda rig: Unfit(lambda *_: np.zeros(1)), refusal=_fails)


def installed(folder: Path, environment: dict[str, str]) -> dict[str, str]:
    """An environment in which a package in ``folder`` adds these controllers by their entry points."""
    rows = ("three", "huge", "late", "refuses")
    points = "".join(f"{name} = {__name__}:{name.upper()}\n" for name in rows)
    package(folder, "unfit", f"[aolink.controllers]\n{points}")
    return environment | {"PYTHONPATH": f"{folder}:{environment['PYTHONPATH']}"}
