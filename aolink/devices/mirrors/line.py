"""A serial line to a device that answers requests, for drivers that speak the maker's own protocol."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

from serial.tools import list_ports

from aolink.errors import DeviceError
from aolink.polling import wait_readable
from aolink.wire.port import SerialPort

TIMEOUT_S = 1.0
"""How long a device may take for an answer, unless a request says otherwise."""
QUIET_S = 0.05
"""After this time without a byte no late answer is on the line, s."""
_LONGEST = 65_536
"""Bytes without the expected end after which the driver stops waiting: the device is sending something else."""
_SHOWN = 48
"""Bytes of a request or an answer that an error message shows."""


class SerialLine:
    """A port that no other program uses, on which a device answers one request after another.

    Parameters
    ----------
    device:
        What should be at the other end, for the errors: "the PI controller".
    url:
        A device path or an address that pyserial opens.
    baud_rate:
        Bits per second; a USB device and a pseudo terminal ignore it.

    Raises
    ------
    PortError
        The port cannot be opened, or it is lost while it is in use (then each method raises it).
    """

    def __init__(self, device: str, url: str, baud_rate: int) -> None:
        self.url = url
        self._device, self._baud_rate = device, baud_rate
        self._port = SerialPort(url, baud_rate)
        self._read = bytearray()
        """Bytes that came and were not taken."""
        self._asked = b""
        """The latest request, for the errors."""

    @contextmanager
    def opening(self) -> Iterator[Self]:
        """A context in which a device is opened: where that fails, the port is given back."""
        try:
            yield self
        except BaseException:
            self.close()
            raise

    def tell(self, request: bytes) -> None:
        """Send a command that the device does not answer."""
        self._asked = request
        self._port.write(request)

    def ask(self, request: bytes, end: bytes = b"\n", timeout_s: float = TIMEOUT_S) -> bytes:
        """Send a request; gives the answer up to ``end``, without it.

        What came before the request is thrown away: it answers an earlier one.

        Raises
        ------
        DeviceError
            No whole answer came in time.
        """
        self.drain()
        self.tell(request)
        return self.read_until(end, timeout_s)

    def read_until(self, end: bytes = b"\n", timeout_s: float = TIMEOUT_S) -> bytes:
        """The next bytes up to ``end``, without it. Raises DeviceError where they do not come in time."""
        deadline = time.monotonic() + timeout_s
        while (at := self._read.find(end)) < 0:
            if len(self._read) > _LONGEST:
                raise self._no_answer(f"{len(self._read)} bytes without an end")
            self._receive(deadline)
        return self._take(at + len(end))[:at]

    def read_exactly(self, n: int, timeout_s: float = TIMEOUT_S) -> bytes:
        """The next ``n`` bytes. Raises DeviceError where they do not come in time."""
        deadline = time.monotonic() + timeout_s
        while len(self._read) < n:
            self._receive(deadline)
        return self._take(n)

    def drain(self, quiet_s: float = 0.0) -> bytes:
        """Throw away, and return, the bytes that have come; with ``quiet_s``, go on until nothing has come for that
        long, for 1 s at most."""
        deadline = time.monotonic() + TIMEOUT_S
        quiet = not quiet_s
        while time.monotonic() < deadline:
            if data := self._port.read_some():
                self._read += data
                quiet = not quiet_s
            elif quiet:
                break
            else:
                wait_readable([self._port], quiet_s)
                quiet = True
        return self._take(len(self._read))

    def close(self) -> None:
        """Give the port back. Closing twice does nothing."""
        self._port.close()

    def _take(self, n: int) -> bytes:
        taken = bytes(self._read[:n])
        del self._read[:n]
        return taken

    def _receive(self, deadline: float) -> None:
        """Wait for more bytes. Raises DeviceError at ``deadline``."""
        if data := self._port.read_some():
            self._read += data
        elif (left_s := deadline - time.monotonic()) > 0:
            wait_readable([self._port], left_s)
        else:
            raise self._no_answer(f"only {shown(bytes(self._read))}" if self._read else "nothing")

    def _no_answer(self, came: str) -> DeviceError:
        return DeviceError(
            f"{self._device} at {self.url} does not answer {shown(self._asked)} as it should, {came} came: is it"
            f" switched on, is this its port, does its line run at {self._baud_rate} baud, and does no other program"
            " use it?"
        )


def usb_ports(vendor: int, product: int | None = None) -> list[tuple[str, str]]:
    """Serial ports of this machine with a USB vendor's devices: (path, description). None of them is opened."""
    return sorted(
        (port.device, port.description or "")
        for port in list_ports.comports()
        if port.vid == vendor and product in (None, port.pid)
    )


def shown(data: bytes) -> str:
    """Bytes as an error shows them: printable, and not too many."""
    return repr(data[:_SHOWN])[1:] + ("..." if len(data) > _SHOWN else "")
