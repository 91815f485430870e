"""The device's ends of ports: pseudo terminals and TCP ports.

A serial line is one wire to one host, and any bytes on it that are not a packet are noise. A TCP port can be reached by
every program of the machine, a web page in a browser among them, which may send bytes of its choice inside a request.
So a host that connects must begin with an Identify packet, from the very first byte: no browser sends one instead of
"POST /". Bytes before it are not interpreted.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import pty
import socket
import time
import tty
from pathlib import Path
from typing import Protocol

from google.protobuf.message import DecodeError

from aolink.errors import PortError
from aolink.simulation.devices import LineName
from aolink.wire import messages_pb2 as pb
from aolink.wire import packet as wire_packet
from aolink.wire.packet import DELIMITER, PROTOCOL_VERSION, MessageDecoder, PacketDecoder, PacketType

INTRODUCTION_S = 2.0
"""A connection without an Identify packet by this time is dropped, s."""
IDLE_S = 10.0
"""A host that has sent nothing for this long gives way to the next one that identifies itself, s."""
_MOST_GUESTS = 16
"""Connections that may be waiting to identify themselves; beyond that, the oldest is dropped."""
_MOST_INTRODUCTION = 64
"""More bytes than an encoded Identify packet can have."""


class Stream(Protocol):
    """The device's end of a port."""

    name: str

    def fileno(self) -> int: ...
    def read(self) -> bytes: ...
    def write(self, data: bytes) -> int: ...
    def close(self) -> None: ...
    def reopen(self) -> None: ...


class PtyStream:
    """A pseudo terminal, which only this user may open; ``name`` is the path that the host opens.

    Each time it is opened again it has another path, as a USB device may have. ``link`` is a symbolic link that always
    leads to it, as udev makes them, and is its name then.
    """

    def __init__(self, link: Path | None = None) -> None:
        self._link = link
        self.reopen()
        self.name = str(link or os.ttyname(self._slave))

    def reopen(self) -> None:
        self._master, self._slave = pty.openpty()  # the slave is kept open: hosts may come and go
        os.fchmod(self._slave, 0o600)  # the group tty may write to it otherwise
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        if self._link is not None:
            self._link.symlink_to(os.ttyname(self._slave))

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            return os.read(self._master, 65_536)
        return b""

    def write(self, data: bytes) -> int:
        with contextlib.suppress(BlockingIOError):
            return os.write(self._master, data)
        return 0

    def close(self) -> None:
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._master)
        os.close(self._slave)


class _Peer:
    """A TCP connection, and the time at which bytes last came over it."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.since_s = self.heard_s = time.monotonic()
        self.introduction = b""
        """Bytes that have come before it has identified itself."""
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def receive(self) -> bytes | None:
        """The bytes that have come; None once the connection is over."""
        try:
            data = self.connection.recv(65_536)
        except BlockingIOError:
            return b""
        except OSError:
            return None
        if not data:
            return None
        self.heard_s = time.monotonic()
        return data


class TcpStream:
    """A TCP port that serves one host at a time; ``name`` is the address for pyserial.

    A connection that begins with anything but an Identify packet is closed at once, and one that has sent nothing is
    closed after `introduction_s`; a host whose Identify is of another version gets the reason. A host that has
    identified itself keeps the port until it leaves; once it has been silent for `idle_s`, the next host that
    identifies itself takes its place.
    """

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self.reopen()
        self.introduction_s, self.idle_s = INTRODUCTION_S, IDLE_S
        self._peer: _Peer | None = None
        self._guests: list[_Peer] = []
        """Connections that have not identified themselves yet, oldest first."""
        shown = f"[{host}]" if ":" in host else host
        self.name = f"socket://{shown}:{self._port}"

    def reopen(self) -> None:
        host, port = self._host, self._port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._listener = socket.create_server((host, port), family=family)
        except OSError as error:
            raise PortError(f"cannot listen on {host}:{port}: {error.strerror}; give another --listen") from None
        self._listener.setblocking(False)
        self._port = self._listener.getsockname()[1]

    def fileno(self) -> int:
        waiting = [self._peer] if self._peer else self._guests[-1:]
        return (waiting[0].connection if waiting else self._listener).fileno()

    def read(self) -> bytes:
        if (introduction := self._admit()) is not None:
            # A packet that the previous host had begun to send ends here.
            return DELIMITER + introduction
        if self._peer is None:
            return b""
        data = self._peer.receive()
        if data is None:
            self._hang_up()
        return data or b""

    def write(self, data: bytes) -> int:
        if self._peer is None:
            return len(data)  # there is no host to read it
        try:
            return self._peer.connection.send(data)
        except BlockingIOError:
            return 0
        except OSError as error:
            if error.errno not in (errno.EPIPE, errno.ECONNRESET):
                raise
            self._hang_up()
            return len(data)

    def _admit(self) -> bytes | None:
        """Read from connections that are not identified yet; gives a new host's bytes, from its Identify packet on."""
        with contextlib.suppress(BlockingIOError):
            self._guests.append(_Peer(self._listener.accept()[0]))
        guests, self._guests = self._guests, []
        admitted = None
        for guest in guests:
            data = guest.receive()
            guest.introduction += data or b""
            begun = begins_with_identify(guest.introduction)
            if isinstance(begun, pb.Event):
                with contextlib.suppress(OSError):
                    guest.connection.send(wire_packet.encode_message(begun, 0))
                begun = False
            if begun is None and data is not None and time.monotonic() - guest.since_s < self.introduction_s:
                self._guests.append(guest)
            elif begun and not (self._peer is not None and time.monotonic() - self._peer.heard_s < self.idle_s):
                self._hang_up()
                self._peer, admitted = guest, guest.introduction
            else:
                guest.connection.close()
        while len(self._guests) > _MOST_GUESTS:
            self._guests.pop(0).connection.close()
        return admitted

    def _hang_up(self) -> None:
        if self._peer is not None:
            self._peer.connection.close()
            self._peer = None

    def close(self) -> None:
        self._hang_up()
        for guest in self._guests:
            guest.connection.close()
        self._guests.clear()
        self._listener.close()


