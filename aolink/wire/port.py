"""Ports: device paths and plain addresses that pyserial opens, behind five methods. No other module uses pyserial."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import socket
import stat
import threading
import time
from collections.abc import Callable
from typing import Protocol
from urllib.parse import urlsplit

import serial

from aolink.errors import PortError
from aolink.polling import HasFileno, wait_readable
from aolink.timeouts import TIMEOUTS

BAUD_RATE = 921_600
"""The baud rate of ports that have one; USB and pseudo terminals ignore it."""
_MOST_READ = 65_536


class Transport(Protocol):
    """A byte stream to a device."""

    def read_some(self) -> bytes:
        """The bytes that have come, without waiting; empty if there are none. Raises PortError when the port is
        lost."""

    def write(self, data: bytes) -> None:
        """Hand over all of ``data``. Raises PortError when the port is lost or takes nothing for 5 s."""

    def unsent(self) -> int:
        """Number of written bytes that still wait for the line; 0 where the port cannot say."""

    def fileno(self) -> int:
        """The file descriptor, for `wait_readable`."""

    def close(self) -> None:
        """Give the port back. Closing twice does nothing."""


class SerialPort:
    """A `Transport` over pyserial, or over a socket. Once ``stop()`` gives True, it does not wait for a device that
    takes nothing."""

    def __init__(self, url: str, baud_rate: int = BAUD_RATE, *, stop: Callable[[], bool] = lambda: False) -> None:
        self.url = url
        self._stop = stop
        self._full_since_s: float | None = None
        """Since when it has taken nothing: a dead line is waited for once, and not again by each who writes."""
        check_address(url)
        self._port: serial.SerialBase | socket.socket
        try:
            if url.lower().startswith("socket://"):
                address = urlsplit(url)
                self._port = socket.create_connection((address.hostname, address.port), timeout=TIMEOUTS.write_s)
                self._port.setblocking(False)
            else:
                self._port = serial.serial_for_url(
                    url, baudrate=baud_rate, timeout=0, write_timeout=TIMEOUTS.write_s, exclusive=True
                )
        except Exception as error:  # pyserial raises errors of many kinds for an address that it cannot read
            raise _open_error(url, error) from None
        try:
            self._port.fileno()
        except OSError:
            self._port.close()
            raise PortError(
                f"{url} is a port that cannot be waited on: use a device path or socket://host:port"
            ) from None
        if isinstance(self._port, serial.Serial):
            # Only some drivers know it; USB adapters otherwise hold bytes back for 16 ms.
            with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
                self._port.set_low_latency_mode(True)

    def read_some(self) -> bytes:
        # pyserial's own read waits with ``select``, which takes no descriptor above 1,023.
        try:
            descriptor = self._port.fileno()
            if not wait_readable([descriptor], 0):
                return b""
            data = os.read(descriptor, _MOST_READ)
        except BlockingIOError:
            return b""
        except (OSError, ValueError) as error:  # ValueError: it is closed
            raise self._lost(error) from None
        if not data:
            raise self._lost(OSError("the other end is gone"))
        return data

    def write(self, data: bytes) -> None:
        # pyserial's own write cannot be interrupted and does not say how much went out before a time-out.
        try:
            descriptor = self._port.fileno()
            while data:
                with contextlib.suppress(BlockingIOError):
                    data, self._full_since_s = data[os.write(descriptor, data) :], None
                    continue
                self._full_since_s = self._full_since_s or time.monotonic()
                waited_s = time.monotonic() - self._full_since_s
                if waited_s > (TIMEOUTS.stopped_write_s if self._stop() else TIMEOUTS.write_s):
                    raise PortError(f"{self.url} took no data for {waited_s:.0f} s; is the device running?")
                wait_readable([], TIMEOUTS.slice_s, [descriptor])
        except (OSError, ValueError) as error:
            raise self._lost(error) from None

    def _lost(self, error: Exception) -> PortError:
        other = " Does it serve another host?" if isinstance(self._port, socket.socket) else ""
        return PortError(f"lost {self.url}: {_plain(error)}; is the device still there?{other}")

    def unsent(self) -> int:
        if not isinstance(self._port, serial.Serial):
            return 0
        try:
            return int(self._port.out_waiting)
        except (OSError, TypeError):  # a driver that does not know; a port that is lost says so when it is read
            return 0

    def fileno(self) -> int:
        return self._port.fileno()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._port.close()


class Reopening:
    """Opens a port again and again until it is there, on a thread of its own, because connecting may take seconds."""

    def __init__(self, reopen: Callable[[], Transport]) -> None:
        self.opened: Transport | None = None
        self.failed: PortError | None = None
        """The error of the newest try, if it did not succeed."""
        self._reopen = reopen
        self._given_up = threading.Event()
        self._lock = threading.Lock()
        threading.Thread(target=self._run, name="aolink-reopening", daemon=True).start()

    def give_up(self) -> None:
        """Stop trying, and close the port if it was opened."""
        with self._lock:
            self._given_up.set()
            if self.opened is not None:
                self.opened.close()

    def _run(self) -> None:
        while not self._given_up.is_set():
            try:
                opened = self._reopen()
            except PortError as error:
                self.failed = error
                self._given_up.wait(TIMEOUTS.reopen_s)
                continue
            with self._lock:
                if self._given_up.is_set():
                    opened.close()
                else:
                    self.opened = opened
            return


class Served(HasFileno, Protocol):
    """An object beside the serial lines that a session serves while it waits."""

    @property
    def alive(self) -> bool:
        """Whether there is anything to wait for."""

    @property
    def has_to_send(self) -> bool:
        """Whether bytes are waiting to be sent as soon as the other end accepts them."""

    def serve(self) -> None:
        """Send and receive as much as possible without waiting."""


def is_local(transport: Transport) -> bool:
    """Whether a program of this machine is at the other end: of a pseudo terminal, or of a socket on loopback."""
    mode = os.fstat(transport.fileno())
    if stat.S_ISSOCK(mode.st_mode):
        with socket.socket(fileno=os.dup(transport.fileno())) as connection:
            peer = connection.getpeername()
        return not isinstance(peer, tuple) or ipaddress.ip_address(str(peer[0]).partition("%")[0]).is_loopback
    with contextlib.suppress(OSError):
        return os.ttyname(transport.fileno()).startswith(("/dev/pts/", "/dev/ttys"))  # of Linux, of macOS
    return False


_SCHEMES = ("socket", "rfc2217")
"""The others of pyserial write files, search for devices, or import code."""
_FORMS = "a port is a device path such as /dev/ttyACM0, or an address such as socket://192.168.1.5:5000"


def check_address(url: str) -> None:
    """Raise PortError for a text that cannot be a port: a folder, a file of data, an address of another kind, one
    without host or number, or one with options, by which pyserial can be made to write files."""
    scheme, slashes, _ = url.partition("://")
    if not slashes:
        try:
            mode = os.stat(url).st_mode
        except (OSError, ValueError):  # opening it will say why
            return
        if not stat.S_ISCHR(mode):
            what = "a folder" if stat.S_ISDIR(mode) else "a file, not a device"
            raise PortError(f"{url} is {what}: `aolink devices` lists the ports of this machine; {_FORMS}")
        return
    if scheme.lower() not in _SCHEMES:
        raise PortError(f"{url!r} is not a port that aolink opens: {_FORMS}")
    try:
        parts = urlsplit(url)
        host, number, more = parts.hostname, parts.port, parts.path.strip("/") + parts.query + parts.fragment
    except ValueError:  # a number that is none, or above 65535
        host, number, more = "", None, ""
    if not host or not number or more:
        raise PortError(
            f"{url!r} is not an address: expected {scheme.lower()}://HOST:PORT with a number from 1 to 65535 and"
            f" nothing behind it; {_FORMS}"
        )


def _open_error(url: str, error: Exception) -> PortError:
    cause = error.__context__ if isinstance(error.__context__, OSError) else error
    number = getattr(error, "errno", None) or getattr(cause, "errno", None)
    if isinstance(cause, socket.gaierror):  # its numbers are not those of errno
        return PortError(f"there is no host of the name in {url}: give its IP address, or check the spelling")
    if isinstance(cause, TimeoutError) or number in (errno.EHOSTUNREACH, errno.ENETUNREACH):
        return PortError(f"nothing answers at {url}: is that machine on, and in this network?")
    if "exclusively lock" in str(error) or number in (errno.EBUSY, errno.EWOULDBLOCK):
        return PortError(f"port {url} is in use by another program: close that one, or give another port")
    if number == errno.ENOTTY or "Inappropriate ioctl" in str(error):
        return PortError(f"{url} is a device, but no serial port: `aolink devices` lists those of this machine")
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV) or isinstance(error, ValueError):
        return PortError(
            f"there is no port {url or 'without a name'}: `aolink devices` lists those of this machine; {_FORMS}"
        )
    if number in (errno.EACCES, errno.EPERM):
        return PortError(f"no permission to open {url}: on Debian, add yourself to the group dialout and log in again")
    if number == errno.ECONNREFUSED or "refused" in str(error):
        return PortError(f"nothing listens at {url}: start the device or its server first")
    return PortError(f"cannot open {url}: {_plain(error)}")


def _plain(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno).lower()
    return "it is closed" if isinstance(error, ValueError | serial.PortNotOpenError) else str(error)
