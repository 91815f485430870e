"""A link over a real pseudo terminal: sequence numbers, duplicates, damage, another version."""

from __future__ import annotations

import os
import pty
import resource
import socket
import tty
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest

from aolink.errors import PortError
from aolink.polling import wait_readable
from aolink.timeouts import Timeouts
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import Hub
from aolink.wire.link import Link
from aolink.wire.packet import Packet, PacketDecoder, encode_message, encode_packet
from aolink.wire.port import SerialPort


class Peer:
    """The device's end of a pseudo terminal."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)

    def say(self, data: bytes) -> None:
        os.write(self.master, data)

    def close(self) -> None:
        for descriptor in (self.master, self._slave):
            os.close(descriptor)


@pytest.fixture
def peer() -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.close()


@pytest.fixture
def link(peer: Peer) -> Iterator[Link]:
    port = SerialPort(peer.path)
    yield Link("camera", port, lambda: 42)
    port.close()


def receive(link: Link, packets: int) -> list[object]:
    messages: list[object] = []
    while link.counts.packets_received + link.counts.bad_payload + link.counts.duplicates < packets:
        wait_readable([link.transport], 5.0)
        messages += [received.message for received in link.receive()]
    return messages


def event(text: str, sequence: int) -> bytes:
    return encode_message(pb.Event(text=text), sequence)


def test_messages_come_in_order_with_the_time_of_their_arrival(peer: Peer, link: Link) -> None:
    peer.say(event("a", 0) + event("b", 1))
    wait_readable([link.transport], 5.0)
    received = link.receive()
    assert [r.message for r in received] == [pb.Event(text="a"), pb.Event(text="b")]
    assert {r.receive_ns for r in received} == {42}


def test_gaps_are_counted_across_the_wrap_and_duplicates_are_dropped(peer: Peer, link: Link) -> None:
    peer.say(event("a", 65534) + event("b", 1) + event("b", 1) + event("a", 65534) + event("c", 2))
    assert receive(link, 5) == [pb.Event(text="a"), pb.Event(text="b"), pb.Event(text="c")]
    assert (link.counts.sequence_gaps, link.counts.duplicates) == (2, 2)


def test_what_does_not_parse_is_counted_and_the_rest_goes_on(peer: Peer, link: Link) -> None:
    peer.say(encode_packet(Packet(1, 12, 0, b"\xff\xff")) + encode_packet(Packet(1, 99, 1, b"")) + event("a", 2))
    assert receive(link, 3) == [pb.Event(text="a")]
    assert link.counts.bad_payload == 2


def test_another_protocol_version_is_remembered(peer: Peer, link: Link) -> None:
    peer.say(encode_packet(Packet(7, 12, 0, b"")))
    assert receive(link, 1) == []
    assert link.foreign_version == 7


def test_what_comes_behind_a_virtual_time_came_at_that_time(peer: Peer, link: Link) -> None:
    link.virtual = True
    peer.say(encode_message(pb.VirtualTime(host_ns=1000), 0) + event("a", 1))
    peer.say(encode_message(pb.VirtualTime(host_ns=2000), 2) + event("b", 3))
    times: list[int] = []
    while len(times) < 2:
        wait_readable([link.transport], 5.0)
        times += [received.receive_ns for received in link.receive()]
    assert times == [1000, 2000]


def test_what_is_sent_arrives_and_is_numbered_from_identify(peer: Peer, link: Link) -> None:
    link.send(pb.Park())
    assert [link.send(pb.Identify(nonce=1)), link.send(pb.Park())] == [0, 1]
    assert link.sent_packets == 2
    decoder, packets = PacketDecoder(), list[Packet]()
    while len(packets) < 3:
        packets += decoder.feed(os.read(peer.master, 4096))
    assert [(p.type, p.sequence) for p in packets] == [(7, 0), (1, 0), (7, 1)]


@pytest.fixture
def many_open() -> Iterator[None]:
    """All descriptors that ``select`` takes are in use."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(limit[0], 2048), limit[1]))
    with ExitStack() as stack:
        while stack.enter_context(open(os.devnull)).fileno() < 1024:
            pass
        yield
    resource.setrlimit(resource.RLIMIT_NOFILE, limit)


