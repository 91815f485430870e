"""The host of a session: its clock, and what both devices say, in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from aolink.devices.interfaces import Happened
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.devices.simple import AdaptedCamera, AdaptedMirror
from aolink.wire.hub import Hub

_POLL_S = 0.005
"""How often simple drivers are asked what has come."""


class Host(Hub):
    """A hub whose messages its devices explain: the `aolink.devices.interfaces.Time` of a session."""

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        super().__init__(stop)
        self.native: list[NativeCamera | NativeMirror] = []
        """The devices behind the links."""
        self.polled: list[AdaptedCamera | AdaptedMirror] = []
        """The devices of simple drivers."""

    def events(self, timeout_s: float) -> Iterator[Happened]:
        behind = {device.link: device for device in self.native}
        for link, received in self.wait(min(timeout_s, _POLL_S) if self.polled else timeout_s):
            device = behind[link]
            yield Happened(device, device.handle(received), received.receive_ns)
        for polled in self.polled:
            events = polled.poll()
            yield Happened(polled, events, self.now_ns())
