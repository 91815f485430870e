"""Camera and mirror that speak aolink's own packet protocol."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import count
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from aolink.assembly import Frame, PlanesReassembly, TruthReassembly
from aolink.devices.clock import ClockExchange, ClockRegression, StepClock
from aolink.devices.frame_count import FrameCount
from aolink.devices.gate import MOST_RATE_ERROR, Gate, lie, printable
from aolink.devices.interfaces import ClockSampled, CommandAnswered, Event, Lacks
from aolink.devices.port_watch import PortWatch
from aolink.devices.reports import AppliedReports
from aolink.errors import DeviceError, PortError
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import ANSWER_S, TRIES, Hub
from aolink.wire.link import Link, Received

_FIRST_TIMEOUT_S = 0.1
_MIN_TIMEOUT_S = 0.01
"""Least time between two tries of a block: a Python host is held up for some ms now and then."""
_MAX_TIMEOUT_S = 0.5
_LATE_TIMEOUTS = 4
"""A late block is sent again at every fourth time-out only: just its answer is still needed, to account for its
steps."""
_PATIENCE_WATCHDOGS = 2.0
"""A mirror that answers nothing for this many times its watchdog has parked itself, and the session ends."""
_LEAST_TRIES = 5
"""Least tries before a mirror is given up: a host that was held up has not read the answers yet."""
_PARK_ANSWER_S = 0.05
_PARK_SILENT_S = 5.0
"""A mirror of which nothing is heard for this long, or for twice its watchdog, is not asked to park any more."""
_START_ANSWER_S = 0.05
"""Wait for the answer to a camera's start, which is at a near step: the next try must not be late."""
_START_TRIES = 60
_MAX_QUERIES = 32
_MOST_WITHDRAWN = 64


