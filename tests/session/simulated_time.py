"""A rig in real time on a simulated clock: sessions with latency, cuts and hold-ups, the same every time.

Session, protocol and rig are the real ones, bytes and packets too; only the clock and the line between them are not.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import Message

from aolink.control import ControllerRow
from aolink.devices.gate import Gate
from aolink.devices.host import Host
from aolink.devices.identity import identify
from aolink.devices.native import NativeCamera, NativeMirror
from aolink.devices.no_mirror import NoMirror
from aolink.errors import PortError
from aolink.estimation import Driver
from aolink.exposure import Exposure
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter
from aolink.rig import Rig
from aolink.session.commanding import Inputs
from aolink.session.controlling import Controlling
from aolink.session.estimating import BesideTheLoop, Outcome
from aolink.session.loop import SessionLoop
from aolink.session.report import Report
from aolink.signals import Interrupted
from aolink.simulation.devices import LineName
from aolink.simulation.server import RigServer
from aolink.simulation.streams import Stream
from aolink.wire import messages_pb2 as pb
from aolink.wire.link import Link, Received
from aolink.wire.packet import MESSAGE_OF_TYPE, PacketDecoder, encode_packet
from tests.kinds import must_be

_EPOCH_NS = 1_767_225_600_000_000_000
_TRUTH_STEPS = 200
_TURN_NS = 20_000
"""What the host takes for one turn of its loop."""


class Way:
    """Bytes in one direction."""

    def __init__(self, hub: SimulatedTimeHub) -> None:
        self._hub = hub
        self.latency_ns = 500_000
        self.bytes_per_s = math.inf
        self.cut = False
        """Nothing gets through."""
        self._bytes: deque[tuple[int, bytes]] = deque()
        self._free_ns = 0
        """When the line is free again."""

    def write(self, data: bytes) -> int:
        self._free_ns = max(self._free_ns, self._hub.clock_ns) + round(1e9 * len(data) / self.bytes_per_s)
        if not self.cut:
            self._bytes.append((self._free_ns + self.latency_ns, data))
        return len(data)

    def backlog_ns(self) -> int:
        """How long the line still takes for what was written."""
        return max(0, self._free_ns - self._hub.clock_ns)

    def unsent(self) -> int:
        """Bytes that have not left."""
        return math.ceil(self.backlog_ns() * self.bytes_per_s / 1e9) if self.backlog_ns() else 0

    def read(self) -> bytes:
        data = b""
        while self._bytes and self._bytes[0][0] <= self._hub.clock_ns:
            data += self._bytes.popleft()[1]
        return data

    def next_ns(self) -> float:
        """When the next bytes come."""
        return self._bytes[0][0] if self._bytes else math.inf


class End:
    """One end of a line, as a host's transport and as a device's stream."""

    def __init__(self, name: str, incoming: Way, outgoing: Way) -> None:
        self.name = name
        self.read, self._outgoing = incoming.read, outgoing
        self.unsent = outgoing.unsent
        self.gone = False
        """Whether the port has vanished; it can be opened again at once, whoever hears it."""

    def read_some(self) -> bytes:
        if self.gone:
            raise PortError(f"the {self.name} was pulled out")
        return self.read()

    def write(self, data: bytes) -> Any:
        """Gives how much was taken, for a device; for a host nobody asks."""
        return self._outgoing.write(data)

    def fileno(self) -> int:
        raise AssertionError("nobody waits on a simulated line")

    def reopen(self) -> None:
        self.gone = False

    def opened(self) -> End:
        """The same port, opened again."""
        self.reopen()
        return self

    def close(self) -> None:
        pass


class SimulatedTimeHub(Host):
    """Both ends: the host's hub and the rig's server, on one clock that moves from event to event."""

    def __init__(self, rig: Rig, seed: int | None = None, stop: Callable[[], bool] = lambda: False) -> None:
        super().__init__(stop)
        self.clock_ns = 0
        self.loop: SessionLoop | None = None
        """The session's, once it has begun."""
        self.at: list[tuple[int, Callable[[], object]]] = []
        """What is to happen when, on the clock."""
        self.held: dict[int, tuple[int, int]] = {}
        """What the mirror really held: the command's block and the source, by fast step, ..."""
        self.held_inputs: dict[int, list[float]] = {}
        """... and the inputs."""
        names: tuple[LineName, LineName] = ("camera", "mirror")
        self.to_device, self.to_host = ({name: Way(self) for name in names} for _ in range(2))
        streams: dict[LineName, Stream] = {name: End(name, self.to_device[name], self.to_host[name]) for name in names}
        self.server = RigServer(rig, streams, seed=seed, real_time=True, clock_ns=lambda: self.clock_ns)
        self.ends = {name: End(name, self.to_host[name], self.to_device[name]) for name in names}
        """The host's."""
        self.links += [Link(name, end, self.now_ns) for name, end in self.ends.items()]

    def now_ns(self) -> int:
        return _EPOCH_NS + self.clock_ns

    def change(self, name: LineName, firmware: Callable[[Message], Message | None]) -> None:
        """Give the device on a line another firmware: it sends what the function makes of its messages, packet by
        packet; None for nothing."""
        decoder, read = PacketDecoder(), self.ends[name].read

        def changed() -> bytes:
            sent = b""
            for packet in decoder.feed(read()):
                message = firmware(MESSAGE_OF_TYPE[packet.type].FromString(packet.payload))
                if message is not None:
                    sent += encode_packet(replace(packet, payload=message.SerializeToString()))
            return sent

        self.ends[name].read = changed

    def cut(self, *, to_device: bool = True, to_host: bool = True) -> None:
        """Cut or mend the mirror's line."""
        self.to_device["mirror"].cut, self.to_host["mirror"].cut = to_device, to_host

    def pull(self, seconds: float) -> None:
        """Pull out the mirror's line, and plug it in again after so long."""
        self.cut()
        self.ends["mirror"].gone = True
        self.at.append((self.clock_ns + round(seconds * 1e9), lambda: self.cut(to_device=False, to_host=False)))
        self.at.sort(key=itemgetter(0))

    def wait(self, timeout_s: float) -> list[tuple[Link, Received]]:
        pending, self.pending = self.pending, []
        for thread in threading.enumerate():
            if thread.name == "aolink-reopening":  # which takes no time on the simulated clock
                thread.join()
        self.clock_ns += _TURN_NS
        end_ns = self.clock_ns + math.ceil(max(0.0, min(timeout_s, 0.1)) * 1e9)
        while True:
            self._serve()
            pending += [(link, received) for link in self.links for received in link.receive()]
            for each in self.beside:
                each.serve()
            if pending or self.clock_ns >= end_ns:
                return pending
            self._move(end_ns)

    def hold_up(self, seconds: float) -> None:
        """The host does nothing for a while; the rig goes on."""
        end_ns = self.clock_ns + round(seconds * 1e9)
        while self.clock_ns < end_ns:
            self._serve()
            self._move(end_ns)

    def truth(self) -> dict[int, tuple[int, int]]:
        """`held`, up to now."""
        devices, step = self.server.devices, len(self.held)
        while step < devices.step:
            devices.handle("mirror", pb.AppliedQuery(first_step=step, n_steps=devices.step - step), 0)
            answer = devices.outbox.pop().message
            assert isinstance(answer, pb.Applied)
            assert answer.source != pb.Applied.NOT_REPORTED
            for u in np.array(answer.u).reshape(answer.n_steps, -1):
                self.held[step], self.held_inputs[step] = (answer.block_id, answer.source), list(u)
                step += 1
        return self.held

    def _serve(self) -> None:
        while self.at and self.at[0][0] <= self.clock_ns:
            self.at.pop(0)[1]()
        self.server.serve()
        if self.server.devices.step - len(self.held) > _TRUTH_STEPS:
            self.truth()

    def _move(self, end_ns: int) -> None:
        """On to the next event, but not beyond ``end_ns``."""
        ways = [*self.to_device.values(), *self.to_host.values()]
        events = [way.next_ns() for way in ways] + [at for at, _ in self.at]
        # What has come already waits for a host that is held up: it is no event.
        events = [at for at in events if at > self.clock_ns]
        due_ns = min(self.clock_ns + math.ceil(self.server.idle_s() * 1e9), *events, end_ns)
        self.clock_ns = max(self.clock_ns + 1000, int(due_ns))


