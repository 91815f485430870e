"""Who may use a rig's ports: real sockets on loopback, real pseudo terminals."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.errors import PortError
from aolink.simulation import streams
from aolink.simulation.streams import PtyStream, TcpStream, open_streams
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import Packet, PacketDecoder, encode_message, encode_packet

IDENTIFY = encode_message(pb.Identify(nonce=7), 0)
COMMAND = encode_message(pb.CommandBlock(block_id=1, first_step=50, n_steps=300, u=[0.05] * 300), 1)
POST = b"POST / HTTP/1.1\r\nHost: 127.0.0.1:5000\r\nContent-Type: text/plain\r\nContent-Length: 2500\r\n\r\n"
DEADLINE_S = 20.0


@pytest.fixture
def stream() -> Iterator[TcpStream]:
    stream = TcpStream("127.0.0.1", 0)
    yield stream
    stream.close()


def connect(stream: TcpStream) -> socket.socket:
    host, port = stream.name.removeprefix("socket://").rsplit(":", 1)
    connection = socket.create_connection((host, int(port)))
    connection.settimeout(0.02)
    return connection


def taken(stream: TcpStream, until: Callable[[bytes], bool]) -> bytes:
    """What the rig is given, until a condition holds."""
    data, end = b"", time.monotonic() + DEADLINE_S
    while not until(data):
        assert time.monotonic() < end, data
        data += stream.read()
    return data


def is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def test_a_host_that_identifies_itself_is_served(stream: TcpStream) -> None:
    with connect(stream) as host:
        host.sendall(IDENTIFY[:3])
        assert taken(stream, lambda data: not is_closed(host)) == b""
        host.sendall(IDENTIFY[3:] + COMMAND)
        data = taken(stream, lambda data: len(data) > len(IDENTIFY + COMMAND))
        assert [packet.type for packet in PacketDecoder().feed(data)] == [1, 3]
        assert stream.write(b"answer") == 6
        assert host.recv(6) == b"answer"


@pytest.mark.parametrize(
    "sent",
    [
        POST + b"\0" + IDENTIFY + COMMAND,
        b"\0\0" + IDENTIFY + COMMAND,
        b"G" + IDENTIFY,
        COMMAND,
        encode_packet(Packet(1, 1, 0, b"\xff")),
        IDENTIFY[:4] + bytes([IDENTIFY[4] ^ 1]) + IDENTIFY[5:],
        b"x" * 5000,
    ],
    ids=["a web page", "delimiter", "one byte", "command", "payload", "checksum", "endless"],
)
def test_who_begins_with_anything_else_is_dropped_unheard(stream: TcpStream, sent: bytes) -> None:
    with connect(stream) as host:
        host.sendall(sent)
        assert taken(stream, lambda data: is_closed(host)) == b""


@given(st.binary(max_size=200))
def test_no_other_bytes_pass(data: bytes) -> None:
    assert streams.begins_with_identify(data) is not True


def test_who_says_nothing_is_dropped_and_locks_nobody_out(stream: TcpStream) -> None:
    with connect(stream) as idle, connect(stream) as host:
        host.sendall(IDENTIFY)  # served although the other one was there before
        assert taken(stream, lambda data: data != b"")
        stream.introduction_s = 0.0
        taken(stream, lambda data: is_closed(idle))
        assert not is_closed(host)


def test_idle_connections_are_bounded(stream: TcpStream) -> None:
    crowd = [connect(stream) for _ in range(40)]
    with connect(stream) as host:
        host.sendall(IDENTIFY)
        assert taken(stream, lambda data: data != b"")
        assert sum(map(is_closed, crowd)) >= 20
    for each in crowd:
        each.close()


def test_a_silent_host_gives_way_to_one_that_identifies_itself(stream: TcpStream) -> None:
    with connect(stream) as first, connect(stream) as second, connect(stream) as page:
        first.sendall(IDENTIFY)
        taken(stream, lambda data: data != b"")
        second.sendall(IDENTIFY)
        taken(stream, lambda data: is_closed(second))  # the first one has the port
        stream.idle_s = 0.0
        page.sendall(POST)
        taken(stream, lambda data: is_closed(page))
        assert not is_closed(first)  # nobody who can take its place has come
        with connect(stream) as third:
            third.sendall(IDENTIFY)
            data = taken(stream, lambda data: data != b"")
            assert data == b"\0" + IDENTIFY
            assert is_closed(first)
            assert not is_closed(third)


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]"])
def test_no_other_machine_can_connect(host: str) -> None:
    with pytest.raises(PortError, match=r"let every machine that reaches this one move the mirror.* 127\.0\.0\.1:0"):
        open_streams(f"{host}:0")


@pytest.mark.parametrize("version", [2, 3])
def test_an_identify_of_another_version_is_answered_and_not_taken(stream: TcpStream, version: int) -> None:
    with connect(stream) as host:
        host.sendall(encode_packet(Packet(version, 1, 0, b"\x08\x07" + bytes(13))) + COMMAND)
        packet = answer(stream, host)
        assert packet.version == 1
        assert f"version {version}, this device speaks version 1".encode() in packet.payload
        assert taken(stream, lambda data: is_closed(host)) == b""


def answer(stream: TcpStream, host: socket.socket) -> Packet:
    """The packet that a host is sent that is not admitted."""
    packets, end = PacketDecoder(), time.monotonic() + DEADLINE_S
    while time.monotonic() < end:
        assert stream.read() == b""
        with contextlib.suppress(TimeoutError):
            for packet in packets.feed(host.recv(65_536)):
                return packet
    raise AssertionError("nobody answers")


def test_a_host_that_is_not_there_is_refused() -> None:
    with pytest.raises(PortError, match="there is no host no such host"):
        open_streams("no such host:0")


def test_a_serial_line_skips_noise_as_before() -> None:
    stream = PtyStream()
    port = os.open(stream.name, os.O_RDWR | os.O_NOCTTY)
    os.write(port, b"noise\0" + IDENTIFY)
    packets = PacketDecoder()
    end = time.monotonic() + DEADLINE_S
    while not (found := packets.feed(stream.read())):
        assert time.monotonic() < end
    assert [packet.type for packet in found] == [1]
    assert packets.bad_framing == 1
    os.close(port)
    stream.close()


def test_a_serial_line_is_the_users_only() -> None:
    stream = PtyStream()
    assert stat.S_IMODE(os.stat(stream.name).st_mode) == 0o600
    assert os.stat(stream.name).st_uid == os.getuid()
    stream.close()
