"""Estimates and the exposures that they belong to, which a recording holds beside each other."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

from google.protobuf.message import Message

from aolink.exposure import Exposure
from aolink.recording import schemas_pb2


class EstimatePairs:
    """Pairs of an estimator's estimates and their exposures, in order, as a recording's messages come.

    An estimate comes before or after its exposure is complete, but in the order of the exposures; some have none.

    Parameters
    ----------
    start, stop:
        Numbers of the exposures that are wanted, from the former to below the latter; None: to the last.
    """

    def __init__(self, start: int, stop: int | None) -> None:
        self._start, self._stop = start, stop
        self._exposures: dict[int, Exposure] = {}
        self._waiting: deque[schemas_pb2.Estimate] = deque()
        self._all_came = False
        self._last_paired = -1

    def take(
        self, received: Message | None, completed: Sequence[tuple[int, Exposure]]
    ) -> Iterator[tuple[schemas_pb2.Estimate, Exposure]]:
        """The pairs that are there with a message and the exposures that it completes, with their numbers; None at the
        recording's end."""
        exposures, waiting = self._exposures, self._waiting
        if isinstance(received, schemas_pb2.Estimate):
            waiting.append(received)
        elif isinstance(received, schemas_pb2.Estimation) and received.skipped:
            exposures.pop(received.frame_id, None)
        for number, exposure in completed:
            self._all_came = self._stop is not None and number >= self._stop - 1
            if self._start <= number and (self._stop is None or number < self._stop):
                exposures[exposure.frame_id] = exposure
        # At the end of the recording, no further exposure will come; nor will one of the part before this.
        first = next(iter(exposures), 0)
        while waiting and (received is None or waiting[0].frame_id in exposures or waiting[0].frame_id < first):
            message = waiting.popleft()
            if message.frame_id not in exposures:
                continue
            yield message, exposures[message.frame_id]
            # Estimates come in the order of their exposures: earlier exposures have had theirs.
            for frame_id in list(exposures)[: list(exposures).index(message.frame_id)]:
                del exposures[frame_id]
            self._last_paired = message.frame_id

    @property
    def complete(self) -> bool:
        """Whether no further pair of the wanted exposures can come."""
        last = next(reversed(self._exposures), self._last_paired)
        late = self._waiting and self._waiting[0].frame_id > last
        return self._all_came and (last == self._last_paired or bool(late))