class _NativeDevice:
    """The common part of the native camera and mirror: identity, clock, simple requests."""

    def __init__(self, hub: Hub, link: Link, identity: pb.Identity, gate: Gate) -> None:
        self.link, self.identity = link, identity
        self.lacks: tuple[Lacks, ...] = ()
        self.name = link.name
        self.description = f"{identity.model} {identity.serial_number} ({identity.firmware})"
        self.port = PortWatch(link, identity)
        self._gate = gate
        self.clock = ClockRegression()
        self.steps = StepClock(self.clock, identity.step_zero_ns, identity.fast_step_ns)
        self._hub = hub
        self._query_ids = count(1)
        self._queries: dict[int, int] = {}

    def since_zero_ns(self, host_ns: int) -> int:
        """Time from the beginning of the device's fast step 0 to a host time, on its own clock, ns."""
        return self.clock.device_ns(host_ns)[0] - self.steps.step_zero_ns

    def host_ns(self, device_ns: int, since_zero_ns: int, now_ns: int) -> tuple[int, float]:
        return self.steps.host_ns(device_ns, since_zero_ns, now_ns)

    def statistics(self) -> dict[str, Any]:
        counts = asdict(self.link.counts)
        return {name.replace("packets", "messages"): number for name, number in counts.items()}

    def query_clock(self, now_ns: int) -> None:
        query_id = next(self._query_ids)
        self._queries[query_id] = now_ns
        while len(self._queries) > _MAX_QUERIES:  # queries whose answers never came
            del self._queries[next(iter(self._queries))]
        self.link.send(pb.ClockQuery(query_id=query_id, host_send_ns=now_ns))

    def watch_port(self, now_ns: int) -> list[Event]:
        """Open the port again where it has vanished, and ask the device for its identity. Raises PortError once that
        took too long."""
        events = self.port.poll(now_ns)
        return [*self.flush(), *events] if events else []

    def flush(self) -> list[Frame]:
        """The frames that are still incomplete, as they are."""
        return []

    def _come_back(self, message: Message, now_ns: int) -> list[Event]:
        """Go on with the device that answers on a port that was gone. Raises DeviceError for another one."""
        if not isinstance(message, pb.Identity):  # from before the port vanished
            return []
        now_step = self.since_zero_ns(now_ns) // self.identity.fast_step_ns if self.clock.ready else 0
        returned = self.port.take(message, now_step, now_ns)
        if returned is None:
            return []
        self.identity = message
        self._queries.clear()
        self.steps = StepClock(self.clock, message.step_zero_ns, message.fast_step_ns)
        self.clock.suspect(MOST_RATE_ERROR * (ANSWER_S + returned.away_s) * 1e9, now_ns)  # until a query
        self._begin_anew(now_ns)
        return [returned]

    def _begin_anew(self, now_ns: int) -> None:
        """Begin anew, because the device has forgotten the packets that it was sent."""

    def _sample_clock(self, reply: pb.ClockReply, receive_ns: int, *, usable: bool = True) -> list[Event]:
        sent_ns = self._queries.pop(reply.query_id, None)
        if sent_ns is None or sent_ns != reply.host_send_ns:
            return []
        exchange = ClockExchange(sent_ns, reply.device_receive_ns, reply.device_send_ns, receive_ns)
        return [ClockSampled.add(self.clock, exchange, usable=usable)]

    def handle(self, received: Received) -> list[Event]:
        """The events that follow from a message."""
        message, receive_ns = received.message, received.receive_ns
        if self.port.away:
            return self._come_back(message, receive_ns)
        if not self._gate.passes(self.link, message, receive_ns):
            return []
        if isinstance(message, pb.Event):
            message.text = printable(message.text)
            return [message]
        return self._take(message, receive_ns)

    def _take(self, message: Message, receive_ns: int) -> list[Event]:
        """The events that follow from a message of this kind of device."""
        raise NotImplementedError

    def _request(
        self, message: pb.CameraControl | pb.Park | pb.Rearm, what: str, answer_s: float = ANSWER_S, tries: int = TRIES,
        codes: Sequence[int] = (pb.OK,), *, insist_s: float = 0.0,
    ) -> pb.Ack:  # fmt: skip
        """Send a request until it is answered; gives the answer. Raises DeviceError if its code is not among
        ``codes``."""
        ack = self._hub.request(
            self.link, message, pb.Ack, lambda ack, sequence: ack.sequence == sequence, answer_s, tries,
            insist_s=insist_s,
        )  # fmt: skip
        if ack is None:
            raise DeviceError(f"the {self.link.name} did not answer when asked to {what}: is it still connected?")
        self._gate.passes(self.link, ack, self._hub.now_ns())
        if ack.code not in codes:
            raise DeviceError(f"the {self.link.name} refused to {what}: {_reason(ack)}")
        return ack


class NativeCamera(_NativeDevice):
    """A camera on the packet protocol."""

    def __init__(self, hub: Hub, link: Link, identity: pb.Identity, gate: Gate) -> None:
        super().__init__(hub, link, identity, gate)
        self.rig_digest = identity.rig_digest
        geometry = identity.camera
        shapes = [(geometry.height, geometry.width)]
        if geometry.scene_width:
            shapes.append((geometry.scene_height, geometry.scene_width))
        self._frames = PlanesReassembly(shapes, identity.fast_step_ns)
        self._count = FrameCount(geometry.frame_period_steps)
        self._truths = TruthReassembly()

    def start(self, first_step: int, exposures: int) -> bool:
        message = pb.CameraControl(run=True, first_step=first_step, exposures=exposures)
        return self._request(message, "start", _START_ANSWER_S, _START_TRIES, (pb.OK, pb.TOO_LATE)).code == pb.OK

    def stop(self) -> None:
        self._request(pb.CameraControl(run=False), "stop")

    def flush(self) -> list[Frame]:
        return self._frames.flush()

    @property
    def chunks_refused(self) -> int:
        return self._frames.refused

    def handle(self, received: Received) -> list[Event]:
        message, what = received.message, ""
        if isinstance(message, pb.FrameChunk):
            message.frame_id, what = self._count.take(message.frame_id, message.first_step)
        elif isinstance(message, pb.TruthChunk):
            message.frame_id = self._count.of_newest(message.frame_id)
        events = super().handle(received)
        return [pb.Event(level=pb.Event.WARNING, text=f"{what}: frames are counted on"), *events] if what else events

    def _take(self, message: Message, receive_ns: int) -> list[Event]:
        if isinstance(message, pb.FrameChunk):
            frames = self._frames.add(message, receive_ns)
            for frame in frames:
                self._gate.check_frame(self.link.name, frame)
            return list(frames)
        if isinstance(message, pb.TruthChunk):
            try:
                truth = self._truths.add(message)
            except DecodeError:
                raise lie(self.link.name, "TruthChunk.data", "bytes that are no Truth", "a serialised Truth") from None
            if truth is None:
                return []
            truth.frame_id = self._count.of_newest(truth.frame_id)
            self._gate.check_truth(self.link.name, truth, message.frame_id)
            return [truth]
        return self._sample_clock(message, receive_ns) if isinstance(message, pb.ClockReply) else []


