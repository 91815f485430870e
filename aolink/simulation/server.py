"""The simulated rig as a process: two lines (camera, mirror) on pseudo terminals or TCP ports.

In real time the plant runs with the clock. On virtual time it runs to the end of the last queued
command block and waits there; every line is told the host's time with `VirtualTime` packets, so
commands drive time, and the same seed gives the same bytes however fast the host is.
"""

from __future__ import annotations

import math
import selectors
import time
from collections.abc import Callable

import numpy as np
from google.protobuf.message import DecodeError, Message

from aolink.rig import Faults, Rig
from aolink.simulation.devices import Line, Outgoing, SimulatedDevices
from aolink.simulation.streams import Stream
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
"""Between a clock query and its reply."""
_IDLE_S = 0.5
"""Longest sleep in real time: the plant is never further behind than this."""
_UNREAD_LIMIT = 16 << 20
"""Bytes that wait for a host that does not read; in real time, what is beyond it is dropped."""


class FaultInjector:
    """Damages packets by rate and by seed."""

    def __init__(self, faults: Faults, seed: np.random.SeedSequence) -> None:
        self._faults = faults
        # One for each direction: how packets in and packets out take turns is a matter of speed.
        self._incoming, self._outgoing = (np.random.default_rng(each) for each in seed.spawn(2))

    def loses_command(self, n_bytes: int) -> bool:
        """Whether a packet of ``n_bytes`` from the host is lost, or so damaged that its checksum is wrong."""
        damaged = 1 - (1 - self._faults.bit_error_rate) ** (8 * n_bytes)
        return _hits(self._incoming, self._faults.command_loss_rate) or _hits(self._incoming, damaged)

    def damage(self, packet: bytes) -> bytes:
        """The bytes that are sent for a packet to the host: none, the packet twice, with bits flipped, or as it is."""
        if _hits(self._outgoing, self._faults.packet_loss_rate):
            return b""
        bits = 8 * (len(packet) - 1)  # not those of the delimiter
        flips = 1 if _hits(self._outgoing, self._faults.bit_flip_rate) else 0
        if self._faults.bit_error_rate:
            flips += int(self._outgoing.binomial(bits, self._faults.bit_error_rate))
        if flips:
            damaged = bytearray(packet)
            for bit in self._outgoing.integers(bits, size=flips):
                damaged[bit // 8] ^= 1 << bit % 8
            packet = bytes(damaged)
        if _hits(self._outgoing, self._faults.duplicate_rate):
            packet *= 2
        return packet


class LineEnd:
    """The device's end of one line: bytes in and out, packets, counts."""

    def __init__(self, line: Line, stream: Stream, faults: FaultInjector) -> None:
        self.line, self.stream = line, stream
        self.taken = 0
        """Packets of this session that have been dealt with, lost and damaged ones included."""
        self.unsent = bytearray()
        self._faults = faults
        self._decoder = PacketDecoder()
        self._messages = MessageDecoder()
        self._sequence = 0

    def receive(self) -> list[tuple[Message | None, int]]:
        """(message, sequence) of every packet that came; the message is None for a lost, damaged or partial one."""
        received: list[tuple[Message | None, int]] = []
        # Piece by piece, so that every packet, damaged or not, is counted in its place.
        for piece in _pieces(self.stream.read()):
            before = self._decoder.seen
            packets = self._decoder.feed(piece)
            for packet in packets:
                # Who is there is asked in real time, so again on a slow machine: faults begin after it.
                lost = packet.type != PacketType.IDENTIFY and self._faults.loses_command(len(piece))
                received.append((None if lost else self._parse(packet), packet.sequence))
            received.extend([(None, 0)] * (self._decoder.seen - before - len(packets)))
        return received

    def begin_session(self) -> None:
        """On Identify: what was not sent yet is for a host that is gone."""
        self.unsent.clear()
        self._sequence, self.taken = 0, 0

    def put(self, message: Message) -> None:
        """Queue a message for sending; `VirtualTime` is a side channel and is never damaged."""
        for packet in encode_packets(message, self._sequence):
            self._sequence = (self._sequence + 1) & 0xFFFF
            if isinstance(message, pb.VirtualTime):
                self.unsent += DELIMITER + packet  # ends whatever damage is before it
            elif isinstance(message, pb.Identity):
                self.unsent += packet
            else:
                self.unsent += self._faults.damage(packet)

    def _parse(self, packet: Packet) -> Message | None:
        if packet.version != PROTOCOL_VERSION:
            return None
        try:
            return self._messages.take(packet)
        except DecodeError:
            return None

    def flush(self) -> None:
        """Send what the port takes now."""
        while self.unsent:
            sent = self.stream.write(bytes(self.unsent[:65_536]))
            if not sent:
                return
            del self.unsent[:sent]


class RigServer:
    """Runs the simulated devices behind two lines until told to stop."""

    def __init__(
        self,
        rig: Rig,
        streams: dict[Line, Stream],
        *,
        seed: int | None = None,
        real_time: bool = False,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        simulation = rig.simulation
        seeds = np.random.SeedSequence(simulation.seed if seed is None else seed).spawn(8)[5:]
        self._lines: dict[Line, LineEnd] = {
            line: LineEnd(line, stream, FaultInjector(simulation.faults, seeds[i]))
            for i, (line, stream) in enumerate(streams.items())
        }
        self._latency_rng = np.random.default_rng(seeds[2])
        self._real_time, self._clock_ns = real_time, clock_ns
        self._latency_ns = round(simulation.latency_s * 1e9)
        self._clock_rate = 1 + simulation.clock_drift_ppm * 1e-6
        self._start_ns = clock_ns() if real_time else VIRTUAL_EPOCH_NS
        self._step_zero_ns = self._start_ns + round(simulation.clock_offset_s * 1e9)
        self._now_ns = self._start_ns  # virtual time
        self._last_valid_ns = self._start_ns
        self._told: dict[Line, int] = {}
        self._watchdog_ns = round(rig.mirror.watchdog_s * 1e9)
        self._step_ns = rig.timing.fast_step_ns
        self.devices = SimulatedDevices(rig, seed, virtual_time=not real_time, step_zero_ns=self._step_zero_ns)

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve until ``stop()``; it is asked at least twice a second."""
        while not stop():
            self._wait()
            self.serve()

    def serve(self) -> None:
        """Handle the packets that have come, and all that is due."""
        if self._real_time:
            self._catch_up(whole_reports=True)
        for line in self._lines.values():
            for message, sequence in line.receive():
                self._deal_with(line, message, sequence)
        if self._real_time:
            self._watch()
            self._post(self.devices.outbox)
        for line in self._lines.values():
            line.flush()

    def idle_s(self) -> float:
        """How long there is nothing to do if nothing comes, s; at most half a second."""
        if not self._real_time:
            return _IDLE_S
        due_ns = self.devices.device_ns(self.devices.next_report_step()) - self._device_ns()
        if self.devices.armed:
            due_ns = min(due_ns, self._last_valid_ns + self._watchdog_ns - self._host_ns())
        return min(max(due_ns / 1e9, 0.0), _IDLE_S)

    def _wait(self) -> None:
        timeout = self.idle_s()
        with selectors.DefaultSelector() as selector:
            for line in self._lines.values():
                events = selectors.EVENT_READ | (selectors.EVENT_WRITE if line.unsent else 0)
                selector.register(line.stream.fileno(), events)
            selector.select(timeout)

    def _host_ns(self) -> int:
        return self._clock_ns() if self._real_time else self._now_ns

    def _device_ns(self) -> int:
        return self._step_zero_ns + math.floor((self._host_ns() - self._start_ns) * self._clock_rate)

    def _deal_with(self, line: LineEnd, message: Message | None, sequence: int) -> None:
        if isinstance(message, pb.Identify):
            line.begin_session()
            self._told.pop(line.line, None)
        if message is not None:
            if line.line == "mirror":  # the camera's line may be alive while the mirror's is dead
                self._last_valid_ns = self._host_ns()
            if isinstance(message, pb.ClockQuery):
                self._answer_clock(line, message)
            else:
                if self._real_time:  # what is late is judged by the clock, not by the last report
                    self._catch_up(whole_reports=False)
                self.devices.handle(line.line, message, sequence)
        if not self._real_time:
            self._post(self.devices.outbox)
            self.devices.advance_to(self.devices.ready_end)
            self._post(self.devices.outbox)
        line.taken += 1
        if not self._real_time:
            for each in self._lines.values():
                self._tell_time(each, done=True)

    def _answer_clock(self, line: LineEnd, query: pb.ClockQuery) -> None:
        if not self._real_time:
            self._now_ns = max(self._now_ns, query.host_send_ns) + self._draw_latency()
        received = self._device_ns()
        if not self._real_time:
            self._now_ns += _TURNAROUND_NS
        sent = self._device_ns()
        if not self._real_time:
            self._now_ns += self._draw_latency()
            self._tell_time(line)
        line.put(
            pb.ClockReply(
                query_id=query.query_id,
                host_send_ns=query.host_send_ns,
                device_receive_ns=received,
                device_send_ns=sent,
            )
        )

    def _draw_latency(self) -> int:
        """One way: never under 80 % of the median, with a tail."""
        return round(self._latency_ns * (0.8 + 0.29 * float(self._latency_rng.standard_exponential())))

    def _post(self, outbox: list[Outgoing]) -> None:
        for out in outbox:
            line = self._lines[out.line]
            if not self._real_time:
                left = self._now_ns
                if out.after_step is not None:
                    elapsed = (out.after_step + 1) * self._step_ns
                    left = max(left, self._start_ns + math.ceil(elapsed / self._clock_rate))
                self._now_ns = max(self._now_ns, left + self._latency_ns)
                self._tell_time(line)
            elif len(line.unsent) > _UNREAD_LIMIT:
                continue
            line.put(out.message)
        outbox.clear()

    def _tell_time(self, line: LineEnd, *, done: bool = False) -> None:
        """Hand the clock down if it moved, or if a packet has been dealt with."""
        if done or self._told.get(line.line) != self._now_ns:
            self._told[line.line] = self._now_ns
            taken = {name: end.taken for name, end in self._lines.items()}
            line.put(
                pb.VirtualTime(host_ns=self._now_ns, camera_packets=taken["camera"], mirror_packets=taken["mirror"])
            )

    def _catch_up(self, *, whole_reports: bool) -> None:
        """Real time: let the plant run to now; with ``whole_reports``, only to the end of a report."""
        now_step = (self._device_ns() - self._step_zero_ns) // self._step_ns
        while (step := self.devices.next_report_step()) <= now_step:
            self.devices.advance_to(step)
        if not whole_reports:
            self.devices.advance_to(now_step)

    def _watch(self) -> None:
        if self.devices.armed and self._host_ns() - self._last_valid_ns >= self._watchdog_ns:
            self._catch_up(whole_reports=False)
            self.devices.watchdog_expires()


def _hits(rng: np.random.Generator, rate: float) -> bool:
    return rate > 0 and float(rng.random()) < rate


def _pieces(data: bytes) -> list[bytes]:
    """Cut after every delimiter."""
    *whole, rest = data.split(DELIMITER)
    return [piece + DELIMITER for piece in whole] + ([rest] if rest else [])
