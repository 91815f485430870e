"""The driver that live sessions, replays and batches share."""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from aolink.estimation.batch import Batch, batches
from aolink.estimation.estimate import Estimate
from aolink.estimation.estimator import Estimator
from aolink.estimation.registry import make_estimator
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig

_MOST_SKIPPED_STEPS = 100_000
"""Longest gap, in fast steps, that is predicted input by input; in a longer gap the oldest inputs are dropped."""


class SkippedInputs:
    """The inputs of exposures that one estimator has skipped.

    The next exposure that it gets carries them as its lead, so that the estimator predicts over the steps of the
    skipped ones with the mirror's inputs, as it does over dead time and lost frames.
    """

    def __init__(self) -> None:
        self._rows: deque[FloatArray] = deque()
        self._steps = 0

    @property
    def empty(self) -> bool:
        """Whether no exposure was skipped since the last that was not."""
        return not self._rows

    def skip(self, exposure: Exposure) -> None:
        """Keep the inputs of an exposure that the estimator does not get."""
        for rows in (exposure.lead_inputs, exposure.inputs):
            self._rows.append(rows)
            self._steps += len(rows)
        while self._steps - len(self._rows[0]) >= _MOST_SKIPPED_STEPS:
            self._steps -= len(self._rows.popleft())

    def leading(self, exposure: Exposure) -> Exposure:
        """The given exposure, with the inputs of the exposures skipped since the one before it."""
        if not self._rows:
            return exposure
        lead = np.concatenate([*self._rows, exposure.lead_inputs])[-_MOST_SKIPPED_STEPS:]
        self._rows.clear()
        self._steps = 0
        return replace(exposure, lead_inputs=lead)


class Driver:
    """Several estimators side by side, exposure by exposure.

    Parameters
    ----------
    names:
        Names of the estimators, among `ESTIMATOR_NAMES`.
    skipped:
        Frame ids of the exposures that an estimator does not get, by its name: those that it had no time for in a
        session. Its estimates of the others are those of that session, bit for bit. An exposure's id may be added
        until it is given.

    Raises
    ------
    EstimatorError
        There is no such estimator, or it cannot work on this rig.
    """

    def __init__(self, rig: Rig, names: Sequence[str], skipped: Mapping[str, Container[int]] | None = None) -> None:
        self.rig = rig
        self.estimators = [make_estimator(rig, name) for name in names]
        self._skipped = skipped or {}
        self._inputs = {name: SkippedInputs() for name in self._skipped}

    def step(self, exposure: Exposure) -> list[Estimate]:
        """The estimates of one exposure, in the order of the names; an estimator that skips it gives none."""
        ((_, estimates),) = self._steps(Batch(self.rig, [exposure]))
        return estimates

    def steps(self, exposures: Iterable[Exposure]) -> Iterator[tuple[Exposure, list[Estimate]]]:
        """The estimates of a series of exposures, the same bits as by `step`; frames are measured in batches.

        The iterator reads up to a batch ahead of what it has given, so exhaust it before the next `step`.
        """
        for batch in batches(self.rig, exposures):
            yield from self._steps(batch)

    def _steps(self, batch: Batch) -> Iterator[tuple[Exposure, list[Estimate]]]:
        series = [self._series(estimator, batch) for estimator in self.estimators]
        for exposure in batch.exposures:
            yield exposure, [estimate for estimate in map(next, series) if estimate is not None]

    def _series(self, estimator: Estimator, batch: Batch) -> Iterator[Estimate | None]:
        """The estimates of a batch, None for each exposure that the estimator does not get."""
        if estimator.name not in self._skipped:
            return estimator.steps(batch)
        skipped, inputs = self._skipped[estimator.name], self._inputs[estimator.name]
        if inputs.empty and not any(exposure.frame_id in skipped for exposure in batch.exposures):
            return estimator.steps(batch)
        given: list[Exposure | None] = []
        for exposure in batch.exposures:
            if exposure.frame_id in skipped:
                inputs.skip(exposure)
                given.append(None)
            else:
                given.append(inputs.leading(exposure))
        some = [exposure for exposure in given if exposure is not None]
        made = estimator.steps(Batch(self.rig, some)) if some else iter(())
        return (None if exposure is None else next(made) for exposure in given)


def run(rig: Rig, exposures: Iterable[Exposure], names: Sequence[str]) -> dict[str, list[Estimate]]:
    """Lists of estimates of a series of exposures, by the estimators' names. Raises EstimatorError as `Driver`."""
    driver = Driver(rig, names)
    estimates: dict[str, list[Estimate]] = {name: [] for name in names}
    for _, each in driver.steps(exposures):
        for estimate in each:
            estimates[estimate.estimator].append(estimate)
    return estimates