@pytest.mark.usefixtures("many_open")
def test_descriptors_above_1023_are_waited_for() -> None:
    peer = Peer()
    with (
        closing(peer), closing(SerialPort(peer.path)) as port, socket.create_server(("127.0.0.1", 0)) as server,
        closing(SerialPort(f"socket://127.0.0.1:{server.getsockname()[1]}")) as host, server.accept()[0] as device,
    ):  # fmt: skip
        for each, say in ((port, peer.say), (host, device.sendall)):
            assert each.fileno() > 1023
            assert not wait_readable([each], 0.0)
            assert each.read_some() == b""
            say(event("a", 0))
            link = Link("camera", each, lambda: 42)
            assert receive(link, 1) == [pb.Event(text="a")]
            link.send(pb.Park())
        assert device.recv(100) == os.read(peer.master, 100) == encode_message(pb.Park(), 0)


def test_a_port_that_is_pulled_is_one_clear_error(peer: Peer, link: Link) -> None:
    descriptor, peer.master = peer.master, os.open(os.devnull, os.O_RDONLY)
    os.close(descriptor)
    with pytest.raises(PortError, match="lost"):
        link.receive()


def test_a_port_that_takes_nothing_is_waited_for_once(peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each who writes afterwards is refused at once, until it takes something."""
    waits = 0

    def counted(*arguments: Any) -> bool:
        nonlocal waits
        waits += 1
        return wait_readable(*arguments)

    monkeypatch.setattr("aolink.wire.port.wait_readable", counted)
    monkeypatch.setattr("aolink.wire.port.TIMEOUTS", Timeouts(write_s=0.3))
    with closing(SerialPort(peer.path)) as port:
        for first in (True, False):
            with pytest.raises(PortError, match="took no data"):
                port.write(bytes(1 << 20))
            assert bool(waits) is first
            waits = 0
        while wait_readable([peer.master], 0.1):
            os.read(peer.master, 1 << 20)
        port.write(b"a")


def test_a_port_that_is_not_there_is_refused() -> None:
    with pytest.raises(PortError, match="aolink devices"):
        SerialPort("/dev/nowhere")
    with pytest.raises(PortError, match="not a port"):
        SerialPort("nonsense://x")


def test_a_host_that_has_gone_is_one_clear_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = SerialPort(f"socket://127.0.0.1:{server.getsockname()[1]}")
        server.accept()[0].close()
    wait_readable([port], 5.0)
    with pytest.raises(PortError, match="another host"):
        port.read_some()
    port.close()
    for use in (port.read_some, lambda: port.write(b"a")):
        with pytest.raises(PortError, match="lost socket://"):
            use()


def test_nothing_listens() -> None:
    with pytest.raises(PortError, match="nothing listens"):
        SerialPort("socket://127.0.0.1:1")


def test_a_port_in_use_is_refused(peer: Peer, link: Link) -> None:
    with pytest.raises(PortError, match="in use"):
        SerialPort(peer.path)


def test_an_identity_is_no_duplicate_of_what_was_left_on_the_line(peer: Peer, link: Link) -> None:
    """The device counts anew from its Identity on; packets of the session before had the same numbers."""
    peer.say(event("a", 0) + event("b", 1) + b"half of a pa" + b"\0" + encode_message(pb.Identity(nonce=3), 0))
    peer.say(event("c", 1))
    found = receive(link, 4)
    assert [type(message).__name__ for message in found] == ["Event", "Event", "Identity", "Event"]
    assert (link.counts.duplicates, link.counts.sequence_gaps, link.counts.bad_framing) == (0, 0, 1)


def test_what_came_before_an_identity_is_no_message_of_this_session(peer: Peer) -> None:
    """A late answer to a host that was killed would be taken for one to the blocks of this session."""
    hub = Hub()
    link = hub.connect("mirror", SerialPort(peer.path))
    late = encode_message(pb.CommandAck(block_id=2), 8) + encode_message(pb.Identity(nonce=6), 9)
    peer.say(late + encode_message(pb.Identity(nonce=7), 0) + event("of this session", 1))
    identity = hub.request(link, pb.Identify(nonce=7), pb.Identity, lambda answer, _: answer.nonce == 7)
    assert identity is not None
    (received,) = [received for _, received in hub.wait(0.0)]
    hub.close()
    assert received.message == pb.Event(text="of this session")
