"""The host of a session: its clock, and what both devices say, in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from aolink.devices.interfaces import Happened
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.wire.hub import Hub


class Host(Hub):
    """A hub whose messages its devices explain: the `aolink.devices.interfaces.Time` of a session."""

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        super().__init__(stop)
        self.native: list[NativeCamera | NativeMirror] = []
        """The devices behind the links."""

    def events(self, timeout_s: float) -> Iterator[Happened]:
        behind = {device.link: device for device in self.native}
        for link, received in self.wait(timeout_s):
            device = behind[link]
            yield Happened(device, device.handle(received), received.receive_ns)
