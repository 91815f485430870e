"""Batches of exposures: quantities that do not depend on earlier exposures are computed for a whole batch at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from aolink.estimation.model.base import ExposureModel, InputResponse, are_numbers, numbers
from aolink.estimation.model.exposure_model import exposure_model
from aolink.exposure import Exposure
from aolink.rig import Rig

# Most exposures in a batch, and most numbers (a few megabytes): enough that the fixed cost of a batch does not matter.
_AT_ONCE = 512
_NUMBERS_AT_ONCE = 500_000


class Batch:
    """Some exposures with the responses to their inputs, the same bits as for each exposure alone."""

    def __init__(self, rig: Rig, exposures: Sequence[Exposure]) -> None:
        self.exposures = exposures
        self._plant = rig.plant
        kinds = {(each.n_steps, each.start_offset, each.inputs.shape) for each in exposures}
        self.model: ExposureModel | None = None
        """The model that all exposures share, None if they differ; `responses` exist only if they share one."""
        self.finite: list[bool]
        """Whether all inputs of an exposure are numbers."""
        if len(kinds) > 1:
            self.finite = [bool(np.isfinite(each.inputs).all()) for each in exposures]
            return
        ((n_steps, offset, _),) = kinds
        # One exposure of many axes is megabytes, and not copied.
        inputs = exposures[0].inputs[None] if len(exposures) == 1 else np.array([each.inputs for each in exposures])
        self.finite = [True] * len(exposures)
        self.model = exposure_model(rig.plant, n_steps, offset)
        with np.errstate(invalid="ignore"):
            self.responses = self.model.responses(inputs)
        """Responses of all axes of the first exposure, then of the second, (exposures * axes, ...)."""
        # The response of the end state is no number where an input is none, and is a hundredth of their size.
        if not are_numbers(self.responses.end) and not are_numbers(inputs):
            self.finite = np.isfinite(inputs).all(axis=(1, 2)).tolist()
            self.responses = self.model.responses(numbers(inputs))

    def model_of(self, k: int) -> ExposureModel:
        """The model of one exposure."""
        each = self.exposures[k]
        return self.model or exposure_model(self._plant, each.n_steps, each.start_offset)

    def response_to(self, k: int) -> InputResponse:
        """The response to the inputs of one exposure."""
        if self.model is None:
            return self.model_of(k).response(self.exposures[k].inputs)
        axes = self._plant.axes
        return self.responses.of(slice(k * axes, (k + 1) * axes))


def batches(rig: Rig, exposures: Iterable[Exposure]) -> Iterator[Batch]:
    """Split a series into batches of a few megabytes."""
    some: list[Exposure] = []
    numbers = 0
    for exposure in exposures:
        some.append(exposure)
        numbers += exposure.inputs.size + exposure.pixels.size
        if len(some) == _AT_ONCE or numbers >= _NUMBERS_AT_ONCE:
            yield Batch(rig, some)
            some, numbers = [], 0
    if some:
        yield Batch(rig, some)