@dataclass
class Run:
    """A session on simulated time."""

    hub: SimulatedTimeHub
    loop: SessionLoop
    mirror: NativeMirror
    path: Path
    exposures: list[Exposure]
    """As they were made live."""
    error: Exception | Interrupted | None = None

    @property
    def first_step(self) -> int:
        """First fast step of the session."""
        command = next(Recording(self.path).messages(topics.COMMAND)).message
        return must_be(pb.CommandBlock, command).first_step

    @property
    def report(self) -> Report:
        return self.loop.report


def run_session(
    hub: SimulatedTimeHub,
    rig: Rig,
    path: Path,
    exposures: int,
    *,
    inputs: Inputs | None = None,
    controller: str | ControllerRow = "",
    estimators: Sequence[str] = (),
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] = lambda exposures: None,
    reconnect_s: float = 0.0,
    alone: bool = False,
    beside: BesideTheLoop | None = None,
) -> Run:
    """A session from Identify to the end of its account, as `aolink.session.record` makes it; errors are kept.

    With ``alone`` the camera is recorded without a mirror; ``beside`` estimates instead of the estimators' driver.
    """
    live: list[Exposure] = []
    camera_link, mirror_link = hub.links
    asked_ns = hub.now_ns()
    camera_identity, mirror_identity = identify(hub, camera_link, 1), identify(hub, mirror_link, 2)
    gate = Gate(rig, hub, (camera_identity, mirror_identity), asked_ns)
    camera = NativeCamera(hub, camera_link, camera_identity, gate)
    mirror = NativeMirror(hub, mirror_link, mirror_identity, gate)
    hub.native = [camera, mirror]
    no_mirror = NoMirror(rig, hub.now_ns, camera.since_zero_ns)
    if alone:
        hub.native, hub.polled = [camera], [no_mirror]
    if reconnect_s:
        mirror.port.allow(hub.ends["mirror"].opened, reconnect_s)
    for link in hub.links:
        link.reset_counts()
    with RecordingWriter(path, rig, {}, hub.now_ns(), deterministic=True) as writer:
        loop = SessionLoop(
            rig, hub, camera, no_mirror if alone else mirror, writer, Driver(rig, estimators), inputs, beside=beside,
            controlling=Controlling(rig, controller, estimators) if controller else None,
        )  # fmt: skip
        offer = loop._estimating.offer

        def offered(exposure: Exposure) -> list[Outcome]:
            live.append(exposure)
            return offer(exposure)

        loop._estimating.offer = offered  # type: ignore[method-assign]
        run, hub.loop, hub.beside = Run(hub, loop, mirror, path, live), loop, beside.processes if beside else ()
        try:
            loop.run(exposures, stop, progress)
        except (Exception, Interrupted) as error:
            run.error = error
            try:
                loop.make_safe()
            except Exception as unsafe:
                loop.report.warnings.append(str(unsafe))
            loop.close_account()
            loop.finish_estimates(0.0)
        writer.close(loop.report.counts())
    hub.truth()
    return run
