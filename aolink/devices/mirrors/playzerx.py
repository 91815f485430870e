"""Mirrorcle PlayzerX: a mirror of two axes behind a queue of samples, one for each fast step.

The commands are those of the maker's page "PlayzerX USB Serial Protocol" (12 bits for each axis, 0 to 4095 for -1 to
1); the answers are read as the maker's own library (PlayzerX.cpp, version 2.1) does.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import count
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from aolink.devices.mirrors.keys import check_resolution
from aolink.devices.mirrors.line import QUIET_S, SerialLine, shown
from aolink.devices.mirrors.sample_clock import SampleClock
from aolink.devices.paced import Played
from aolink.devices.simple import Lacks
from aolink.errors import AolinkError, DeviceError
from aolink.rig import Rig

NOT_LISTED = "it does not look for devices, whose ports look like any other: give devices.mirror.port"
BAUD_RATE = 921_600
RATES = range(50, 50_001)
"""Samples a second."""
_CAPACITY = {"XYM": 125_000, "XYRGB": 83_333}
"""Samples in the queue, by the device's data format."""
_COLOURS = {"XYM": 1, "XYRGB": 3}
_HALF = 2047.5
"""Converter steps from the origin to the end of the range."""
_PERIOD_S = 0.01
"""The shortest time, roughly, between two fillings and counts of the queue, s."""
_GOLDEN = 0.618034
"""The pauses between two counts follow this ratio, so that they fall into all phases of a sample."""
_WARM_UP = 30
"""Counts before the first step is reported: enough to know the phase of the samples."""
_SLOW_NS = 3_000_000
"""An answer that takes longer shows that something was held up, but not on which side."""
_TRIES = 3
"""Number of attempts, for a machine that is held up right at the beginning."""
_INFO_S = 0.3
"""How long to wait for older firmware to report its data format, s."""

Codes = NDArray[np.uint16]
"""Positions as the converter takes them, (n_samples, 2)."""


def command(code: str, data: bytes = b"") -> bytes:
    """The bytes of a command: prefix, code, its whole length, data, end."""
    return b"pl" + code.encode() + bytes([5 + len(data)]) + data + b"\n"


PING, INFO, REMAINING, CLEAR = (command(code) for code in "pngc")
USB_INPUT = command("i", b"usb")
NO_UPDATES = command("u", bytes(2))
_ANSWER = 6
"""Bytes of the answer to `REMAINING`."""


def sample_rate(rate: int) -> bytes:
    """The command that sets the sample rate, samples a second."""
    return command("r", rate.to_bytes(3, "little"))


def codes_of(u: NDArray[np.float64]) -> Codes:
    """Converter steps for positions (n_samples, 1 or 2) from -1 to 1; the second axis is at the origin if not given."""
    codes = np.full((len(u), 2), round(_HALF), dtype=np.uint16)
    codes[:, : u.shape[1]] = np.clip(np.round((u + 1) * _HALF), 0, 2 * _HALF)
    return codes


def samples(codes: Codes, laser: Sequence[int]) -> bytes:
    """Commands for samples, (n_samples, 2), with the laser's level in each colour that the device has, 0 to 255."""
    x, y = codes.T
    head = command("d", bytes(3 + len(laser)))
    packets = np.tile(np.frombuffer(head, dtype=np.uint8), (len(codes), 1))
    packets[:, 4] = x & 0xFF
    packets[:, 5] = x >> 8 << 4 | y & 0xF
    packets[:, 6] = y >> 4
    packets[:, 7 : 7 + len(laser)] = laser
    return packets.tobytes()


def remaining(answer: bytes) -> int:
    """Samples in the queue by the device's answer. Raises DeviceError."""
    left = int.from_bytes(answer[3:], "little")
    if answer[:3] != b"pl-" or left > max(_CAPACITY.values()):
        raise DeviceError(
            f"the PlayzerX answers {shown(answer)} when it is asked how many samples remain, expected 'pl-' and a"
            " number of three bytes: its line loses bytes, or its firmware is another one"
        )
    return left


