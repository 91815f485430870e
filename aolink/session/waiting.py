"""Queues from the loop to slower consumers: the loop never waits, and items that are dropped are counted."""

from __future__ import annotations

import math
from collections import deque
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
