"""How long this process was held up: by the scheduler, by a debugger, by the machine that it runs on."""

from __future__ import annotations

import threading
import time


class Outages:
    """A thread that should run every ``period_ns`` measures by its own lateness how long this process did not run.

    It is slightly late without an outage, too: a lateness below one period is not counted.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ended_ns, self._seen_ns = 0, time.monotonic_ns()
        self._changed = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="aolink-outages", daemon=True)
        self._thread.start()

    def total_ns(self) -> int:
        """Time of all outages so far, including one that has just ended and that the thread has not noticed yet."""
        with self._changed:
            return self._ended_ns + self._overdue_ns()

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def _overdue_ns(self) -> int:
        return max(0, time.monotonic_ns() - self._seen_ns - 2 * self._period_ns)

    def _watch(self) -> None:
        while not self._closed.wait(self._period_ns / 1e9):
            with self._changed:
                self._ended_ns += self._overdue_ns()
                self._seen_ns = time.monotonic_ns()
