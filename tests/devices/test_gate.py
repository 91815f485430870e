"""Whatever a device says: an AolinkError or an event, never another exception, and never unbounded memory."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import tracemalloc
import tty
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aolink.assembly import Assembler, Frame
from aolink.devices.gate import Gate
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.errors import AolinkError, DeviceError
from aolink.recording import convert
from aolink.rig import load_rig
from aolink.simulation.devices import LineName, SimulatedDevices
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import Hub
from aolink.wire.link import Received
from aolink.wire.port import SerialPort, is_local
from tests.kinds import must_be

RIG = load_rig("section-vi")
KINDS = [
    pb.FrameChunk, pb.TruthChunk, pb.Applied, pb.CommandAck, pb.ClockReply, pb.Event, pb.Ack, pb.Identity, pb.Truth,
    pb.VirtualTime, pb.CommandBlock,
]  # fmt: skip


class Host:
    """The host's side of a session in real time, without the loop: two devices behind one gate."""

    def __init__(self, hub: Hub) -> None:
        self.camera_link, self.mirror_link = hub.links
        self.now = hub.now_ns()
        device = SimulatedDevices(RIG, virtual_time=False, step_zero_ns=self.now)
        identities = []
        lines: tuple[LineName, LineName] = ("camera", "mirror")
        for line in lines:
            device.handle(line, pb.Identify(nonce=1), 0)
            identity = device.outbox.pop().message
            assert isinstance(identity, pb.Identity)
            identities.append(identity)
        gate = Gate(RIG, hub, identities, self.now)
        self.camera = NativeCamera(hub, self.camera_link, identities[0], gate)
        self.mirror = NativeMirror(hub, self.mirror_link, identities[1], gate)
        self.assembler = Assembler(RIG)
        for each in (self.camera, self.mirror):
            each.query_clock(self.now)
            reply = pb.ClockReply(
                query_id=1, host_send_ns=self.now, device_receive_ns=self.now, device_send_ns=self.now
            )
            each.handle(Received(reply, self.now + 200_000))
            assert each.clock.ready
        self.mirror.send_block(0, np.zeros((50, 1)), 0, self.now)

    def take(self, message: Message, *, camera: bool) -> None:
        """What the loop does with a message."""
        self.now += 10_000_000
        device = self.camera if camera else self.mirror
        for event in device.handle(Received(message, self.now)):
            if isinstance(event, Frame):
                start_ns, sigma = device.steps.host_ns(event.device_start_ns, event.first_step * 10**6, self.now)
                convert.frame_messages(event)[0].host_start_ns = start_ns
                assert sigma >= 0
                self.assembler.add_frame(event)
            elif isinstance(event, pb.Applied):
                self.mirror.steps.host_ns(event.device_ns, (event.first_step + event.n_steps) * 10**6, self.now)
                self.assembler.add_applied(event)


@pytest.fixture(scope="module")
def ports() -> Iterator[tuple[str, str]]:
    pairs = [pty.openpty() for _ in range(2)]
    for master, slave in pairs:
        tty.setraw(slave)
        os.set_blocking(master, False)
    camera, mirror = (os.ttyname(slave) for _, slave in pairs)
    yield camera, mirror
    for pair in pairs:
        for descriptor in pair:
            os.close(descriptor)


@pytest.fixture(scope="module")
def hub(ports: tuple[str, str]) -> Iterator[Hub]:
    class Sink(SerialPort):
        """A port whose other end takes everything."""

        def write(self, data: bytes) -> None:
            pass

    hub = Hub()
    for name, port in zip(("camera", "mirror"), ports, strict=True):
        hub.connect(name, Sink(port))
    yield hub
    hub.close()


def numbers(field: Any) -> st.SearchStrategy[object]:
    unsigned, bits = field.cpp_type in (3, 4), 64 if field.cpp_type in (2, 4) else 32
    low, high = (0, 2**bits - 1) if unsigned else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return st.integers(0, 200) | st.sampled_from([low, high]) | st.integers(low, high)


def values(field: Any) -> st.SearchStrategy[object]:
    """What a field may hold, by its descriptor; those of protobuf's own C code are of another type."""
    if field.cpp_type in (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT):
        return st.sampled_from([0.0, 0.05, -1e300, float("nan"), float("inf")])
    if field.cpp_type == FieldDescriptor.CPPTYPE_BOOL:
        return st.booleans()
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return st.integers(-1, 9)
    if field.cpp_type == FieldDescriptor.CPPTYPE_STRING:
        return st.text(max_size=20) if field.type == FieldDescriptor.TYPE_STRING else st.binary(max_size=100)
    return numbers(field)


