"""Queues from the loop to slower consumers: the loop never waits, and items that are dropped are counted."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from aolink.rig import Timing

Item = TypeVar("Item")

_BEHIND_S = 0.5
"""The most by which a consumer may be behind the camera, s."""


def most_waiting(timing: Timing) -> int:
    """How many exposures may wait for an estimator or a viewer: those of half a second, and at least two."""
    return max(2, math.ceil(_BEHIND_S / (timing.frame_period_steps * timing.fast_step_s)))


class Waiting(Generic[Item]):
    """A bounded queue that drops old items.

    Items leave in order, so short delays cost nothing. When it is full, its consumer is too slow: then all waiting
    items are dropped for the new one, so that the consumer goes on with new items, for some time without a gap.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._items: deque[Item] = deque()

    def put(self, item: Item) -> list[Item]:
        """Add an item; gives those that are dropped for it."""
        given_up = self.clear() if len(self._items) >= self._most else []
        self._items.append(item)
        return given_up

    def take(self) -> Item | None:
        """The oldest item, or None."""
        return self._items.popleft() if self._items else None

    def clear(self) -> list[Item]:
        """Drop all items, and return them."""
        items = list(self._items)
        self._items.clear()
        return items


class Aside(Generic[Item]):
    """Calls a function, item by item, on a thread of its own, so that the caller never waits for it.

    Parameters
    ----------
    function:
        Called with each item; when it raises, it is not called again.
    most:
        How many items may wait for it, as in `Waiting`.
    """

    def __init__(self, function: Callable[[Item], None], most: int) -> None:
        self.skipped = 0
        """Items that the function had no time for."""
        self.failed: Exception | None = None
        """The exception that the function raised."""
        self._function = function
        self._waiting = Waiting[Item](most)
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="aolink-aside", daemon=True)
        self._thread.start()

    def give(self, item: Item) -> None:
        """Hand over the next item."""
        with self._changed:
            self.skipped += len(self._waiting.put(item))
            self._changed.notify()

    def close(self, patience_s: float) -> bool:
        """Wait up to ``patience_s`` until the function has taken all waiting items; gives whether it has."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                while (item := self._waiting.take()) is None:
                    if self._closed:
                        return
                    self._changed.wait()
            if self.failed is not None:
                self.skipped += 1
                continue
            try:
                self._function(item)
            except Exception as error:  # a session must not end because its picture fails
                self.failed = error
