"""The host of a session: its clock, and the events of both devices in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from aolink.devices.adapted_camera import AdaptedCamera
from aolink.devices.adapted_mirror import AdaptedMirror
from aolink.devices.interfaces import Happened
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.wire.hub import Hub

_POLL_S = 0.005
"""Interval at which simple drivers are polled."""


class Host(Hub):
    """A hub whose messages are turned into events by its devices: the `aolink.devices.interfaces.Time` of a session."""

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        super().__init__(stop)
        self.native: list[NativeCamera | NativeMirror] = []
        """The devices behind the links."""
        self.polled: list[AdaptedCamera | AdaptedMirror] = []
        """The devices of simple drivers."""

    def close(self) -> None:
        for device in self.native:
            device.port.give_up()
        super().close()

    def events(self, timeout_s: float) -> Iterator[Happened]:
        behind = {device.link: device for device in self.native}
        often = self.polled or any(device.port.away for device in self.native)
        for link, received in self.wait(min(timeout_s, _POLL_S) if often else timeout_s):
            device = behind[link]
            yield Happened(device, device.handle(received), received.receive_ns)
        for device in self.native:
            if came := device.watch_port(now_ns := self.now_ns()):
                yield Happened(device, came, now_ns)
        for polled in self.polled:
            yield Happened(polled, polled.poll(), self.now_ns())
