"""The part that the adapters for cameras and for mirrors share: they make a session's devices of simple drivers."""

from __future__ import annotations

from collections.abc import Callable

from aolink.devices.clock import ClockExchange, ClockRegression
from aolink.devices.drivers import calling
from aolink.devices.gate import printable
from aolink.devices.interfaces import ClockSampled, Event, lacks_of
from aolink.devices.simple import SimpleCamera, SimpleMirror
from aolink.rig.device_tables import Delay


class Adapted:
    """The common part of both adapters: a clock that is read at once by `read_clock`, and events that wait to be
    taken."""

    def __init__(self, name: str, driver: SimpleCamera | SimpleMirror, delay: Delay, now_ns: Callable[[], int]) -> None:
        self.name = name
        self.description = printable(driver.description)
        self.lacks = lacks_of(driver)
        self.clock = ClockRegression()
        self.now_ns, self.delay_ns, self.delay_sd_ns = now_ns, round(delay.mean_s * 1e9), delay.sd_s * 1e9
        self.waiting: list[Event] = []
        """Events that come with the next `poll`."""

    def read_clock(self) -> int:
        """The device's clock, ns."""
        raise NotImplementedError

    def query_clock(self, now_ns: int) -> None:
        sent_ns = self.now_ns()
        with calling(self.name, "when it was asked for the time"):
            device_ns = self.read_clock()
        exchange = ClockExchange(sent_ns, device_ns, device_ns, self.now_ns())
        self.waiting.append(ClockSampled.add(self.clock, exchange))

    def host_ns(self, device_ns: int, since_zero_ns: int, now_ns: int) -> tuple[int, float]:
        return self.clock.host_ns(device_ns)

    def statistics(self) -> dict[str, int]:
        return {}

    def take_waiting(self) -> list[Event]:
        """The events that waited, once."""
        events, self.waiting = self.waiting, []
        return events
