"""The choice of the kinds of processes in a disturbance, by how well they predict exposures that they were not fitted
to.

Each recording is cut in two; a model is fitted to one half and scored on the other, both ways. A score is the
log-likelihood of a stretch of exposures. Among the models whose score is below the best one's by no more than the
standard error of the difference over stretches, the one with the fewest parameters is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from aolink.errors import IdentificationError
from aolink.identification.likelihood import Likelihood
from aolink.identification.models import kinds_of
from aolink.identification.readings import FEWEST, Readings
from aolink.identification.search import SHORT_RUN, Space, maxima
from aolink.numerics.arrays import FloatArray

CANDIDATES = (
    "random-walk", "ornstein-uhlenbeck", "second-order", "resonance", "ornstein-uhlenbeck+resonance",
    "random-walk+resonance", "resonance+resonance",
)  # fmt: skip
"""The sums of kinds that are tried where the user asks for none."""
_STRETCH = 16
"""Exposures in a stretch."""


@dataclass(frozen=True, eq=False)
class Tried:
    """A sum of kinds, and how well it predicts."""

    name: str
    parameters: int
    scores: FloatArray
    """Log-likelihood of each stretch that it was not fitted to, -inf where it could not be fitted."""

    @property
    def score(self) -> float:
        """Log-likelihood of all stretches."""
        return float(self.scores.sum())


def tried(name: str, space: Callable[[Sequence[str]], Space], seen: Sequence[Readings]) -> Tried:
    """Fit a sum of kinds to halves of recordings, and score it on the other halves; ``space`` gives the parameters of
    the kinds."""
    if all(each.slots < 2 * FEWEST for each in seen):
        raise IdentificationError(
            f"{max(each.slots for each in seen)} exposures are too short a recording to choose a model with, which is"
            f" fitted to one half and scored on the other: {2 * FEWEST} or more are needed, or one --model"
        )
    of = space(kinds_of(name))
    long = [each for each in seen if each.slots >= 2 * FEWEST]
    halves = [(each.part(0, each.slots // 2), each.part(each.slots // 2, each.slots)) for each in long]
    scores: list[float] = []
    for fitted in (0, 1):
        try:
            best = maxima(of, [half[fitted] for half in halves])[0]
        except IdentificationError:
            best = None
        for half in halves:
            other = half[1 - fitted]
            for first in range(0, other.slots - _STRETCH // 2, _STRETCH):
                stretch = other.part(first, min(first + _STRETCH, other.slots))
                if stretch.usable.any():
                    value = of.log_likelihood(best.x, [Likelihood(stretch, SHORT_RUN)]) if best else -math.inf
                    scores.append(value)
    return Tried(name, len(of.names), np.array(scores))


def chosen(of: Sequence[Tried]) -> Tried:
    """The model with the fewest parameters among those that are as good as the best."""
    usable = [each for each in of if math.isfinite(each.score)]
    if not usable:
        raise IdentificationError("no model could be fitted to both halves of the recording: it shows too little")
    best = max(usable, key=lambda each: each.score)

    def as_good(each: Tried) -> bool:
        short = best.scores - each.scores
        error = float(short.std(ddof=1)) * math.sqrt(len(short)) if len(short) > 1 else 0.0
        return float(short.sum()) <= error

    return min((each for each in usable if as_good(each)), key=lambda each: (each.parameters, -each.score))