@st.composite
def messages(draw: st.DrawFn) -> Message:
    """A message that is sound, with some of its fields changed to anything."""
    frame, step = draw(st.integers(0, 3)), draw(st.sampled_from([0, 50, 200]))
    sound: dict[type[Message], Message] = {
        pb.FrameChunk: pb.FrameChunk(
            frame_id=frame, total=80, width=40, height=1, first_step=200 * frame, last_step=200 * frame + 199,
            exposure_start_ns=200_000_000 * frame, exposure_end_ns=200_000_000 * (frame + 1), data=bytes(80),
        ),
        pb.Applied: pb.Applied(block_id=1, first_step=step, n_steps=50, u=[0.0] * 50),
        pb.CommandAck: pb.CommandAck(block_id=1, queue_end_step=50),
        pb.TruthChunk: pb.TruthChunk(frame_id=1, total=4, data=b"\x08\x01\x10\x01"),
    }  # fmt: skip
    kind = draw(st.sampled_from(KINDS))
    message = must_be(Message, sound.get(kind, kind()))
    fields = [field for field in message.DESCRIPTOR.fields if field.message_type is None]
    for field in draw(st.lists(st.sampled_from(fields), max_size=2)):
        if field.is_repeated:
            del getattr(message, field.name)[:]
            getattr(message, field.name).extend(draw(st.lists(values(field), max_size=60)))
        else:
            setattr(message, field.name, draw(values(field)))
    return message


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.lists(st.tuples(messages(), st.booleans()), max_size=15))
def test_any_stream_of_messages_is_taken_or_refused_in_words(hub: Hub, stream: list[tuple[Message, bool]]) -> None:
    host = Host(hub)
    for message, camera in stream:
        with contextlib.suppress(AolinkError):
            host.take(message, camera=camera)
    for exposure in host.assembler.flush():
        assert exposure.n_steps == 200
        assert np.abs(exposure.inputs).max() <= 0.06


ENDLESS: dict[str, tuple[bool, Callable[[int], Message]]] = {
    "one byte of a frame, again and again": (
        True,
        lambda k: pb.FrameChunk(frame_id=1, total=80, width=40, height=1, last_step=199, data=b"x"),
    ),
    "a truth that never ends": (True, lambda k: pb.TruthChunk(frame_id=1, offset=k, total=5000, data=b"x")),
    "answers that nobody asked for": (True, lambda k: pb.Ack(sequence=k % 65_536)),
    "clock replies that nobody asked for": (True, lambda k: pb.ClockReply(query_id=k)),
    "the same report": (False, lambda k: pb.Applied(block_id=1, first_step=0, n_steps=50, u=[0.0] * 50)),
    "the same answer": (False, lambda k: pb.CommandAck(block_id=1, queue_end_step=50)),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", ENDLESS)
def test_no_stream_fills_the_memory(hub: Hub, what: str) -> None:
    camera, make = ENDLESS[what]
    host = Host(hub)

    def say(first: int, n: int) -> None:
        for k in range(first, first + n):
            try:
                host.take(make(k), camera=camera)
            except DeviceError:
                return

    say(0, 1000)
    tracemalloc.start()
    try:
        say(1000, 4000)
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert grown < 200_000


class Descriptor(SerialPort):
    """A port of which only the descriptor is there."""

    def __init__(self, number: int) -> None:
        self.number = number

    def fileno(self) -> int:
        return self.number


def test_virtual_time_is_for_rigs_on_this_machine(hub: Hub) -> None:
    assert all(is_local(link.transport) for link in hub.links)
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as here:
        assert is_local(Descriptor(here.fileno()))
    read, write = os.pipe()  # neither a pseudo terminal nor a socket, as little as a serial line is
    elsewhere = Hub()
    elsewhere.connect("camera", Descriptor(read))
    with pytest.raises(DeviceError, match="the camera says that it runs on virtual time, as only a simulated rig"):
        elsewhere.go_virtual(lambda link, handed: None)
    for descriptor in (read, write):
        os.close(descriptor)
