"""A host that says anything: a simulated rig on real pseudo terminals goes on, and answers the next host."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator

import pytest
from google.protobuf.message import Message

from aolink.rig import load_rig
from aolink.simulation.devices import LineName
from aolink.simulation.server import RigServer
from aolink.simulation.streams import PtyStream, Stream, TcpStream
from aolink.wire import messages_pb2 as pb
from aolink.wire.link import Link
from aolink.wire.port import SerialPort
from tests.extremes import changes

RIG = load_rig("section-vi")
SOUND: list[Message] = [
    pb.Identify(nonce=5), pb.CommandBlock(block_id=1, n_steps=50, u=[0.01] * 50), pb.AppliedQuery(n_steps=50),
    pb.CameraControl(run=True, exposures=1), pb.ClockQuery(query_id=1, host_send_ns=1_767_225_600_000_000_000),
    pb.Part(type=3, total=5000, data=b"x" * 4000), pb.Park(), pb.Rearm(), pb.Event(), pb.VirtualTime(),
]  # fmt: skip
LINES: tuple[LineName, ...] = ("camera", "mirror")
DEADLINE_S = 20.0


class Served:
    """A rig and the host's ends of its two lines, in one thread."""

    def __init__(self, *, real_time: bool, tcp: bool) -> None:
        self._streams: dict[LineName, Stream] = {
            line: TcpStream("127.0.0.1", 0) if tcp else PtyStream() for line in LINES
        }
        self.server = RigServer(RIG, self._streams, real_time=real_time)
        self.links = {
            line: Link(line, SerialPort(stream.name), time.monotonic_ns) for line, stream in self._streams.items()
        }

    def identity(self, line: LineName, nonce: int) -> pb.Identity:
        """Ask who is there, and serve until it has answered."""
        self.links[line].send(pb.Identify(nonce=nonce))
        end = time.monotonic() + DEADLINE_S
        while time.monotonic() < end:
            self.server.serve()
            for received in self.links[line].receive():
                if isinstance(received.message, pb.Identity) and received.message.nonce == nonce:
                    return received.message
        raise AssertionError(f"the {line} does not answer any more")

    def close(self) -> None:
        for line in LINES:
            self.links[line].transport.close()
            self._streams[line].close()


@pytest.fixture(params=["virtual, pty", "real, pty", "real, TCP"])
def served(request: pytest.FixtureRequest) -> Iterator[Served]:
    served = Served(real_time="real" in request.param, tcp="TCP" in request.param)
    for line in LINES:  # over TCP nothing is taken before
        served.identity(line, 1)
    yield served
    served.close()


@pytest.mark.parametrize("sound", SOUND, ids=lambda message: type(message).__name__)
def test_a_rig_bears_every_extreme_of_every_field(served: Served, sound: Message) -> None:
    nonce, before = 100, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _, _, change in changes(type(sound)):
        message = type(sound)()
        message.CopyFrom(sound)
        change(message)
        for line in LINES:
            served.links[line].send(message)
        for line in LINES:
            nonce += 1
            identity = served.identity(line, nonce)
            assert -(1 << 62) < identity.step_zero_ns < 1 << 62
    assert served.server.devices.step < 100_000
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 << 10  # KiB


def test_what_is_left_on_a_line_costs_no_request(served: Served) -> None:
    """Bytes without a delimiter, of a host that was killed: the first Identify behind them is answered."""
    for line in LINES:
        served.links[line].transport.write(b"\x05half of a pack")
        served.server.serve()
        assert served.identity(line, 7).nonce == 7
