"""Commands and reports from before an exposure that reach into it, which a file that begins there needs."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

from google.protobuf.message import Message

from aolink.recording import topics

_MOST_STEPS = 100_000
"""How far an exposure looks back, as in `aolink.assembly`."""


class Lead:
    """Reads the messages of a recording, and keeps those that later exposures need."""

    def __init__(self) -> None:
        self._kept: deque[tuple[str, Any, int, int]] = deque()

    def add(self, topic: str, message: Any, log_time_ns: int, sequence: int) -> None:
        """Take the next message."""
        row = topics.find(topic, message)
        if row.belongs_to == "steps":
            self._kept.append((topic, message, log_time_ns, sequence))
            while self._kept[0][1].first_step + self._kept[0][1].n_steps <= message.first_step - _MOST_STEPS:
                self._kept.popleft()
        elif row.name == topics.EXPOSURE:
            # Exposures still to come begin after the last step of this one.
            self._kept = deque(
                each for each in self._kept if each[1].first_step + each[1].n_steps > message.last_step + 1
            )

    def messages(self) -> Iterator[tuple[str, Message, int, int]]:
        """Topic, message, log time and sequence of the messages kept, in order."""
        return iter(self._kept)
