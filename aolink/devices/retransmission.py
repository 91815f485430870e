"""The command blocks that a mirror has not answered yet: when each is sent again, and when that is of no use any more.
Nothing here sends or knows a clock."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from aolink.devices.gate import lie
from aolink.devices.interfaces import CommandAnswered
from aolink.timeouts import TIMEOUTS
from aolink.wire import messages_pb2 as pb

_MOST_WITHDRAWN = 64


@dataclass(slots=True)
class Flight:
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
            return since_ns + TIMEOUTS.late_tries * timeout_ns
        due_ns = since_ns + timeout_ns
        return int(self.latest_ns) if since_ns < self.latest_ns < due_ns else due_ns

    def sent(self, sequence: int, now_ns: int) -> None:
        """Note a try, with the sequence number of its packet."""
        self.last_ns = self.tries[sequence] = now_ns

    def answered(self, ack: pb.CommandAck | None = None) -> CommandAnswered:
        """The event that ends it; without an answer where none is waited for any more."""
        return CommandAnswered(ack, self.block, self.first_ns, len(self.tries), self.times_full)


class Retransmission:
    """The blocks in flight to a mirror, and the round trip of a block and its answer.

    Parameters
    ----------
    watchdog_s:
        The mirror's watchdog.
    queue_steps, fast_step_ns:
        Length of its queue, and of a step in it.
    """

    def __init__(self, watchdog_s: float, queue_steps: int, fast_step_ns: int) -> None:
        self.count = 0
        """Tries beyond the first of each block."""
        # Smoothed round trip and its mean deviation, as TCP has them (RFC 6298).
        self.round_trip_s = self._deviation_s = math.nan
        self._flights: dict[int, Flight] = {}
        self._given_up: list[CommandAnswered] = []
        """Blocks whose answers are not waited for any more, until that is an event."""
        self._patience_s, self._queue_steps = TIMEOUTS.mirror_watchdogs * watchdog_s, queue_steps
        self._full_s = queue_steps * fast_step_ns / 1e9 + self._patience_s
        """A queue that stays full for longer will stay full forever."""

    @property
    def timeout_ns(self) -> int:
        """Time between two tries."""
        timeout = self.round_trip_s + 4 * self._deviation_s
        timeout = TIMEOUTS.first_try_s if math.isnan(timeout) else timeout
        return round(min(max(timeout, TIMEOUTS.least_try_s), TIMEOUTS.most_try_s) * 1e9)

    def open(self) -> list[Flight]:
        """The blocks that are sent again until they are answered."""
        return [flight for flight in self._flights.values() if not flight.withdrawn]

    def add(self, block: pb.CommandBlock, begins_ns: float, ends_ns: float, now_ns: int) -> Flight:
        """A block that is sent now, with the host's times at which its steps begin and end."""
        flight = Flight(block, begins_ns - self.timeout_ns / 2, ends_ns, now_ns, now_ns)
        self._flights[block.block_id] = flight
        return flight

    def next_due_ns(self) -> int | None:
        """The time of the next try of any block; None where all are answered."""
        timeout_ns = self.timeout_ns
        return min((flight.due_ns(timeout_ns) for flight in self.open()), default=None)

    def due(self, now_ns: int) -> list[Flight]:
        """The blocks whose time-out has come."""
        timeout_ns = self.timeout_ns
        return [flight for flight in self.open() if flight.due_ns(timeout_ns) <= now_ns]

    def is_hopeless(self, flight: Flight, now_ns: int) -> bool:
        """Whether the mirror has not answered a block for so long that it must be gone."""
        silent_s = (now_ns - flight.heard_ns) / 1e9
        return silent_s > self._patience_s and flight.timeouts >= TIMEOUTS.least_tries

    def may_send(self, flight: Flight, now_ns: int, *, busy: bool) -> bool:
        """Whether to send a block that is due. Not on a slow line, where the previous try has not even left, or its
        answer is not due yet; and a line that is too busy would become busier with each try."""
        flight.timeouts += 1
        if busy or (now_ns - flight.last_ns) / 1e9 < self.round_trip_s:
            flight.put_off_ns = now_ns
            return False
        self.count += 1
        return True

    def withdraw(self, step: int) -> int:
        """Send no block again that has steps from ``step`` on; gives the first step from which on inputs must be sent
        anew."""
        replaced = [each for each in self.open() if each.block.first_step + each.block.n_steps > step]
        for flight in replaced:
            flight.withdrawn = True
        for flight in [each for each in self._flights.values() if each.withdrawn][:-_MOST_WITHDRAWN]:
            self._given_up.append(self._flights.pop(flight.block.block_id).answered())  # their answers were lost
        return min([step, *(flight.block.first_step for flight in replaced)])

    def answer(self, ack: pb.CommandAck, receive_ns: int) -> Flight | None:
        """The block that an answer ends, with the time of the try that it answers as its last one; None for an answer
        that ends none. Raises DeviceError for a queue that is full for too long."""
        if (flight := self._flights.get(ack.block_id)) is None:
            return None
        sent_ns = flight.tries.get(ack.sequence)
        if sent_ns is not None:
            self._measure(max(0, receive_ns - sent_ns) / 1e9)
        if ack.code != pb.QUEUE_FULL:
            flight.last_ns = flight.last_ns if sent_ns is None else sent_ns
            return self._flights.pop(ack.block_id)
        # This answer is not final: the block is sent again when its time-out comes.
        flight.heard_ns = receive_ns
        flight.times_full += 1
        if (full_s := (receive_ns - flight.first_ns) / 1e9) > self._full_s:
            expected = f"room in a queue of {self._queue_steps} steps by then"
            raise lie("mirror", "CommandAck.code", f"QUEUE_FULL for {full_s:.1f} s", expected)
        return None

    def take_given_up(self, *, ended: bool = False) -> list[CommandAnswered]:
        """The blocks whose answers are not waited for any more, each once; with ``ended``, all that are left."""
        given_up, self._given_up = self._given_up, []
        if ended:
            given_up += [flight.answered() for flight in self._flights.values()]
            self._flights = {}
        return given_up

    def _measure(self, round_trip_s: float) -> None:
        if math.isnan(self.round_trip_s):
            self.round_trip_s, self._deviation_s = round_trip_s, round_trip_s / 2
        else:
            self._deviation_s += (abs(round_trip_s - self.round_trip_s) - self._deviation_s) / 4
            self.round_trip_s += (round_trip_s - self.round_trip_s) / 8
