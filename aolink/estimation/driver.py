"""The driver that live sessions, replays and batches share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from aolink.estimation.block import Block, blocks
from aolink.estimation.estimate import Estimate
from aolink.estimation.estimators import make_estimator
from aolink.estimation.options import Engine
from aolink.exposure import Exposure
from aolink.rig import Rig


class Driver:
    """Several estimators side by side, exposure by exposure, on one engine."""

    def __init__(self, rig: Rig, names: Sequence[str], engine: Engine = "aolink") -> None:
        self.rig = rig
        self.estimators = [make_estimator(rig, name, engine=engine) for name in names]

    def step(self, exposure: Exposure) -> list[Estimate]:
        """What each of them says about an exposure, in the order of the names."""
        ((_, estimates),) = self._steps(Block(self.rig, [exposure]))
        return estimates

    def steps(self, exposures: Iterable[Exposure]) -> Iterator[tuple[Exposure, list[Estimate]]]:
        """The same for a series, to the same bits; what knows no recursion is done for many exposures at once.

        It is ahead of what it has given by up to a block, so it must be taken to its end before the next step.
        """
        for block in blocks(self.rig, exposures):
            yield from self._steps(block)

    def _steps(self, block: Block) -> Iterator[tuple[Exposure, list[Estimate]]]:
        series = [estimator.steps(block) for estimator in self.estimators]
        for exposure in block.exposures:
            yield exposure, list(map(next, series))


def run(rig: Rig, exposures: Iterable[Exposure], names: Sequence[str]) -> dict[str, list[Estimate]]:
    """Estimates of a series of exposures, by the estimators' names."""
    driver = Driver(rig, names)
    estimates: dict[str, list[Estimate]] = {name: [] for name in names}
    for _, each in driver.steps(exposures):
        for estimate in each:
            estimates[estimate.estimator].append(estimate)
    return estimates
