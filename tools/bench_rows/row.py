"""The result of a benchmark: one line of the table."""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Effort:
    """How much a row measures."""

    share: float

    def of(self, whole: int, least: int = 1) -> int:
        """The number of runs, exposures or seconds to do; ``whole`` is the number that the row's figure needs."""
        return max(least, round(self.share * whole))


FULL = Effort(1.0)
SHORT = Effort(0.02)
"""Every line of a row is run, but its figure means nothing."""


@dataclass(frozen=True)
class Row:
    """One figure: ours, the peer's, and the ratio that is required."""

    figure: str
    ours: str
    peer: str
    ratio: float
    """Ratio to the peer or limit, above one where ours is better."""
    target: float


def median_s(work: Callable[[], Any], runs: int, peer: Callable[[], Any] | None = None) -> tuple[float, float]:
    """Median times of two pieces of work that take turns, s."""
    ours: list[float] = []
    theirs: list[float] = []
    for _ in range(runs):
        for each, times in ((work, ours), (peer, theirs)):
            if each is not None:
                start = time.perf_counter()
                each()
                times.append(time.perf_counter() - start)
    return statistics.median(ours), statistics.median(theirs) if theirs else float("nan")


def timed(work: Callable[[], Any]) -> float:
    """Time that a piece of work takes, s."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def peak_mb() -> float:
    """The largest memory that this process has had, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
