"""The simulated rig as a process: two serial lines (camera, mirror) on pseudo terminals or TCP ports.

In real time the plant runs with the clock. On virtual time it runs to the end of the last queued
command block and waits there; the host's time is sent on every line with `VirtualTime` packets, so commands drive time,
and the same seed gives the same bytes however fast the host is.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np
from google.protobuf.message import DecodeError, Message

from aolink.errors import RigError
from aolink.polling import wait_readable
from aolink.rig import Faults, Rig
from aolink.simulation.devices import LineName, Outgoing, SimulatedDevices
from aolink.simulation.faults import Way
from aolink.simulation.streams import Stream, refusal_event
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import (
    DELIMITER,
    PROTOCOL_VERSION,
    MessageDecoder,
    Packet,
    PacketDecoder,
    PacketType,
    encode_packets,
)

VIRTUAL_EPOCH_NS = 1_767_225_600_000_000_000
"""Host time at which a virtual session begins: 2026-01-01 00:00 UTC, always the same."""
_TURNAROUND_NS = 5_000
"""Time between a clock query and its reply."""
_IDLE_S = 0.5
"""Longest sleep in real time: the plant is never further behind than this."""
_MOST_REST = 16 << 10
"""The most bytes without a delimiter that are held: more than any packet has."""
_LAST_NS = 1 << 62
_LONGEST_PAUSE_NS = 3_600_000_000_000
"""Virtual time also advances with the host's clock queries, at once by no more than this, ns."""
_UNREAD_LIMIT = 16 << 20
"""Bytes that wait for a host that does not read; in real time, what is beyond it is dropped."""


