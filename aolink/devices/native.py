"""Camera and mirror that speak aolink's own packet protocol."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
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
from aolink.devices.retransmission import Retransmission
from aolink.errors import DeviceError, PortError
from aolink.timeouts import TIMEOUTS
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import Hub
from aolink.wire.link import Link, Received

_MAX_QUERIES = 32


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
        self.clock.suspect(MOST_RATE_ERROR * (TIMEOUTS.answer_s + returned.away_s) * 1e9, now_ns)  # until a query
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
        self, message: pb.CameraControl | pb.Park | pb.Rearm, what: str, answer_s: float = TIMEOUTS.answer_s,
        tries: int = TIMEOUTS.tries,
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
        answer_s, tries = TIMEOUTS.camera_start_answer_s, TIMEOUTS.camera_start_tries
        return self._request(message, "start", answer_s, tries, (pb.OK, pb.TOO_LATE)).code == pb.OK

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


class NativeMirror(_NativeDevice):
    """A mirror driver on the packet protocol.

    Blocks are acknowledged, and sent again on time-out as often as the time before their first step allows. Reports
    that do not come are requested again.
    """

    commanded = True

    def __init__(self, hub: Hub, link: Link, identity: pb.Identity, gate: Gate) -> None:
        super().__init__(hub, link, identity, gate)
        limits = identity.mirror
        self.queue_end_step = 0
        self.latched = limits.latched
        self.outage_s = 0.0
        self._watchdog_s = limits.watchdog_s
        self._block_ids = count(1)
        self.flights = Retransmission(limits.watchdog_s, limits.queue_steps, identity.fast_step_ns)
        self._answered_ns: int | None = None
        """The time at which the newest of the blocks that the mirror has accepted was sent."""
        self._reports = AppliedReports(identity.fast_step_ns, round(self._watchdog_s * 1e9))

    def statistics(self) -> dict[str, Any]:
        return super().statistics() | {
            "retransmits": self.flights.count,
            "reports_asked": self._reports.asked,
            "commands_in_flight": self.in_flight,
            "round_trip_s": self.flights.round_trip_s,
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
        return len(self.flights.open())

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        u = self._gate.limits.take(first_step, u)
        block = pb.CommandBlock(
            block_id=next(self._block_ids), first_step=first_step, n_steps=len(u), u=u.ravel(),
            cause_frame_id=cause_frame_id,
        )  # fmt: skip
        self._gate.sent(block)
        self._reports.begin(first_step)
        ends_ns = self._begins_ns(first_step + len(u))
        flight = self.flights.add(block, self._begins_ns(first_step), ends_ns, now_ns)
        flight.sent(self.link.send(block), now_ns)
        return block

    def withdraw(self, step: int) -> int:
        return self.flights.withdraw(step)

    def go_on_from(self, first_step: int, step: int) -> NDArray[np.float64]:
        return self._gate.limits.go_on_from(first_step, step)

    def _begins_ns(self, step: int) -> float:
        """Host time at which a fast step begins; infinite on virtual time, where the rig waits for its commands."""
        if self._hub.virtual or not self.clock.ready:
            return math.inf
        return self.clock.host_ns(self.steps.step_zero_ns + step * self.identity.fast_step_ns)[0]

    def next_due_ns(self) -> int | None:
        due_ns = (self.flights.next_due_ns(), self._reports.next_due_ns(self.flights.timeout_ns))
        return min((each for each in due_ns if each is not None), default=None)

    def serve(self, now_ns: int) -> list[Event]:
        for flight in self.flights.due(now_ns):
            if self.flights.is_hopeless(flight, now_ns):
                gone = (
                    f"the mirror has not acknowledged a command for {(now_ns - flight.heard_ns) / 1e9:.1f} s, more than"
                    f" twice its watchdog, though it was sent {len(flight.tries)} times: is it still connected?"
                    " (a mirror that hears nothing parks itself)"
                )
                if self.link.reopen is None:
                    raise DeviceError(gone)
                self.link.lose(PortError(gone))
                return []
            if self.flights.may_send(flight, now_ns, busy=self.link.transport.unsent() > 0):
                flight.sent(self.link.send(flight.block), now_ns)
        queries, given_up = self._reports.ask(now_ns, self.flights.timeout_ns)
        for query in queries:
            self.link.send(query)
        return list(given_up)

    def await_reports(self, end_step: int, now_ns: int) -> list[Event]:
        return list(self._reports.expect_until(end_step, now_ns))

    def park(self) -> int:
        self.withdraw(0)  # a block that came again afterwards would move the mirror
        answer_s = max(self.flights.timeout_ns / 1e9, TIMEOUTS.park_answer_s)
        silent_s = min(TIMEOUTS.mirror_watchdogs * self._watchdog_s, TIMEOUTS.park_silent_s)
        return self._request(pb.Park(), "park", answer_s, insist_s=silent_s).step

    def last_answers(self) -> list[CommandAnswered]:
        self.withdraw(0)
        return self.flights.take_given_up(ended=True)

    def rearm(self) -> int:
        self.withdraw(0)  # after re-arming, the session sends the steps that are still to come anew
        step = self._request(pb.Rearm(), "end the latch of its watchdog", self._answer_s()).step
        self._gate.limits.parked()
        self.latched = False
        return step

    def _answer_s(self) -> float:
        """How long to wait for an answer, s: all tries together take the watchdog's time, after which the mirror parks
        by itself."""
        return min(TIMEOUTS.answer_s, max(self._watchdog_s / TIMEOUTS.tries, self.flights.timeout_ns / 1e9))

    def _begin_anew(self, now_ns: int) -> None:
        self.withdraw(0)
        self._gate.limits.parked()
        self._reports.ask_anew(now_ns)
        self.latched, self.outage_s, self._answered_ns = self.identity.mirror.latched, 0.0, None

    def _take(self, message: Message, receive_ns: int) -> list[Event]:
        events: list[Event] = [*self.flights.take_given_up()]
        if isinstance(message, pb.CommandAck):
            events += self._take_ack(message, receive_ns)
        elif isinstance(message, pb.Applied):
            events += self._reports.take(message, receive_ns)
        elif isinstance(message, pb.ClockReply):
            # While a block is sent again the line is busy in one direction, so such a sample is useless.
            clean = all(len(flight.tries) == 1 for flight in self.flights.open())
            events += self._sample_clock(message, receive_ns, usable=clean)
        return events

    def _take_ack(self, ack: pb.CommandAck, receive_ns: int) -> list[Event]:
        if (flight := self.flights.answer(ack, receive_ns)) is None:
            return []
        self.queue_end_step = ack.queue_end_step
        if ack.code == pb.LATCHED:
            # A block that was withdrawn was sent before the mirror was re-armed or parked, or another says the same.
            if not flight.withdrawn:
                self.latched = True
                self.outage_s = 0.0 if self._answered_ns is None else (receive_ns - self._answered_ns) / 1e9
        else:
            self._answered_ns = max(self._answered_ns or 0, flight.last_ns)
        ack.text = printable(ack.text)
        return [flight.answered(ack)]


def _reason(ack: pb.Ack | pb.CommandAck) -> str:
    known = pb.Code.Name(ack.code) if ack.code in pb.Code.values() else f"code {ack.code}"
    return printable(ack.text) or known
