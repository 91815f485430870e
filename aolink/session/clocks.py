"""Queries of the devices' clocks, in turn, so that one query does not wait for the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from aolink.devices.clock import QUERY_PERIOD_S, SUSPICION_PERIOD_S, WARM_UP_QUERIES
from aolink.devices.interfaces import Device, Time
from aolink.errors import DeviceError
from aolink.timeouts import TIMEOUTS


class ClockQueries:
    """Asks the devices for their time."""

    def __init__(self, time: Time, devices: Sequence[Device]) -> None:
        self._time, self.devices = time, list(devices)
        """The devices in the order in which they are queried; the next one first."""
        self._last_ns = 0

    def ask(self, now_ns: int) -> None:
        """Query the next clock."""
        asked = self.devices.pop(0)
        self.devices.append(asked)
        asked.query_clock(now_ns)
        self._last_ns = now_ns

    def due_ns(self) -> int:
        """The time of the next query: soon where a clock may have been set, so that this is decided soon."""
        suspected = any(each.clock.suspected for each in self.devices)
        period_s = SUSPICION_PERIOD_S if suspected else QUERY_PERIOD_S
        return self._last_ns + round(period_s / 2 * 1e9)

    def warm_up(self, receive: Callable[[float], int], stop: Callable[[], bool]) -> None:
        """Query each clock often enough for a session to begin, until ``stop()``.

        ``receive`` waits for events for up to some seconds, and gives how many queries were answered. Raises
        DeviceError for a device that answers none.
        """
        for _ in range(WARM_UP_QUERIES * 2):
            if stop():
                return
            self.ask(self._time.now_ns())
            deadline_ns = self._time.now_ns() + round(TIMEOUTS.clock_answer_s * 1e9)
            while not receive(0.05) and not self._time.virtual and self._time.now_ns() < deadline_ns:
                pass
        for device in self.devices:
            if not device.clock.ready:
                raise DeviceError(f"the {device.name} does not answer clock queries: is it still connected?")