@dataclass(slots=True)
class _Flight:
    """A block that was sent and is not answered yet. All times are the host's."""

    block: pb.CommandBlock
    latest_ns: float
    """A try that is sent later than this may not arrive before the block's first step."""
    over_ns: float
    """End of the block's last step, after which no try can help."""
    heard_ns: int
    """The time of the mirror's last answer for the block; before any answer, the time at which it was first sent."""
    first_ns: int
    """The time at which it was first sent."""
    last_ns: int = 0
    """Time of the last try."""
    put_off_ns: int = 0
    """The time at which a try was due and was not sent, because the one before it could still be answered."""
    withdrawn: bool = False
    """Whether it is not sent again, though it may still be answered."""
    timeouts: int = 0
    times_full: int = 0
    tries: dict[int, int] = field(default_factory=dict)
    """The time at which each try was sent, by the sequence number of its packet."""

    def due_ns(self, timeout_ns: int) -> int:
        """The time of the next try: at every time-out; once more just before the first step; seldom once the block is
        over."""
        since_ns = max(self.last_ns, self.put_off_ns)
        if self.last_ns >= self.over_ns:
            return since_ns + _LATE_TIMEOUTS * timeout_ns
        due_ns = since_ns + timeout_ns
        return int(self.latest_ns) if since_ns < self.latest_ns < due_ns else due_ns

    def answered(self, ack: pb.CommandAck | None = None) -> CommandAnswered:
        """The event that ends it; without an answer where none is waited for any more."""
        return CommandAnswered(ack, self.block, self.first_ns, len(self.tries), self.times_full)


