"""Mirrors whose inputs wait on the host: a thread of the host plays each in its fast step."""

from __future__ import annotations

import threading
import time
from collections import deque

import numpy as np
from numpy.typing import NDArray

from aolink.devices.interfaces import lacks_of
from aolink.devices.simple import DirectMirror, Held
from aolink.rig import Rig

_REMEMBERED = 1000
_LATE = 0.5
"""A step whose input was taken only after this part of the step is late: it held the previous input for longer."""
_LEAST_PERIOD_NS = 1_000_000
"""Least period of checking whether the host is held up, ns: more frequent checks would cost more than they show."""


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


class PacedMirror:
    """A `SimpleMirror` made of a `DirectMirror`: the host queues the inputs, and sends each when its step begins.

    The scheduler and the serial line limit how exact this is. A step for which the device took its input later than
    half-way counts as late, and is reported to have held the input before. Where steps begin while the device is still
    busy with an earlier one, the newest is sent, and those between are late. Time for which this host was held up while
    it waited for an answer is not the device's, and does not make it late.
    """

    def __init__(self, rig: Rig, driver: DirectMirror) -> None:
        self._queue: dict[int, NDArray[np.float64]] = {}
        """Inputs by fast step."""
        self._next = 0
        """The first step that has not been played."""
        self._held: list[tuple[NDArray[np.float64], bool]] = []
        """Inputs of the steps that were not reported yet, and whether they were late."""
        self._reported = 0
        """The first step of ``_held``."""
        self._changed = threading.Condition()
        """Guards all of the above."""
        self._failure: Exception | None = None
        self.description = driver.description
        self.lacks = lacks_of(driver)
        self._driver, self._park, self._step_ns = driver, rig.mirror.park, rig.timing.fast_step_ns
        self._zero_ns = time.monotonic_ns()
        self._now = self._park
        """The input that the device holds."""
        self._device = threading.Lock()
        """Held while the driver is called; a thread that holds ``_changed`` never acquires it."""
        self._lateness_ns: deque[int] = deque(maxlen=_REMEMBERED)
        """Times from the beginning of a step until the device's answer to its input was read, for the newest inputs."""
        self._outages = Outages(max(rig.timing.fast_step_ns // 8, _LEAST_PERIOD_NS))
        self._parked = self._closed = False
        self._thread = threading.Thread(target=self._run, name="aolink-mirror", daemon=True)
        self._thread.start()

    def time_ns(self) -> int:
        return time.monotonic_ns() - self._zero_ns

    @property
    def timing_sigma_ns(self) -> float:
        """Rms of the time from a step's beginning to the device's answer, over its newest inputs, ns; it took each
        input before it answered."""
        with self._changed:
            return float(np.sqrt(np.mean(np.square(self._lateness_ns)))) if self._lateness_ns else 0.0

    def send(self, first_step: int, u: NDArray[np.float64]) -> int:
        with self._changed:
            self._check()
            self._parked = False
            late = min(max(self._next - first_step, 0), len(u))
            self._queue.update(enumerate(u[late:], first_step + late))
        return late

    def applied(self) -> list[Held]:
        with self._changed:
            self._check()
            held, self._held = self._held, []
            first, self._reported = self._reported, self._reported + len(held)
        if not held:
            return []
        return [Held(first, np.array([u for u, _ in held]), np.array([late for _, late in held]))]

    def _check(self) -> None:
        """Raise the error that has ended the thread, if there is one."""
        if self._failure is not None:
            raise self._failure

    def park(self) -> int:
        with self._changed:
            self._parked = True
            self._queue.clear()
        with self._device:
            self._driver.park()
            with self._changed:
                first = max(self._next, self.time_ns() // self._step_ns + 1)
                # Until now the device held its input, also in the step whose input the thread waits to put out.
                self._held += [(self._now, True)] * (first - self._reported - len(self._held))
                self._next, self._now = first, self._park
                return first

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._outages.close()
        self._driver.close()

    def _run(self) -> None:
        try:
            self._play()
        except Exception as error:  # the session gets it when it asks next
            with self._changed:
                self._failure = error

    def _play(self) -> None:
        """Put out each step's input when it begins: the safe input where nothing is queued for it."""
        while True:
            with self._changed:
                if (step := self._wait_for_step()) is None:
                    return
                u = self._queue.pop(step, self._park)
                self._next = step + 1
                if np.array_equal(u, self._now):
                    self._held.append((self._now, False))
                    continue
            self._put(step, u)

    def _wait_for_step(self) -> int | None:
        """Wait for the step that follows the last one played, and give the present step; None when the mirror is
        closed.

        Steps that have passed meanwhile held the device's input; they are late where an input was queued for them.
        """
        while not self._closed:
            step = self.time_ns() // self._step_ns
            if step >= self._next:
                self._held += [(self._now, self._queue.pop(k, None) is not None) for k in range(self._next, step)]
                return step
            self._changed.wait((self._next * self._step_ns - self.time_ns()) / 1e9)
        return None

    def _put(self, step: int, u: NDArray[np.float64]) -> None:
        with self._device:
            with self._changed:
                if self._reported + len(self._held) == self._next:  # it was parked meanwhile, which covers the step
                    return
                if self._parked:
                    self._held.append((self._now, True))
                    return
            held_up_ns = self._outages.total_ns()
            taken = self._driver.put(u)
            with self._changed:
                answered_ns = self.time_ns()
                self._lateness_ns.append(answered_ns - step * self._step_ns)
                taken_ns = answered_ns - (self._outages.total_ns() - held_up_ns)
                reached = taken_ns / self._step_ns - _LATE
                late = step < reached
                self._held.append((self._now if late else taken, late))
                while self._next < reached:  # the device was busy for longer than a step
                    self._held.append((self._now, self._queue.pop(self._next, None) is not None))
                    self._next += 1
                self._now = taken