class LineEnd:
    """The device's end of one line: bytes in and out, their faults and delays, packets, counts.

    Faults act on the bytes of whole packets between the port and the decoder. They begin after Identify and Identity,
    because a host on a slow machine may send Identify again, in real time. `VirtualTime` is a side channel and suffers
    none.
    """

    def __init__(self, line: LineName, stream: Stream, faults: Faults, seed: np.random.SeedSequence) -> None:
        self.line, self.stream = line, stream
        self.taken = 0
        """Bytes from this session's Identify on that have been handled, lost and damaged ones included."""
        self.unsent = bytearray()
        # One generator for each direction, because the order of incoming and outgoing packets depends on speed.
        incoming, outgoing = (np.random.default_rng(each) for each in seed.spawn(2))
        self.to_device, self.to_host = Way(faults, incoming, to_host=False), Way(faults, outgoing, to_host=True)
        self._faulty, self._vanish_ns = faults != Faults(), round(faults.vanish_s * 1e9)
        self._vanishes = False
        self.returns_ns: int | None = None
        """When a port that has vanished returns; None while it is there."""
        self._decoder = PacketDecoder()
        self._messages = MessageDecoder()
        self._rest = b""
        """The beginning of a packet whose delimiter has not come yet."""
        self._incoming: deque[tuple[int, bytes]] = deque()
        """In real time, packets that are still on a slow line, and the times at which they come."""
        self._outgoing: deque[tuple[int, bytes]] = deque()
        self._sequence = 0

    def read(self, now_ns: int, *, real_time: bool) -> None:
        """Take the bytes that have come at the port; in real time with the line's delay."""
        if self.returns_ns is not None:
            return
        *whole, self._rest = (self._rest + self.stream.read()).split(DELIMITER)
        pieces = [piece + DELIMITER for piece in whole]
        if len(self._rest) > _MOST_REST:
            pieces, self._rest = [*pieces, self._rest], b""
        for piece in pieces:
            delay_ns = self.to_device.delay_ns() if real_time and piece != DELIMITER else 0
            self._put_off(self._incoming, now_ns + delay_ns, piece)

    def take_undelimited(self) -> bool:
        """Take bytes that have come without a delimiter as well; False if there are none."""
        if self._rest:
            self._incoming.append((0, self._rest))
            self._rest = b""
            return True
        return False

    def pieces(self, now_ns: int) -> Iterator[bytes]:
        """The bytes that have come by now, packet by packet, as the host sent them."""
        while self._incoming and self._incoming[0][0] <= now_ns:
            yield self._incoming.popleft()[1]

    def messages(self, piece: bytes) -> list[tuple[Message, int]]:
        """The messages, (message, sequence), in the bytes of a packet after the line's faults."""
        if self._faulty and piece != DELIMITER:
            identify = any(packet.type == PacketType.IDENTIFY for packet in PacketDecoder().feed(piece))
            self._vanishes |= not identify and self.to_device.vanishes()
            piece = DELIMITER + piece if identify else self.to_device.damage(piece)
        packets = self._decoder.feed(piece)
        return [(m, packet.sequence) for packet in packets if (m := self._parse(packet)) is not None]

    def begin_session(self) -> None:
        """Begin a session on Identify: drop the bytes that were not sent yet, because they are for a host that is
        gone."""
        self._outgoing.clear()
        self.unsent[:] = DELIMITER  # ends a packet that was partly sent
        self._sequence = 0

    def put(self, message: Message, due_ns: int = 0) -> None:
        """Queue a message for sending at ``due_ns``."""
        for packet in encode_packets(message, self._sequence):
            self._sequence = (self._sequence + 1) & 0xFFFF
            if isinstance(message, pb.VirtualTime):
                packet = DELIMITER + packet  # ends any damaged packet before it
            elif not isinstance(message, pb.Identity) and self._faulty:
                self._vanishes |= self.to_host.vanishes()
                packet = self.to_host.damage(packet)
            self._put_off(self._outgoing, due_ns, packet)

    def vanish_and_return(self, now_ns: int) -> None:
        """Let the port vanish, with all bytes on the line, if this fault has hit a packet; let it return when it is
        due."""
        if self._vanishes and self.returns_ns is None:
            self.stream.close()
            self.returns_ns = now_ns + self._vanish_ns
        if self.returns_ns is not None:
            self._rest = b""
            for held in (self._incoming, self._outgoing, self.unsent):
                held.clear()
            if now_ns >= self.returns_ns:
                self.stream.reopen()
                self._vanishes, self.returns_ns = False, None

    def flush(self, now_ns: int) -> None:
        """Send the bytes that the port takes now."""
        while self._outgoing and self._outgoing[0][0] <= now_ns:
            self.unsent += self._outgoing.popleft()[1]
        while self.unsent:
            sent = self.stream.write(bytes(self.unsent[:65_536]))
            if not sent:
                return
            del self.unsent[:sent]

    def waiting(self) -> int:
        """Bytes that wait for the line or for the host."""
        return len(self.unsent) + sum(len(data) for _, data in self._outgoing)

    def due_ns(self) -> float:
        """The time at which the next bytes come out of a slow line, in either direction."""
        if self.returns_ns is not None:
            return self.returns_ns
        return min((way[0][0] for way in (self._incoming, self._outgoing) if way), default=math.inf)

    def _put_off(self, way: deque[tuple[int, bytes]], due_ns: int, data: bytes) -> None:
        """Queue bytes in order: none overtakes earlier ones."""
        way.append((max(due_ns, way[-1][0]) if way else due_ns, data))

    def _parse(self, packet: Packet) -> Message | None:
        if packet.version != PROTOCOL_VERSION:
            if packet.type == PacketType.IDENTIFY:
                self.put(refusal_event(packet.version))
            return None
        try:
            return self._messages.take(packet)
        except DecodeError:
            return None


