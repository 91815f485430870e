"""Both serial lines of a rig as one stream of messages in order of the host's time.

In real time the hub waits on the ports. On virtual time it waits until the rig has handled everything that was sent and
has said so on every line; the messages that have come by then do not depend on the speed of either side, nor does
anything that follows from them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

from google.protobuf.message import Message

from aolink.errors import DeviceError
from aolink.polling import wait_readable
from aolink.timeouts import TIMEOUTS
from aolink.wire import messages_pb2 as pb
from aolink.wire.link import Link, Received
from aolink.wire.port import Served, Transport, is_local

_BUDGET_BYTES = 64 << 20
"""Most bytes that may come before the session takes them, besides the frames that the camera was asked for."""
_MESSAGE_BYTES = 512
"""Memory that a message takes beyond its own bytes."""
_MOST_HOST_NS = 1 << 62
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""A steady clock that goes on while the computer sleeps, as the devices' clocks do."""

AnyMessage = TypeVar("AnyMessage", bound=Message)


class Hub:
    """The host's clock and the links of one session.

    Once ``stop()`` gives True, no wait is longer than for one answer.
    """

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        self._stop = stop
        self._hurried = False
        self._patience_s = TIMEOUTS.answer_s
        """How long the rig on virtual time may take to handle a message once the session is to end, s."""
        self.links: list[Link] = []
        self.virtual = False
        self.beside: Sequence[Served] = ()
        """Served while the hub waits in real time."""
        self.virtual_since_ns = 0
        """Host time at which the rig began to set it."""
        self.elapsed_ns = 0
        """Virtual time that passed in time-outs, ns."""
        self.budget_bytes = _BUDGET_BYTES
        """Memory for messages that the session has not taken yet; a device that sends more ends the session."""
        self._epoch_ns = time.time_ns() - time.clock_gettime_ns(_CLOCK)
        self._virtual_ns = 0
        self.pending: list[tuple[Link, Received]] = []
        """Messages that the next `wait` gives first."""

    def now_ns(self) -> int:
        """Host time, ns since 1970: steady within a session; on virtual time the rig sets it."""
        return self._virtual_ns if self.virtual else self._epoch_ns + time.clock_gettime_ns(_CLOCK)

    def hurry(self) -> None:
        """Wait from now on as if a stop had been asked for: the session ends with an error."""
        self._hurried = True

    def connect(self, name: str, transport: Transport) -> Link:
        """Add a line."""
        link = Link(name, transport, self.now_ns)
        self.links.append(link)
        return link

    def go_virtual(self, check: Callable[[Link, pb.VirtualTime], None]) -> None:
        """Take the time from the rig from now on, as far as ``check`` allows, which raises DeviceError.

        Only a simulated rig on this machine may do that: otherwise a device on a serial line or on another machine
        could set the session's clock.
        """
        for link in self.links:
            if not is_local(link.transport):
                raise DeviceError(
                    f"the {link.name} says that it runs on virtual time, as only a simulated rig on this machine may"
                    " (a pseudo terminal, or a TCP port of 127.0.0.1): run it with --real-time, or through a tunnel"
                )
        self.virtual = True
        self.pending += self._receive_until_dealt_with()
        self.virtual_since_ns = self._virtual_ns = max(link.handed.host_ns for link in self.links if link.handed)
        if not 0 < self._virtual_ns < _MOST_HOST_NS:
            raise DeviceError(
                f"the rig says VirtualTime.host_ns = {self._virtual_ns}, expected ns since 1970 up to {_MOST_HOST_NS}"
            )
        for link in self.links:
            link.virtual = True
            link.check_virtual_time = partial(check, link)
            link.before_send = partial(self._settle_others, link)

    def elapse_until(self, host_ns: int) -> None:
        """On virtual time, advance the clock by a time-out in which nothing can come."""
        if self.virtual and host_ns > self._virtual_ns:
            self.elapsed_ns += host_ns - self._virtual_ns
            self._virtual_ns = host_ns

    def wait(self, timeout_s: float) -> list[tuple[Link, Received]]:
        """The messages that came, in order of time; in real time, wait for them for up to ``timeout_s``."""
        pending, self.pending = self.pending, []
        if self.virtual:
            pending += self._receive_until_dealt_with()
            # Time moves here and nowhere else: the time at a send must not depend on the messages that have come by
            # then.
            self._virtual_ns = max(self._virtual_ns, *(link.handed.host_ns for link in self.links if link.handed))
        elif not pending:
            beside = [each for each in self.beside if each.alive]
            lines = [link.transport for link in self.links if link.lost is None]
            wait_readable(
                [*lines, *beside], min(timeout_s, TIMEOUTS.slice_s), [each for each in beside if each.has_to_send]
            )
            pending = [(link, r) for link in self.links for r in link.receive()]
            for each in beside:
                each.serve()
        order = {link: i for i, link in enumerate(self.links)}
        pending.sort(key=lambda pair: (pair[1].receive_ns, order[pair[0]]))
        return pending

    def request(
        self, link: Link, request: Message, answers: type[AnyMessage], is_it: Callable[[AnyMessage, int], bool],
        answer_s: float = TIMEOUTS.answer_s, tries: int = TIMEOUTS.tries, *, insist_s: float = 0.0,
    ) -> AnyMessage | None:  # fmt: skip
        """Send a request until its answer comes; None if it never does. Other messages wait for `wait`.

        ``is_it(answer, sequence)`` says whether an answer belongs to the request of that sequence number: that of the
        last try or of an earlier one. Each of the ``tries`` waits for ``answer_s``. With ``insist_s`` a request to stop
        does not end them, and there are more of them until nothing at all has been heard of the device for so long.
        """
        before = self._memory_bytes()
        sequences: list[int] = []
        heard_ns = self.now_ns()
        for attempt in range(TIMEOUTS.most_tries if insist_s else tries):
            if attempt and not insist_s and (self._hurried or self._stop() or link.foreign_version is not None):
                break
            heard_ns = max(heard_ns, link.last_heard_ns)
            if attempt >= tries and self.now_ns() - heard_ns > insist_s * 1e9:
                break
            sequences.append(link.send(request))
            deadline_ns = self.now_ns() + round(answer_s * 1e9)
            while True:
                if link.lost is not None:
                    raise link.lost
                kept = self.pending
                self.pending = []
                answer = None
                for source, received in self.wait((deadline_ns - self.now_ns()) / 1e9):
                    message = received.message
                    if (
                        answer is None
                        and source is link
                        and isinstance(message, answers)
                        and any(is_it(message, sequence) for sequence in sequences)
                    ):
                        answer = message
                        if isinstance(request, pb.Identify):  # messages that came before belong to an earlier session
                            kept = [each for each in kept if each[0] is not link]
                    else:
                        kept.append((source, received))
                self.pending = kept
                self._keep_to_budget(before)
                if answer is not None:
                    return answer
                if self.virtual or self.now_ns() >= deadline_ns:
                    break
        return None

    def close(self) -> None:
        for link in self.links:
            link.transport.close()

    def _settle_others(self, link: Link) -> None:
        """On virtual time, wait until the rig has handled everything sent on the other line.

        Two lines are two queues, and which of them the rig reads first is not determined, so nothing is sent on one
        before the other is handled. Either nothing is read here or everything that is due: the messages read must not
        depend on speed.
        """
        others = [each for each in self.links if each is not link]
        if not all(self._has_dealt_with(others, each) for each in self.links):
            self.pending += self._receive_until_dealt_with()

    def _receive_until_dealt_with(self) -> list[tuple[Link, Received]]:
        """All messages that came until the rig had handled everything that was sent."""
        received: list[tuple[Link, Received]] = []
        before, heard, last_heard, stop_since = self._memory_bytes(), -1, time.monotonic(), math.inf
        while True:
            received.extend((link, r) for link in self.links for r in link.receive())
            waiting = [link.transport for link in self.links if not self._has_dealt_with(self.links, link)]
            if not waiting:
                return received
            self._keep_to_budget(before)
            now = time.monotonic()
            if (total := self._memory_bytes()) != heard:
                heard, last_heard = total, now
            if self._hurried or self._stop():
                stop_since = min(stop_since, now)
            ended = now - stop_since > self._patience_s
            if ended:
                self._patience_s = TIMEOUTS.last_patience_s
            if (silence := now - last_heard) > (TIMEOUTS.last_patience_s if ended else TIMEOUTS.virtual_silence_s):
                raise DeviceError(f"the rig on virtual time has said nothing for {silence:.1f} s: is it stopped?")
            if ended:
                raise DeviceError("the rig on virtual time sends messages without handling those it was sent")
            wait_readable(waiting, TIMEOUTS.slice_s)

    def _memory_bytes(self) -> int:
        """The memory that all messages so far took, bytes."""
        return sum(each.counts.bytes_received + _MESSAGE_BYTES * each.counts.packets_received for each in self.links)

    def _keep_to_budget(self, before: int) -> None:
        if (used := self._memory_bytes() - before) > self.budget_bytes:
            raise DeviceError(
                f"the devices have sent messages of {used >> 20} MiB without answering, expected at most"
                f" {self.budget_bytes >> 20} MiB: their firmware is at fault"
            )

    def _has_dealt_with(self, senders: Sequence[Link], link: Link) -> bool:
        """Whether the rig has reported on ``link`` that it has handled everything: all that follows from it has then
        come as well."""
        handed = link.handed
        if handed is None:
            return False
        taken = {"camera": handed.camera_bytes, "mirror": handed.mirror_bytes}
        # A larger number than was sent comes from an earlier session.
        return all(taken[each.name] == each.sent_bytes for each in senders)
