"""One colour for each estimator, and one order of them, in the viewer and in every plot."""

from __future__ import annotations

import math
import zlib
from contextlib import suppress

from aolink import estimation
from aolink.errors import EstimatorError

Colour = tuple[int, int, int]

_OTHERS: tuple[Colour, ...] = ((100, 220, 220), (220, 160, 240), (200, 220, 120), (255, 160, 160), (140, 180, 255))


def estimator_colour(name: str) -> Colour:
    """Colour of an estimator; one that has options, or is not installed here, gets one by its name, always the same."""
    if ":" not in name:
        with suppress(EstimatorError):
            return estimation.estimator_row(name).colour
    return _OTHERS[zlib.crc32(name.encode()) % len(_OTHERS)]


def by_rank(names: list[str]) -> list[str]:
    """Estimators in the order of their ranks; those that are not installed here come last."""

    def rank(name: str) -> float:
        try:
            return estimation.estimator_row(name).rank
        except EstimatorError:
            return math.inf

    return sorted(names, key=lambda name: (rank(name), name))
