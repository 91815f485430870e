"""A PlayzerX on a pseudo terminal, written from the maker's page "PlayzerX USB Serial Protocol".

What the page does not say was chosen so that a driver can take nothing for granted: when its queue is emptied it goes
on with the sample that it puts out, light included; with its analog input it takes no sample from the queue; and what
it sends unasked looks like its answers.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.devices.simulators.serial_device import NO_FAULTS, Faults, SerialDevice

POWER_ON_RATE = 22_000
ORIGIN = (2048, 2048)


class Sample(NamedTuple):
    """A sample as it was sent."""

    x: int
    y: int
    colours: tuple[int, ...]


def read_commands(data: bytes) -> tuple[list[bytes], bytes]:
    """The whole commands in ``data``, and the rest; what is no command is skipped."""
    commands: list[bytes] = []
    while (at := data.find(b"pl")) >= 0 and len(data) >= at + 4:
        end = at + data[at + 3]
        if len(data) < end:
            return commands, data[at:]
        if data[at + 3] >= 5 and data[end - 1] == 10:
            commands.append(data[at:end])
            data = data[end:]
        else:
            data = data[at + 1 :]
    return commands, data[at:] if at >= 0 else data[-1:]


def read_sample(sample: bytes) -> Sample:
    """A sample's positions and its levels of light."""
    low, mixed, high, *colours = sample[4:-1]
    return Sample(low | (mixed & 0xF0) << 4, mixed & 0x0F | high << 4, tuple(colours))


class PlayzerX(SerialDevice):
    """The device, by the computer's clock.

    Parameters
    ----------
    ping:
        What it answers to a ping.
    data_format:
        The third line of its information; None for older firmware, which has none.
    capacity:
        Samples that its queue holds; 0 for a device that takes none.
    rate_error:
        By how much its samples are faster than they should be, as a part.
    loses:
        Number of a sample, counted from 0, that is lost on the line.
    deaf:
        After how many samples it once stops reading its line, behind the next question, and for how long, s.
    slowest:
        Its least rate, samples a second.
    left_over:
        What it has sent before, to another program.
    analog:
        Whether it is switched on with its analog input.
    updates_ms:
        After how long without a command it says how many samples remain, unasked; 0 for never.
    """

    baud_rate = 921_600

    def __init__(
        self, *, ping: bytes = b"pl-ok\n", data_format: str | None = "XYM", capacity: int = 125_000,
        rate_error: float = 0.0, loses: int | None = None, deaf: tuple[int, float] = (sys.maxsize, 0.0),
        slowest: int = 50, left_over: bytes = b"",
        analog: bool = False, updates_ms: int = 0, faults: Faults = NO_FAULTS,
    ) -> None:  # fmt: skip
        self._ping, self._data_format, self._loses, self._slowest = ping, data_format, loses, slowest
        self._deaf, self._after_question = deaf, False
        self._capacity, self._colours = capacity, 3 if data_format == "XYRGB" else 1
        self._rate_error, self._analog = rate_error, analog
        self.every_s = updates_ms / 1000 or None
        self.lock = threading.RLock()
        """Held while it does anything."""
        self._queue: list[Sample] = []
        self._arrived = 0
        self.output: Sample | None = None
        """What is put out now."""
        self.zero_ns = 0
        """Host time at which the first sample since the queue was cleared was put out."""
        self.put_out: list[Sample] = []
        """What was put out in each sample period since then."""
        self.overflowed = False
        self._before = Sample(*ORIGIN, ())
        """What was put out until then."""
        self._set_rate(POWER_ON_RATE)
        super().__init__(faults)
        os.write(self.device, left_over)

    def requests_in(self, waiting: bytes) -> tuple[list[bytes], bytes]:
        return read_commands(waiting)

    def answer(self, request: bytes) -> bytes:
        if self._after_question and request[2:3] == b"d" and self._arrived >= self._deaf[0]:
            time.sleep(self._deaf[1])
            self._deaf = (sys.maxsize, 0.0)
        self._after_question = request[2:3] == b"g"
        with self.lock:
            self._pass_time()
            return self._execute(chr(request[2]), request)

    def unasked(self) -> bytes:
        with self.lock:
            self._pass_time()
            return self._remaining()

    def reset(self) -> None:
        with self.lock:
            self._analog, self.output, self._before = True, None, Sample(*ORIGIN, ())
            self._queue, self.put_out, self.zero_ns = [], [], 0
            self._set_rate(POWER_ON_RATE)

    def at_rest(self) -> Sample | None:
        """What it goes on putting out when its queue has run dry; None where its analog input decides."""
        with self.lock:
            if self._analog:
                return None
            return self._queue[-1] if self._queue else self.output

    def inputs_at(self, host_ns: int) -> NDArray[np.float64]:
        """What it puts out at a host time, from -1 to 1, (2,)."""
        with self.lock:
            self._pass_time()
            period = int((host_ns - self.zero_ns) // self.period_ns) if self.zero_ns else -1
            x, y, _ = self.put_out[min(period, len(self.put_out) - 1)] if period >= 0 else self._before
        return np.array([x, y]) / 2047.5 - 1

    def _pass_time(self) -> None:
        """Put out the samples of the periods that have begun; the last one stays where there is none."""
        now_ns = time.monotonic_ns()
        while self._tick_ns <= now_ns:
            if self._queue and not self._analog:
                before, self.output = self.output, self._queue.pop(0)
                self.moves += self.output != before
                self.zero_ns = self.zero_ns or int(self._tick_ns)
            if self.zero_ns and self.output:
                self.put_out.append(self.output)
            self._tick_ns += self.period_ns

    def _execute(self, code: str, request: bytes) -> bytes:
        match code, len(request):
            case ("d", 9 | 11):
                self._arrived += 1
                if self._arrived - 1 != self._loses and len(request) == 8 + self._colours and self._capacity:
                    self.overflowed |= len(self._queue) >= self._capacity
                    self._queue.append(read_sample(request))
            case "c", 5:
                self._queue, self.put_out, self.zero_ns, self._arrived = [], [], 0, 0
                self._before = self.output or self._before
            case "i", 8:
                self._analog = request[4:7] == b"ain"
            case "u", 7:
                self.every_s = int.from_bytes(request[4:6], "little") / 1000 or None
            case "r", 8:
                self._set_rate(min(max(int.from_bytes(request[4:7], "little"), self._slowest), 50_000))
            case "p", 5:
                return self._ping
            case "n", 5:
                lines = ["pl-info", "PlayzerX-SX", "1.0.2.0", *([self._data_format] if self._data_format else [])]
                return "".join(f"{line}\n" for line in lines).encode()
            case "g", 5:
                return self._remaining()
        return b""

    def _remaining(self) -> bytes:
        return b"pl-" + len(self._queue).to_bytes(3, "little")

    def _set_rate(self, rate: int) -> None:
        self.period_ns = 1e9 / rate / (1 + self._rate_error)
        self._tick_ns = time.monotonic_ns() + self.period_ns
