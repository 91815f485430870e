"""What a benchmark gives: one line of the table."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Row:
    """One figure: ours, the peer's, and what the ratio should be."""

    figure: str
    ours: str
    peer: str
    ratio: float
    """How many times better than the peer or limit."""
    target: float


def median_s(work: Callable[[], Any], runs: int, peer: Callable[[], Any] | None = None) -> tuple[float, float]:
    """Median times of two pieces of work that take turns, s."""
    ours, theirs = [], []
    for _ in range(runs):
        for each, times in ((work, ours), (peer, theirs)):
            if each is not None:
                start = time.perf_counter()
                each()
                times.append(time.perf_counter() - start)
    return statistics.median(ours), statistics.median(theirs) if theirs else float("nan")
