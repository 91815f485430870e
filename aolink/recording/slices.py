"""Some of a recording's exposures, read when they are used."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import overload

from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.series import Series


class NumberedSeries(Series):
    """A series any run of which can be read by the numbers of its exposures, from ``start`` to below ``stop``."""

    @abstractmethod
    def exposures(self, start: int = 0, stop: int | None = None) -> Iterator[Exposure]: ...

    @abstractmethod
    def iter_estimates(self, name: str, start: int = 0, stop: int | None = None) -> Iterator[Estimate]: ...


class RecordingSlice(Series):
    """The result of ``recording[10:20]``: these exposures and their estimates, as in the whole recording, bit for bit.

    From a file with an index little more is read than they need. Estimators that are run on a slice begin anew there.
    """

    def __init__(self, recording: NumberedSeries, numbers: range) -> None:
        if numbers.step < 0:
            raise ValueError("a recording is read forwards: take a slice with a positive step, and turn its list round")
        self.recording, self.numbers = recording, numbers
        self.rig, self.path, self.metadata = recording.rig, recording.path, recording.metadata

    @property
    def estimators(self) -> list[str]:
        return self.recording.estimators

    @property
    def has_truth(self) -> bool:
        return self.recording.has_truth

    def exposures(self) -> Iterator[Exposure]:
        for start, stop in self._runs():
            yield from self.recording.exposures(start, stop)

    def iter_estimates(self, name: str) -> Iterator[Estimate]:
        for start, stop in self._runs():
            yield from self.recording.iter_estimates(name, start, stop)

    def _runs(self) -> Iterator[tuple[int, int]]:
        """First number and end of each run of consecutive numbers."""
        if self.numbers.step == 1:
            yield self.numbers.start, self.numbers.stop
        else:
            yield from ((number, number + 1) for number in self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, index: int) -> Exposure: ...
    @overload
    def __getitem__(self, index: slice) -> RecordingSlice: ...
    def __getitem__(self, index: int | slice) -> Exposure | RecordingSlice:
        if isinstance(index, slice):
            return RecordingSlice(self.recording, self.numbers[index])
        return self.recording[self.numbers[index]]

    def title(self) -> str:
        numbers = self.numbers
        step = f":{numbers.step}" if numbers.step > 1 else ""
        return f"Recording {self.path.name}[{numbers.start}:{numbers.stop}{step}]"
