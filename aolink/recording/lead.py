"""Commands and reports from before an exposure that reach into it, which a file that begins there needs."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from google.protobuf.message import Message

from aolink.recording import schemas_pb2, topics
from aolink.wire import messages_pb2 as wire


class Lead:
    """Reads the messages of a recording, and keeps those that later exposures need."""

    def __init__(self) -> None:
        self._kept: deque[tuple[str, wire.CommandBlock | wire.Applied, int, int]] = deque()

    def add(self, topic: str, message: Message, log_time_ns: int, sequence: int) -> None:
        """Take the next message."""
        if isinstance(message, wire.CommandBlock | wire.Applied):
            self._kept.append((topic, message, log_time_ns, sequence))
        elif topic == topics.EXPOSURE and isinstance(message, schemas_pb2.ExposureInfo):
            # Exposures still to come begin after the last step of this one.
            self._kept = deque(
                each for each in self._kept if each[1].first_step + each[1].n_steps > message.last_step + 1
            )

    def messages(self) -> Iterator[tuple[str, Message, int, int]]:
        """Topic, message, log time and sequence of the messages kept, in order."""
        return iter(self._kept)
