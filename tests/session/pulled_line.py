"""A line between a host and a device that can be pulled out and plugged in again, on a pseudo terminal or on TCP."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import socket
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from google.protobuf.message import Message

from aolink.wire.packet import MessageDecoder, PacketDecoder
from aolink.wire.port import SerialPort


class _Terminal:
    """The host's end as a pseudo terminal behind a link: another terminal each time, as udev does it."""

    def __init__(self, link: Path) -> None:
        self.port, self._link = str(link), link

    def plug(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self._link.symlink_to(os.ttyname(self._slave))

    def pull(self) -> None:
        self._link.unlink()
        os.close(self._master)
        os.close(self._slave)

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        return os.read(self._master, 65_536)

    def write(self, data: bytes) -> None:
        os.write(self._master, data)


class _Socket:
    """The same as a TCP port."""

    def __init__(self) -> None:
        self._number = 0
        self._connection: socket.socket | None = None
        self.plug()
        self.pull()
        self.port = f"socket://127.0.0.1:{self._number}"

    def plug(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", self._number))
        self._number = self._listener.getsockname()[1]

    def pull(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._listener.close()

    def fileno(self) -> int:
        return (self._connection or self._listener).fileno()

    def read(self) -> bytes:
        if self._connection is None:
            self._connection = self._listener.accept()[0]
            return b""
        return self._connection.recv(65_536)

    def write(self, data: bytes) -> None:
        if self._connection is not None:
            self._connection.sendall(data)


class PulledLine:
    """A line to a device that goes on reading the device while it is pulled out.

    Parameters
    ----------
    device_port:
        The device.
    link:
        The path of the host's port; None for a TCP port.
    back:
        Told each message that the device sends while the line is pulled out; once it gives True, or `plug` was called,
        the line is plugged in again.
    """

    def __init__(
        self, device_port: str, link: Path | None, back: Callable[[Message], bool] = lambda message: False
    ) -> None:
        self._end: _Terminal | _Socket = _Terminal(link) if link else _Socket()
        self.port = self._end.port
        self.device_port = device_port
        """May be another device's when the line is plugged in again."""
        self._back = back
        self._pull, self._plug, self._over = threading.Event(), threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._ready = threading.Event()
        self._thread.start()
        self._ready.wait(20)

    def pull(self) -> None:
        self._pull.set()

    def plug(self) -> None:
        self._plug.set()

    def close(self) -> None:
        self._over.set()
        self._thread.join()

    def to_device(self, data: bytes) -> bytes:
        """What the device gets of what the host has sent."""
        return data

    def _run(self) -> None:
        while not self._over.is_set():
            device = SerialPort(self.device_port)
            self._pull.clear()
            self._plug.clear()
            self._end.plug()
            self._ready.set()
            self._serve(device, in_hand=True)
            self._end.pull()
            self._serve(device, in_hand=False)
            device.close()

    def _serve(self, device: SerialPort, *, in_hand: bool) -> None:
        packets, messages = PacketDecoder(), MessageDecoder()
        while not (self._over.is_set() or (self._pull if in_hand else self._plug).is_set()):
            ready, _, _ = select.select([device.fileno(), *([self._end] if in_hand else [])], [], [], 0.02)
            if self._end in ready:
                with contextlib.suppress(OSError):
                    device.write(self.to_device(self._end.read()))
            if device.fileno() not in ready:
                continue
            data = device.read_some()
            if in_hand:
                self._end.write(data)
                continue
            for packet in packets.feed(data):
                message = messages.take(packet)
                if message is not None and self._back(message):
                    return


@contextlib.contextmanager
def pulled_line(*arguments: Any) -> Iterator[PulledLine]:
    line = PulledLine(*arguments)
    try:
        yield line
    finally:
        line.close()