def begins_with_identify(data: bytes) -> bool | pb.Event | None:
    """Whether bytes begin with a whole Identify packet, or with a zero byte and one; None while this cannot be known.

    Where the packet is of another version, the result is the message for its sender.
    """
    piece, end, _ = data.removeprefix(DELIMITER).partition(DELIMITER)
    if not end:
        return False if len(data) > _MOST_INTRODUCTION else None
    packets = PacketDecoder().feed(piece + end)
    if not packets or packets[0].type != PacketType.IDENTIFY:
        return False
    if packets[0].version != PROTOCOL_VERSION:
        return refusal_event(packets[0].version)
    try:
        MessageDecoder().take(packets[0])
    except DecodeError:
        return False
    return True


def refusal_event(version: int) -> pb.Event:
    """The message for a host whose Identify is of another version."""
    text = f"this Identify is of version {version}, this device speaks version {PROTOCOL_VERSION} (no signed packets)"
    return pb.Event(level=pb.Event.WARNING, text=text)


def open_streams(listen: str | None, *, links: Path | None = None) -> dict[LineName, Stream]:
    """Two pseudo terminals, or two TCP ports on ``listen`` = HOST:PORT (the mirror's is the next one; 0: any).

    ``links`` is a folder for links to the terminals, which stay the same where these vanish and return. Raises
    PortError if the address cannot be listened on, or other machines could reach it.
    """
    if listen is None:
        return {"camera": PtyStream(links and links / "camera"), "mirror": PtyStream(links and links / "mirror")}
    host, _, port = listen.rpartition(":")
    if not host or not port.isdigit() or int(port) > 65_534:
        raise PortError(f"--listen {listen}: expected HOST:PORT, for example 127.0.0.1:5000")
    number, address = int(port), _address(host, listen)
    if not ipaddress.ip_address(address).is_loopback:
        raise PortError(
            f"--listen {listen} would let every machine that reaches this one move the mirror: give 127.0.0.1:{port},"
            " and let others in through a tunnel (ssh -L)"
        )
    return {"camera": TcpStream(address, number), "mirror": TcpStream(address, number + 1 if number else 0)}


def _address(host: str, listen: str) -> str:
    """The address of a host, looked up once, so that the checked address is the one that is used."""
    try:
        found = socket.getaddrinfo(host.removeprefix("[").removesuffix("]"), None, type=socket.SOCK_STREAM)
    except OSError as error:
        raise PortError(f"--listen {listen}: there is no host {host} ({error.strerror})") from None
    return str(found[0][4][0])
