"""A device at the far end of a real pseudo terminal, served by a thread, which can misbehave in all the usual ways."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import struct
import threading
import time
import tty
from dataclasses import dataclass
from typing import Self

_TCGETS2 = 0x802C542A
"""Linux: the settings of a terminal with its speed as a number."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """What goes wrong from the move ``after_moves`` on, from which answers, requests and moves are counted."""

    after_moves: int = 0
    late_s: float = 0.0
    """Time that the device takes for each answer."""
    split: bool = False
    """Answers come byte by byte."""
    garbled: frozenset[int] = frozenset()
    """Answers with the highest bit of each byte set, up to the end."""
    refused: frozenset[int] = frozenset()
    """Moves that it refuses, in the words of its protocol."""
    silent_from: float = float("inf")
    """First request that is not answered any more."""
    unplugged_at: float = float("inf")
    """Request with which the device vanishes."""
    reset_at: int = -1
    """Request before which its power fails for a moment: it is then as it is switched on."""


NO_FAULTS = Faults()


class SerialDevice:
    """Base of the simulated devices: each gives its answer to a request, and how a request ends.

    ``port`` is the path for the driver, ``start`` what the device holds when it is switched on. At another speed than
    ``baud_rate`` it understands nothing, and what it sends cannot be understood.
    """

    baud_rate = 115_200
    end = b"\n"
    every_s: float | None = None
    """After how long without a request it sends something unasked; None where it never does."""

    def __init__(self, faults: Faults, *start: float) -> None:
        self.requests: list[bytes] = []
        self.moves = -1
        """How often it has held something else since it was switched on."""
        self.held: list[tuple[int, tuple[float, ...]]] = []
        """Since when, by `time.monotonic_ns`, it has held what."""
        self.hold(*start)
        self._faults = faults
        self._answers = self._asked = self._told_to_move = 0
        """Counted from the move on with which the faults begin."""
        self.device, self._host = pty.openpty()
        tty.setraw(self._host)
        self.port = os.ttyname(self._host)
        self._woken, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, name=f"simulated {type(self).__name__}", daemon=True)
        self._thread.start()

    def answer(self, request: bytes) -> bytes:
        """What the device sends for a request, which comes without its end; nothing for most commands."""
        raise NotImplementedError

    def unasked(self) -> bytes:
        """What the device sends without a request."""
        raise NotImplementedError

    def reset(self) -> None:
        """Be as it is switched on."""
        raise NotImplementedError

    def refuses(self) -> bool:
        """Whether it refuses the move that it is told now."""
        self._told_to_move += self._misbehaves()
        return self._told_to_move - 1 in self._faults.refused

    def hold(self, *values: float) -> None:
        """Hold something else from now on."""
        self.moves += 1
        self.held.append((time.monotonic_ns(), values))

    def now(self) -> tuple[float, ...]:
        """What it holds."""
        return self.held[-1][1]

    def requests_in(self, waiting: bytes) -> tuple[list[bytes], bytes]:
        """Whole requests at the beginning of what came, and the rest."""
        *whole, rest = waiting.split(self.end)
        return whole, rest

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._wake)
        self._thread.join()

    def _serve(self) -> None:
        waiting = b""
        try:
            while True:
                ready, _, _ = select.select([self.device, self._woken], [], [], self.every_s)
                if self._woken in ready:
                    return
                if not ready:
                    os.write(self.device, self.unasked())
                    continue
                data = os.read(self.device, 4096)
                if self._speed() != self.baud_rate:
                    os.write(self.device, bytes(byte ^ 0xA5 for byte in data[::2]))
                    continue
                requests, waiting = self.requests_in(waiting + data)
                for request in requests:
                    now = self._asked if self._misbehaves() else -1
                    if now >= self._faults.unplugged_at:
                        return
                    if now == self._faults.reset_at >= 0:
                        self.reset()
                    self._asked += now >= 0
                    self.requests.append(request)
                    answer = self.answer(request)
                    if answer and now < self._faults.silent_from:
                        self._send(answer)
        finally:
            for descriptor in (self.device, self._host, self._woken):
                os.close(descriptor)

    def _misbehaves(self) -> bool:
        return self.moves >= self._faults.after_moves

    def _send(self, answer: bytes) -> None:
        pieces = [answer]
        if self._misbehaves():
            time.sleep(self._faults.late_s)
            if self._answers in self._faults.garbled:
                text = answer.removesuffix(self.end)
                answer = bytes(byte | 0x80 for byte in text) + answer[len(text) :]
            self._answers += 1
            pieces = [answer[k : k + 1] for k in range(len(answer))] if self._faults.split else [answer]
        for piece in pieces:
            os.write(self.device, piece)

    def _speed(self) -> int:
        settings = fcntl.ioctl(self.device, _TCGETS2, bytes(44))
        return int(struct.unpack("=4IB19B2I", settings)[-1])