class NativeMirror(_NativeDevice):
    """A mirror driver on the packet protocol.

    Blocks are acknowledged, and sent again on time-out as often as the time before their first step allows. Reports
    that do not come are requested again.
    """

    commanded = True

    def __init__(self, hub: Hub, link: Link, identity: pb.Identity, gate: Gate) -> None:
        super().__init__(hub, link, identity, gate)
        self.retransmits = 0
        self.queue_end_step = 0
        self.latched = identity.mirror.latched
        self.outage_s = 0.0
        self._watchdog_s = identity.mirror.watchdog_s
        queue_s = identity.mirror.queue_steps * identity.fast_step_ns / 1e9
        self._full_s = queue_s + _PATIENCE_WATCHDOGS * self._watchdog_s
        """A queue that stays full for longer will stay full forever."""
        self._block_ids = count(1)
        self._flights: dict[int, _Flight] = {}
        self._given_up: list[CommandAnswered] = []
        """Blocks whose answers are not waited for any more, until that is an event."""
        self._answered_ns: int | None = None
        """The time at which the newest of the blocks that the mirror has accepted was sent."""
        self._reports = AppliedReports(identity.fast_step_ns, round(self._watchdog_s * 1e9))
        # Smoothed round trip and its mean deviation, as TCP has them (RFC 6298).
        self.round_trip_s = math.nan
        self._deviation_s = math.nan

    def statistics(self) -> dict[str, Any]:
        return super().statistics() | {
            "retransmits": self.retransmits,
            "reports_asked": self._reports.asked,
            "commands_in_flight": self.in_flight,
            "round_trip_s": self.round_trip_s,
            "queue_end_step": self.queue_end_step,
        }

    @property
    def last_sent_ns(self) -> int:
        return self.link.last_sent_ns

    def step_sigma_ns(self, host_ns: int) -> float:
        return self.clock.device_ns(host_ns)[1]

    def start_step(self, now_ns: int) -> int:
        if self._hub.virtual:
            return self.identity.next_step
        step = self.since_zero_ns(now_ns) // self.identity.fast_step_ns
        self._gate.check_step(self.name, step, now_ns)
        return step

    @property
    def in_flight(self) -> int:
        return len(self._sent_again())

    def _sent_again(self) -> list[_Flight]:
        """The blocks that are sent again until they are answered."""
        return [flight for flight in self._flights.values() if not flight.withdrawn]

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        u = self._gate.limits.take(first_step, u)
        block = pb.CommandBlock(
            block_id=next(self._block_ids), first_step=first_step, n_steps=len(u), u=u.ravel(),
            cause_frame_id=cause_frame_id,
        )  # fmt: skip
        first_ns, over_ns = self._begins_ns(first_step), self._begins_ns(first_step + len(u))
        flight = _Flight(block, first_ns - self._timeout_ns() / 2, over_ns, now_ns, now_ns)
        self._gate.sent(block)
        self._flights[block.block_id] = flight
        self._reports.begin(first_step)
        self._send(flight, now_ns)
        return block

    def withdraw(self, step: int) -> int:
        replaced = [each for each in self._sent_again() if each.block.first_step + each.block.n_steps > step]
        for flight in replaced:
            flight.withdrawn = True
        for flight in [each for each in self._flights.values() if each.withdrawn][:-_MOST_WITHDRAWN]:
            self._given_up.append(self._flights.pop(flight.block.block_id).answered())  # their answers were lost
        return min([step, *(flight.block.first_step for flight in replaced)])

    def go_on_from(self, first_step: int, step: int) -> NDArray[np.float64]:
        return self._gate.limits.go_on_from(first_step, step)

    def _begins_ns(self, step: int) -> float:
        """Host time at which a fast step begins; infinite on virtual time, where the rig waits for its commands."""
        if self._hub.virtual or not self.clock.ready:
            return math.inf
        return self.clock.host_ns(self.steps.step_zero_ns + step * self.identity.fast_step_ns)[0]

    def _send(self, flight: _Flight, now_ns: int) -> None:
        flight.last_ns = now_ns
        flight.tries[self.link.send(flight.block)] = now_ns

    def next_due_ns(self) -> int | None:
        timeout_ns = self._timeout_ns()
        due_ns = [flight.due_ns(timeout_ns) for flight in self._sent_again()]
        if (report_ns := self._reports.next_due_ns(timeout_ns)) is not None:
            due_ns.append(report_ns)
        return min(due_ns, default=None)

    def serve(self, now_ns: int) -> list[Event]:
        timeout_ns = self._timeout_ns()
        for flight in self._sent_again():
            if flight.due_ns(timeout_ns) > now_ns:
                continue
            silent_s = (now_ns - flight.heard_ns) / 1e9
            if silent_s > _PATIENCE_WATCHDOGS * self._watchdog_s and flight.timeouts >= _LEAST_TRIES:
                gone = (
                    f"the mirror has not acknowledged a command for {silent_s:.1f} s, more than twice its watchdog,"
                    f" though it was sent {len(flight.tries)} times: is it still connected?"
                    " (a mirror that hears nothing parks itself)"
                )
                if self.link.reopen is None:
                    raise DeviceError(gone)
                self.link.lose(PortError(gone))
                return []
            flight.timeouts += 1
            # On a slow line the previous try has not even left, or its answer is not due yet; and a line that is too
            # busy would become busier with each try.
            if self.link.transport.unsent() or (now_ns - flight.last_ns) / 1e9 < self.round_trip_s:
                flight.put_off_ns = now_ns
                continue
            self.retransmits += 1
            self._send(flight, now_ns)
        queries, given_up = self._reports.ask(now_ns, timeout_ns)
        for query in queries:
            self.link.send(query)
        return list(given_up)

    def await_reports(self, end_step: int, now_ns: int) -> list[Event]:
        return list(self._reports.expect_until(end_step, now_ns))

    def park(self) -> int:
        self.withdraw(0)  # a block that came again afterwards would move the mirror
        answer_s = max(self._timeout_ns() / 1e9, _PARK_ANSWER_S)
        silent_s = min(_PATIENCE_WATCHDOGS * self._watchdog_s, _PARK_SILENT_S)
        return self._request(pb.Park(), "park", answer_s, insist_s=silent_s).step

    def last_answers(self) -> list[CommandAnswered]:
        self.withdraw(0)
        given_up = [*self._given_up, *(flight.answered() for flight in self._flights.values())]
        self._given_up, self._flights = [], {}
        return given_up

    def rearm(self) -> int:
        self.withdraw(0)  # after re-arming, the session sends the steps that are still to come anew
        step = self._request(pb.Rearm(), "end the latch of its watchdog", self._answer_s()).step
        self._gate.limits.parked()
        self.latched = False
        return step

    def _answer_s(self) -> float:
        """How long to wait for an answer, s: all tries together take the watchdog's time, after which the mirror parks
        by itself."""
        return min(ANSWER_S, max(self._watchdog_s / TRIES, self._timeout_ns() / 1e9))

    def _begin_anew(self, now_ns: int) -> None:
        self.withdraw(0)
        self._gate.limits.parked()
        self._reports.ask_anew(now_ns)
        self.latched, self.outage_s, self._answered_ns = self.identity.mirror.latched, 0.0, None

    def _take(self, message: Message, receive_ns: int) -> list[Event]:
        events: list[Event] = [*self._given_up]
        self._given_up = []
        if isinstance(message, pb.CommandAck):
            events += self._take_ack(message, receive_ns)
        elif isinstance(message, pb.Applied):
            events += self._reports.take(message, receive_ns)
        elif isinstance(message, pb.ClockReply):
            # While a block is sent again the line is busy in one direction, so such a sample is useless.
            clean = all(len(flight.tries) == 1 for flight in self._sent_again())
            events += self._sample_clock(message, receive_ns, usable=clean)
        return events

    def _take_ack(self, ack: pb.CommandAck, receive_ns: int) -> list[Event]:
        if (flight := self._flights.get(ack.block_id)) is None:
            return []
        sent_ns = flight.tries.get(ack.sequence)
        if sent_ns is not None:
            self._measure(max(0, receive_ns - sent_ns) / 1e9)
        if ack.code == pb.QUEUE_FULL:  # this answer is not final: the block is sent again when its time-out comes
            flight.heard_ns = receive_ns
            flight.times_full += 1
            if (full_s := (receive_ns - flight.first_ns) / 1e9) > self._full_s:
                expected = f"room in a queue of {self.identity.mirror.queue_steps} steps by then"
                raise lie(self.name, "CommandAck.code", f"QUEUE_FULL for {full_s:.1f} s", expected)
            return []
        del self._flights[ack.block_id]
        self.queue_end_step = ack.queue_end_step
        if ack.code == pb.LATCHED:
            # A block that was withdrawn was sent before the mirror was re-armed or parked, or another says the same.
            if not flight.withdrawn:
                self.latched = True
                self.outage_s = 0.0 if self._answered_ns is None else (receive_ns - self._answered_ns) / 1e9
        else:
            self._answered_ns = max(self._answered_ns or 0, flight.last_ns if sent_ns is None else sent_ns)
        ack.text = printable(ack.text)
        return [flight.answered(ack)]

    def _measure(self, round_trip_s: float) -> None:
        if math.isnan(self.round_trip_s):
            self.round_trip_s, self._deviation_s = round_trip_s, round_trip_s / 2
        else:
            self._deviation_s += (abs(round_trip_s - self.round_trip_s) - self._deviation_s) / 4
            self.round_trip_s += (round_trip_s - self.round_trip_s) / 8

    def _timeout_ns(self) -> int:
        timeout = self.round_trip_s + 4 * self._deviation_s
        if math.isnan(timeout):
            timeout = _FIRST_TIMEOUT_S
        return round(min(max(timeout, _MIN_TIMEOUT_S), _MAX_TIMEOUT_S) * 1e9)


def _reason(ack: pb.Ack | pb.CommandAck) -> str:
    known = pb.Code.Name(ack.code) if ack.code in pb.Code.values() else f"code {ack.code}"
    return printable(ack.text) or known