class PlayzerX(Played):
    """A simple driver (`aolink.devices.simple.SimpleMirror`).

    The device takes a sample from its queue in each fast step, and the driver keeps the samples of the next ``ahead_s``
    in it, from opening to closing: commands, and the safe input where there is none. So the host may be held up for
    that long; a command must come as much earlier than its first step, and cannot be replaced after that. The queue can
    be emptied, but it is not known at which sample this happens, so it is done only when the device is closed.

    If the host is held up for longer, the queue runs dry: the mirror holds the last sample meanwhile, steps that were
    commanded count as late, and the driver finds out from the next counts which sample belongs to which step.

    Parameters
    ----------
    port:
        A device path.
    laser:
        Level of the device's laser while it is open, 0 to 255, in each of its colours.
    ahead_s:
        How much is queued on the device, s.

    Raises
    ------
    DeviceError
        The rig file asks for something that the device cannot do, or the device does not answer as a PlayzerX does.
    PortError
        The port cannot be opened.
    """

    lacks: ClassVar[tuple[Lacks, ...]] = (Lacks.READ_BACK, Lacks.WATCHDOG, Lacks.STOP)

    def __init__(self, rig: Rig, *, port: str, laser: int = 0, ahead_s: float = 0.1) -> None:
        super().__init__()
        self._n_inputs, self._step_ns = rig.n_inputs, rig.timing.fast_step_ns
        rate = round(1e9 / self._step_ns)
        self._ahead = round(ahead_s * rate)
        _check(rig, rate, laser, self._ahead)
        self._park = codes_of(rig.mirror.park[None])
        self._laser: list[int] = []
        """Levels of its colours, once it is known how many it has."""
        self._line = SerialLine("the PlayzerX", port, BAUD_RATE)
        try:
            self.description, data_format = self._identify()
            self._laser = [laser] * _COLOURS[data_format]
            if self._ahead > _CAPACITY[data_format] // 2:
                raise DeviceError(
                    f"devices.mirror.ahead_s = {ahead_s:g} is more than half of the PlayzerX's queue of"
                    f" {_CAPACITY[data_format]} samples: give {_CAPACITY[data_format] / 2 / rate:g} at most"
                )
            self._clock = SampleClock(self._step_ns)
            self._pauses = (min(_PERIOD_S, ahead_s / 10) * (0.5 + k * _GOLDEN % 1) for k in count())
            self._handed = self._offset = 0
            """Samples handed over, and the difference of a step's number from its sample's."""
            self._taken = 0
            """The step that the mirror was in at the latest count."""
            self._batch = 0
            """The first step of the samples that were handed over last."""
            self._closing = threading.Event()
            self._line.tell(USB_INPUT + sample_rate(rate))
            self._begin()
            for _ in range(_WARM_UP):
                self._serve()
                time.sleep(next(self._pauses))
            self._clock.settle()
        except BaseException:
            if self._laser:
                with suppress(AolinkError):
                    self._leave_safe()
            self._line.close()
            raise
        self._thread.start()

    @property
    def timing_sigma_ns(self) -> float:
        with self._changed:
            return self._clock.sigma_ns

    def time_ns(self) -> int:
        with self._changed:
            return self._clock.time_ns(time.monotonic_ns())

    def send(self, first_step: int, u: NDArray[np.float64]) -> int:
        return super().send(first_step, codes_of(u))

    def _n_over(self) -> int:
        return max(self._taken - self._reported, 0)

    def _inputs(self, held: Codes) -> NDArray[np.float64]:
        return held[:, : self._n_inputs] / _HALF - 1

    def park(self) -> int:
        with self._changed:
            self._check()
            self._queue.clear()
            return self._next

    def close(self) -> None:
        """Empty the queue, hold the safe input with the laser off, and give the port back."""
        self._closing.set()
        self._thread.join()
        try:
            self._leave_safe()
        except AolinkError:
            if self._failure is None:  # otherwise the session knows of it already
                raise
        finally:
            self._line.close()

    def _leave_safe(self) -> None:
        self._line.tell(USB_INPUT + CLEAR + samples(self._park, [0] * len(self._laser)))  # it may have been reset
        self._count()

    def _identify(self) -> tuple[str, str]:
        # The first command ends a command that another program may have left half sent; the second one stops what that
        # program started.
        self._line.tell(NO_UPDATES + NO_UPDATES)
        self._line.drain(QUIET_S)
        for request, expected in ((PING, b"pl-ok"), (INFO, b"pl-info")):
            if (answer := self._line.ask(request)) != expected:
                raise DeviceError(
                    f"{self._line.url} answers {shown(answer)}, expected {shown(expected)}: it is no PlayzerX"
                )
        name, firmware = (self._line.read_until().decode("ascii", "replace").strip() for _ in range(2))
        data_format = "XYM"
        with suppress(DeviceError):
            data_format = self._line.read_until(timeout_s=_INFO_S).decode("ascii", "replace").strip()
        if data_format not in _CAPACITY:
            raise DeviceError(f"the PlayzerX takes samples of {data_format!r}, this driver knows XYM and XYRGB only")
        return f"Mirrorcle {name}, firmware {firmware}, {data_format}", data_format

    def _begin(self) -> None:
        """Queue the first samples. Raises DeviceError where the device does not take them."""
        for _ in range(_TRIES):
            self._held, self._next, self._handed = [], 0, 0
            self._line.tell(CLEAR)
            self._hand_over(self._ahead)
            asked_ns = time.monotonic_ns()
            if left := self._count():
                self._take_count(self._handed - left, asked_ns, time.monotonic_ns())
                return
        raise DeviceError(
            f"the PlayzerX says that none of {self._handed} samples remain as soon as it is sent them: it does not take"
            " them, or this machine was held up for longer than they last (devices.mirror.ahead_s)"
        )

    def _play(self) -> None:
        while not self._closing.wait(next(self._pauses)):
            self._serve()

    def _serve(self) -> None:
        """Count the samples, and fill the queue."""
        # A slow answer does not show whether the queue ran dry meanwhile, nor before which samples. The next one does,
        # as long as nothing more was handed over.
        for _ in range(_TRIES):
            asked_ns = time.monotonic_ns()
            left = self._count()
            answered_ns = time.monotonic_ns()
            if answered_ns - asked_ns <= _SLOW_NS:
                break
            if left > self._ahead // 2:
                return  # there is time to ask again
        with self._changed:
            if left:
                self._take_count(self._handed - left, asked_ns, answered_ns)
            else:  # until now, the last sample was held
                self._delay(self._next, self._step_at(answered_ns) + 1 - self._next)
                self._clock.doubt(self._step_ns)
        self._hand_over(self._step_at(time.monotonic_ns()) + 1 + self._ahead - self._next)

    def _count(self) -> int:
        """Ask for the number of samples in the queue. The question follows all samples on the line, so that they are
        counted."""
        self._line.drain()
        self._line.tell(REMAINING)
        return remaining(self._line.read_exactly(_ANSWER))

    def _take_count(self, taken: int, asked_ns: int, answered_ns: int) -> None:
        """Use a count: ``taken`` of the samples handed over were taken from the queue, and the last of them is being
        held."""
        slip = self._clock.add(taken + self._offset, asked_ns, answered_ns)
        if slip > 0 and self._taken < self._batch <= taken + self._offset:
            # The device is behind, but has taken all samples before the last batch: that batch came when the queue had
            # run dry.
            now = self._step_at((asked_ns + answered_ns) // 2)
            self._delay(self._batch, max(now + 1 - (taken + self._offset), 1))
            self._clock.doubt(self._step_ns + answered_ns - asked_ns)
        elif slip:
            raise DeviceError(
                f"the PlayzerX's count of samples is off by {slip:.1f}: its line loses bytes, or it does not play"
                f" {1e9 / self._step_ns:g} samples a second as it was asked to"
            )
        self._taken = max(self._taken, taken - 1 + self._offset)

    def _step_at(self, host_ns: int) -> int:
        return self._clock.time_ns(host_ns) // self._step_ns

    def _delay(self, step: int, n_steps: int) -> None:
        """Note that the queue had run dry: from ``step`` on, the samples handed over are held ``n_steps`` later."""
        if n_steps > 0:
            at = step - self._reported
            before, _ = self._held[at - 1]
            late = [self._queue.pop(k, None) is not None for k in range(self._next, self._next + n_steps)]
            self._held[at:at] = [(before, each) for each in late]
            self._next, self._offset = self._next + n_steps, self._offset + n_steps

    def _hand_over(self, n_samples: int) -> None:
        """Queue samples on the device: the safe input for the steps without a command."""
        if n_samples <= 0:
            return
        with self._changed:
            steps = range(self._next, self._next + n_samples)
            codes = np.array([self._queue.pop(step, self._park[0]) for step in steps])
            self._held += [(each, False) for each in codes]
            self._batch, self._next, self._handed = steps.start, steps.stop, self._handed + n_samples
        self._line.tell(samples(codes, self._laser))


def _check(rig: Rig, rate: int, laser: int, ahead: int) -> None:
    """Refuse what the device cannot do. Raises DeviceError."""
    mirror = rig.mirror
    if rate not in RATES or rate * rig.timing.fast_step_ns != 1_000_000_000:
        raise DeviceError(
            f"timing.fast_step_s = {rig.timing.fast_step_s:g} is {1 / rig.timing.fast_step_s:g} samples a second: the"
            f" PlayzerX plays a whole number from {RATES.start} to {RATES.stop - 1}; take one that divides 10^9"
        )
    if rig.n_inputs > 2 or (mirror.input_min < -1).any() or (mirror.input_max > 1).any():
        raise DeviceError(
            f"the PlayzerX has two axes, each from -1 to 1: the rig file's mirror has {rig.n_inputs} input(s) from"
            f" {mirror.input_min.min():g} to {mirror.input_max.max():g}"
        )
    check_resolution(mirror, 1 / _HALF, "the PlayzerX")
    if laser not in range(256):
        raise DeviceError(f"devices.mirror.laser = {laser}: expected a whole number from 0 to 255")
    if ahead < 1:
        raise DeviceError("devices.mirror.ahead_s is shorter than a fast step: nothing would be queued")
    if (least := ahead + 6 * mirror.block_steps) > mirror.queue_steps:
        raise DeviceError(
            f"mirror.queue_steps = {mirror.queue_steps} leaves too little time for commands: {ahead} steps are queued"
            f" on the PlayzerX (devices.mirror.ahead_s) and commands come in blocks of {mirror.block_steps}; set it to"
            f" {least} or more"
        )