class RigServer:
    """Runs the simulated devices behind two serial lines until it is stopped."""

    def __init__(
        self, rig: Rig, streams: dict[LineName, Stream], *, seed: int | None = None, real_time: bool = False,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        simulation = rig.simulation
        if simulation.faults.vanish_rate and not real_time:
            raise RigError("simulation.faults.vanish_rate: ports vanish in real time only: add --real-time")
        seeds = np.random.SeedSequence(simulation.seed if seed is None else seed).spawn(8)[5:]
        self._lines: dict[LineName, LineEnd] = {
            line: LineEnd(line, stream, simulation.faults, seeds[i]) for i, (line, stream) in enumerate(streams.items())
        }
        self._latency_rng = np.random.default_rng(seeds[2])
        self._real_time, self._clock_ns = real_time, clock_ns
        self._latency_ns = round(simulation.latency_s * 1e9)
        self._clock_rate = 1 + simulation.clock_drift_ppm * 1e-6
        self._start_ns = clock_ns() if real_time else VIRTUAL_EPOCH_NS
        self._step_zero_ns = self._start_ns + round(simulation.clock_offset_s * 1e9)
        self._now_ns = self._start_ns  # virtual time
        self._last_valid_ns = self._start_ns
        self._sent_ns: dict[LineName, int] = {}
        self._late_rate, self._chunk_loss_rate = simulation.faults.late_rate, simulation.faults.chunk_loss_rate
        self._late: list[tuple[int, pb.CommandBlock, int]] = []
        """Blocks that a fault holds back, each with the step at which it comes and its sequence number."""
        self._clock_step = round(simulation.faults.clock_step_s * 1e9), round(simulation.faults.clock_step_at_s * 1e9)
        self._watchdog_ns = round(rig.mirror.watchdog_s * 1e9)
        self._step_ns, self._queue_steps = rig.timing.fast_step_ns, rig.mirror.queue_steps
        self.devices = SimulatedDevices(rig, seed, virtual_time=not real_time, step_zero_ns=self._step_zero_ns)

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve until ``stop()`` gives True; it is called at least twice a second."""
        while not stop():
            self._wait()
            self.serve()

    def serve(self) -> None:
        """Handle the packets that have come, and all that is due."""
        if self._real_time:
            self._catch_up(whole_reports=True)
        for line in self._lines.values():
            line.read(self._host_ns(), real_time=self._real_time)
            for piece in line.pieces(self._host_ns()):
                self._deal_with(line, piece)
        if self._real_time:
            self._take_late()
            self._watch()
            self._post(self.devices.outbox)
        for line in self._lines.values():
            line.vanish_and_return(self._host_ns())
            line.flush(self._host_ns())

    def idle_s(self) -> float:
        """Time until something is due if no bytes come, s; at most half a second."""
        if not self._real_time:
            return _IDLE_S
        due_ns: float = self.devices.device_ns(self.devices.next_report_step()) - self._device_ns()
        if self.devices.armed:
            due_ns = min(due_ns, self._last_valid_ns + self._watchdog_ns - self._host_ns())
        due_ns = min(due_ns, *(line.due_ns() - self._host_ns() for line in self._lines.values()))
        return min(max(due_ns / 1e9, 0.0), _IDLE_S)

    def _wait(self) -> None:
        here = [line for line in self._lines.values() if line.returns_ns is None]
        unsent = [line.stream for line in here if line.unsent]
        idle = not wait_readable([line.stream for line in here], self.idle_s(), unsent)
        if idle and not self._real_time:  # a delimiter was damaged on its way, and the host waits
            for line in self._lines.values():
                line.take_undelimited()

    def _host_ns(self) -> int:
        return self._clock_ns() if self._real_time else self._now_ns

    def _device_ns(self) -> int:
        return self._step_zero_ns + math.floor((self._host_ns() - self._start_ns) * self._clock_rate)

    def _deal_with(self, line: LineEnd, piece: bytes) -> None:
        """Handle a packet of the host after the line's faults; on virtual time also everything that follows from it."""
        if piece == DELIMITER:  # a delimiter before an Identify: it ends a packet that was left on the line
            line.messages(piece)
            return
        size_ns, at_ns = self._clock_step
        if size_ns and self._host_ns() - self._start_ns >= at_ns:
            self.devices.clock_set_ns = size_ns
        for message, sequence in line.messages(piece):
            if isinstance(message, pb.Identify):
                line.begin_session()
                line.taken = 0
                self._sent_ns.pop(line.line, None)
            if line.line == "mirror":  # the camera's line may be alive while the mirror's is dead
                self._last_valid_ns = self._host_ns()
            if isinstance(message, pb.ClockQuery):
                self._answer_clock(line, message)
            elif isinstance(message, pb.CommandBlock) and line.to_device.hits(self._late_rate):
                self._put_off(message, sequence)
            else:
                self._handle(line, message, sequence)
        if not self._real_time:
            self._take_late()
            self._post(self.devices.outbox)
            self.devices.advance_to(self.devices.ready_end)
            self._post(self.devices.outbox)
        line.taken += len(piece)  # only now: the host waits for all that follows from it
        if not self._real_time:
            for each in self._lines.values():
                self._tell_time(each, done=True)

    def _handle(self, line: LineEnd, message: Message, sequence: int) -> None:
        if self._real_time:  # lateness is judged by the clock, not by the last report
            self._catch_up(whole_reports=False)
        self.devices.handle(line.line, message, sequence)

    def _put_off(self, block: pb.CommandBlock, sequence: int) -> None:
        """Hold back a block that a fault makes late: it comes when half of its steps have gone by, unless that is
        never."""
        step = block.first_step + block.n_steps // 2
        if step <= self.devices.step + self._queue_steps:
            self._late.append((step, block, sequence))

    def _take_late(self) -> None:
        """Take the late blocks that are due now; on virtual time nothing else advances time to them."""
        late, self._late = self._late, []
        for step, block, sequence in late:
            if not self._real_time:
                self.devices.advance_to(step)
            if step <= self.devices.step:
                self._handle(self._lines["mirror"], block, sequence)
            else:
                self._late.append((step, block, sequence))

    def _answer_clock(self, line: LineEnd, query: pb.ClockQuery) -> None:
        if not self._real_time:
            latest_ns = min(self._now_ns + _LONGEST_PAUSE_NS, _LAST_NS)
            if self._now_ns < query.host_send_ns <= latest_ns:
                self._now_ns = query.host_send_ns
            self._now_ns += self._draw_latency() + line.to_device.delay_ns()
        received = self._device_ns() + self.devices.clock_set_ns
        if not self._real_time:
            self._now_ns += _TURNAROUND_NS
        sent = self._device_ns() + self.devices.clock_set_ns
        if not self._real_time:
            self._now_ns += self._draw_latency() + line.to_host.delay_ns()
            self._tell_time(line)
        times = {"host_send_ns": query.host_send_ns, "device_receive_ns": received, "device_send_ns": sent}
        self._send(line, pb.ClockReply(query_id=query.query_id, **times))

    def _send(self, line: LineEnd, message: Message) -> None:
        line.put(message, self._host_ns() + line.to_host.delay_ns() if self._real_time else 0)

    def _draw_latency(self) -> int:
        """The latency in one direction: never under 80 % of the median, with a tail."""
        return round(self._latency_ns * (0.8 + 0.29 * float(self._latency_rng.standard_exponential())))

    def _post(self, outbox: list[Outgoing]) -> None:
        delays = {} if self._real_time else {name: end.to_host.delay_ns() for name, end in self._lines.items()}
        for out in outbox:
            line = self._lines[out.line]
            if not self._real_time:
                left = self._now_ns
                if out.after_step is not None:
                    elapsed = (out.after_step + 1) * self._step_ns
                    left = max(left, self._start_ns + math.ceil(elapsed / self._clock_rate))
                self._now_ns = max(self._now_ns, left + self._latency_ns + delays.pop(out.line, 0))
                self._tell_time(line)
            elif line.waiting() > _UNREAD_LIMIT:
                continue
            if isinstance(out.message, pb.FrameChunk) and line.to_host.hits(self._chunk_loss_rate):
                continue
            self._send(line, out.message)
        outbox.clear()

    def _tell_time(self, line: LineEnd, *, done: bool = False) -> None:
        """Send the host's time if it has changed, or if a packet has been handled."""
        if done or self._sent_ns.get(line.line) != self._now_ns:
            self._sent_ns[line.line] = self._now_ns
            taken = {name: end.taken for name, end in self._lines.items()}
            line.put(pb.VirtualTime(host_ns=self._now_ns, camera_bytes=taken["camera"], mirror_bytes=taken["mirror"]))

    def _catch_up(self, *, whole_reports: bool) -> None:
        """In real time, let the plant run to now; with ``whole_reports``, only to the end of a report."""
        now_step = (self._device_ns() - self._step_zero_ns) // self._step_ns
        while (step := self.devices.next_report_step()) <= now_step:
            self.devices.advance_to(step)
        if not whole_reports:
            self.devices.advance_to(now_step)

    def _watch(self) -> None:
        if self.devices.armed and self._host_ns() - self._last_valid_ns >= self._watchdog_ns:
            self._catch_up(whole_reports=False)
            self.devices.watchdog_expires()
