"""Both lines of a rig as one stream of messages in order of the host's time.

In real time the hub waits on the ports. On virtual time it waits until the rig has dealt with
everything that was sent and has said so on every line; what came by then does not depend on the
speed of either side, so neither does anything that follows from it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

from google.protobuf.message import Message

from aolink.errors import DeviceError
from aolink.wire.link import Link, Received
from aolink.wire.port import Transport, wait_readable

ANSWER_S = 1.0
"""How long an answer may take before a request is sent again."""
TRIES = 3
_VIRTUAL_SILENCE_S = 20.0
"""A rig on virtual time that says nothing for so long is gone."""
_SLICE_S = 0.1
"""Longest sleep: a request to stop is seen that soon."""

AnyMessage = TypeVar("AnyMessage", bound=Message)


class Hub:
    """The host's clock and the links of one session.

    Once ``stop()`` says so, nobody is waited for longer than for one answer.
    """

    def __init__(self, stop: Callable[[], bool] = lambda: False) -> None:
        self._stop = stop
        self.links: list[Link] = []
        self.virtual = False
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._virtual_ns = 0
        self._pending: list[tuple[Link, Received]] = []

    def now_ns(self) -> int:
        """Host time, ns since 1970: steady within a session, handed down by the rig on virtual time."""
        return self._virtual_ns if self.virtual else self._epoch_ns + time.monotonic_ns()

    def connect(self, name: str, transport: Transport) -> Link:
        """Add a line."""
        link = Link(name, transport, self.now_ns)
        self.links.append(link)
        return link

    def go_virtual(self) -> None:
        """From now on time is what the rig says."""
        self.virtual = True
        self._virtual_ns = max(link.handed.host_ns for link in self.links if link.handed)
        for link in self.links:
            link.before_send = partial(self._settle_others, link)

    def elapse_until(self, host_ns: int) -> None:
        """Virtual time: let a time-out pass in which nothing can come."""
        if self.virtual:
            self._virtual_ns = max(self._virtual_ns, host_ns)

    def wait(self, timeout_s: float) -> list[tuple[Link, Received]]:
        """The messages that came, in order of time; in real time, wait for them for up to ``timeout_s``."""
        pending, self._pending = self._pending, []
        if self.virtual:
            pending += self._receive_until_dealt_with()
            # Time moves here and nowhere else: what a send sees must not depend on what has come by then.
            self._virtual_ns = max(self._virtual_ns, *(link.handed.host_ns for link in self.links if link.handed))
        elif not pending:
            wait_readable([link.transport for link in self.links], min(timeout_s, _SLICE_S))
            pending = [(link, r) for link in self.links for r in link.receive()]
        order = {link: i for i, link in enumerate(self.links)}
        pending.sort(key=lambda pair: (pair[1].receive_ns, order[pair[0]]))
        return pending

    def request(
        self,
        link: Link,
        request: Message,
        answers: type[AnyMessage],
        is_it: Callable[[AnyMessage, int], bool],
        answer_s: float = ANSWER_S,
        tries: int = TRIES,
    ) -> AnyMessage | None:
        """Send a request until its answer comes; None if it never does. Other messages wait for `wait`.

        ``is_it(answer, sequence)`` tells whether an answer belongs to the request of that sequence number: of the last
        try or of one before. Each of the ``tries`` waits for ``answer_s``.
        """
        sequences: list[int] = []
        for attempt in range(tries):
            if attempt and self._stop():
                break
            sequences.append(link.send(request))
            deadline_ns = self.now_ns() + round(answer_s * 1e9)
            while True:
                kept = self._pending
                self._pending = []
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
                    else:
                        kept.append((source, received))
                self._pending = kept
                if answer is not None:
                    return answer
                if self.virtual or self.now_ns() >= deadline_ns:
                    break
        return None

    def close(self) -> None:
        for link in self.links:
            link.transport.close()

    def _settle_others(self, link: Link) -> None:
        """Virtual time: two lines are two queues, and which the rig looks at first is anybody's guess.

        So nothing is sent on one while something sent on another has not been dealt with. Either nothing is
        read here or everything that is due: what has been read must not depend on speed.
        """
        others = [each for each in self.links if each is not link]
        if not all(self._has_dealt_with(others, each) for each in self.links):
            self._pending += self._receive_until_dealt_with()

    def _receive_until_dealt_with(self) -> list[tuple[Link, Received]]:
        """Everything that came until the rig had dealt with all that was sent."""
        received: list[tuple[Link, Received]] = []
        heard, last_heard = -1, time.monotonic()
        while True:
            received.extend((link, r) for link in self.links for r in link.receive())
            waiting = [link.transport for link in self.links if not self._has_dealt_with(self.links, link)]
            if not waiting:
                break
            total = sum(link.counts.bytes_received for link in self.links)
            if total != heard:
                heard, last_heard = total, time.monotonic()
            elif (silence := time.monotonic() - last_heard) > (ANSWER_S if self._stop() else _VIRTUAL_SILENCE_S):
                raise DeviceError(f"the rig on virtual time has said nothing for {silence:.0f} s: is it stopped?")
            wait_readable(waiting, _SLICE_S)
        return received

    def _has_dealt_with(self, senders: Sequence[Link], link: Link) -> bool:
        """Whether the rig has said so on ``link``: everything that follows from it has come as well."""
        handed = link.handed
        if handed is None:
            return False
        taken = {"camera": handed.camera_packets, "mirror": handed.mirror_packets}
        return all(taken[each.name] >= each.sent_packets for each in senders)
