"""Inputs that wait on the host for their fast step, and those that were played and are not reported yet."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.simple import Held


class Played:
    """The common part of mirrors whose inputs a thread of the host plays: `send`, `applied`, and the thread's error.

    An input may be kept as the device takes it, (n,); `_inputs` gives the inputs of a run of steps.
    """

    def __init__(self) -> None:
        self._queue: dict[int, NDArray[Any]] = {}
        """Inputs by fast step."""
        self._next = 0
        """The first step that has not been played."""
        self._held: list[tuple[NDArray[Any], bool]] = []
        """Inputs of the steps that were not reported yet, and whether they were late."""
        self._reported = 0
        """The first step of ``_held``."""
        self._changed = threading.Condition()
        """Guards all of the above."""
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name=f"aolink-{type(self).__name__}", daemon=True)

    def send(self, first_step: int, u: NDArray[Any]) -> int:
        with self._changed:
            self._check()
            late = min(max(self._next - first_step, 0), len(u))
            self._queue.update(enumerate(u[late:], first_step + late))
        return late

    def applied(self) -> list[Held]:
        with self._changed:
            self._check()
            n_steps = self._n_over()
            held, self._held = self._held[:n_steps], self._held[n_steps:]
            first, self._reported = self._reported, self._reported + n_steps
        if not held:
            return []
        return [Held(first, self._inputs(np.array([u for u, _ in held])), np.array([late for _, late in held]))]

    def _n_over(self) -> int:
        """How many of the steps in ``_held`` are over."""
        return len(self._held)

    def _inputs(self, held: NDArray[Any]) -> NDArray[np.float64]:
        return held

    def _check(self) -> None:
        """Raise the error that has ended the thread, if there is one."""
        if self._failure is not None:
            raise self._failure

    def _play(self) -> None:
        """Play inputs until the mirror is closed."""
        raise NotImplementedError

    def _run(self) -> None:
        try:
            self._play()
        except Exception as error:  # the session gets it when it asks next
            with self._changed:
                self._failure = error
