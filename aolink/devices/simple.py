"""Protocols for drivers of other packages, and adapters that make a session's devices of them.

A simple driver knows its device and nothing of aolink's packets. It never waits: the session's thread polls it every
few milliseconds. The adapters assign fast steps to its frames and samples, compare its clock with the host's, and give
each command its answer and its report.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import count, groupby
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.devices.clock import ClockExchange, ClockRegression
from aolink.devices.drivers import calling
from aolink.devices.gate import check_command, converter_margin, printable
from aolink.devices.interfaces import ClockSampled, CommandAnswered, Event, Mirror
from aolink.errors import DeviceError
from aolink.exposure import Truth
from aolink.rig import Rig
from aolink.wire import messages_pb2 as pb
from aolink.wire.truth import truth_message

_OFFSETS = 16
"""An exposure's start is rounded to this part of a fast step: estimators keep a model for each that occurs."""
_START_SIGMA = 3.0
"""A camera is started this many standard deviations of the clocks' comparison after the fast step begins."""
_PATIENCE_NS = 1_000_000_000
"""How long the end of a session waits for reports."""
_FUTURE_NS = 1_000_000_000
"""How far a frame's end may be ahead of the host's clock: more than any error of the clocks' comparison."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SimpleFrame:
    """A frame as a simple driver gives it."""

    pixels: NDArray[np.uint16]
    """Counts, (rows, columns) as the rig file's sensor has them."""
    start_ns: int
    """Start of the exposure on the camera's own clock."""
    exposure_ns: int
    """Length of the exposure, ns."""
    truth: Truth | None = None
    """What really happened, where the driver simulates a camera."""


class SimpleCamera(Protocol):
    """A camera. The entry point is called with the rig and, by keyword, the driver's own keys of the rig file.

    It raises `aolink.errors.DeviceError`, with the reason, where the device cannot do what the rig file says.
    """

    description: str
    """Model, serial number, firmware: for the recording."""

    def time_ns(self) -> int:
        """The camera's clock now, ns since any time; it must not jump."""

    def start(self, start_ns: int, exposures: int) -> None:
        """Take ``exposures`` frames (0: until stopped), the first as soon as the camera can from ``start_ns`` on."""

    def frames(self) -> Iterable[SimpleFrame]:
        """The frames that have come since the last call, in order, without waiting."""

    def stop(self) -> None:
        """Take no more frames."""

    def close(self) -> None:
        """Release the device."""


class SimpleMirror(Protocol):
    """A mirror that takes a queue of inputs, one for each fast step. For the entry point see `SimpleCamera`."""

    description: str

    def time_ns(self) -> int:
        """The mirror's clock now, ns since its fast step 0 began: the steps are counted by it. It must not jump."""

    def send(self, first_step: int, u: NDArray[np.float64]) -> int:
        """Queue inputs (n_steps, n_inputs) for the fast steps from ``first_step``; a later command replaces an earlier.

        Gives how many steps, from the first on, came too late. If it raises, the whole command counts as refused.
        """

    def applied(self) -> Iterable[tuple[int, NDArray[np.float64]]]:
        """What the mirror held since the last call: first fast steps and inputs (n_steps, n_inputs), in order."""

    def park(self) -> int:
        """Hold the safe input from now on and empty the queue; gives the first fast step of that."""

    def close(self) -> None:
        """Give the device back."""


class _Adapted:
    """The common part of both adapters: a clock that is read at once, and events that wait to be taken."""

    def __init__(self, name: str, driver: SimpleCamera | SimpleMirror, now_ns: Callable[[], int]) -> None:
        self.name = name
        self.description = printable(driver.description)
        self.clock = ClockRegression()
        self._time_ns, self._now_ns = driver.time_ns, now_ns
        self._events: list[Event] = []

    def query_clock(self, now_ns: int) -> None:
        sent_ns = self._now_ns()
        with calling(self.name, "when it was asked for the time"):
            device_ns = int(self._time_ns())
        exchange = ClockExchange(sent_ns, device_ns, device_ns, self._now_ns())
        self._events.append(ClockSampled.add(self.clock, exchange))

    def host_ns(self, device_ns: int, since_zero_ns: int, now_ns: int) -> tuple[int, float]:
        return self.clock.host_ns(device_ns)

    def statistics(self) -> dict[str, int]:
        return {}

    def _take_events(self) -> list[Event]:
        events, self._events = self._events, []
        return events


class AdaptedCamera(_Adapted):
    """A camera with a simple driver, beside a mirror that counts the fast steps.

    Frames carry no number: where one begins several periods after the one before, those between are lost.
    """

    rig_digest = ""
    chunks_refused = 0

    def __init__(self, rig: Rig, driver: SimpleCamera, mirror: Mirror, now_ns: Callable[[], int]) -> None:
        super().__init__("camera", driver, now_ns)
        if rig.scene is not None:
            raise DeviceError("the rig file has a [scene], and the camera's driver no second picture: take it out")
        self._rig, self._driver, self._mirror = rig, driver, mirror
        self._step_ns = rig.timing.fast_step_ns
        self._running = False
        self._first_step = 0
        self._last: tuple[int, int] | None = None
        """The id of the frame before, and its start on the camera's clock."""

    def start(self, first_step: int, exposures: int) -> bool:
        now_ns = self._now_ns()
        ahead_ns = first_step * self._step_ns - self._mirror.since_zero_ns(now_ns)
        if ahead_ns < 0:
            return False
        start_ns, sigma_ns = self.clock.device_ns(now_ns + ahead_ns)
        # An exposure that seems to begin before its session is none of it: rather a little later than too early.
        margin_ns = _START_SIGMA * math.hypot(sigma_ns, self._mirror.clock.device_ns(now_ns)[1])
        with calling(self.name, "when it was told to start"):
            self._driver.start(start_ns + round(min(margin_ns, self._step_ns)), exposures)
        self._first_step, self._running = first_step, True
        return True

    def stop(self) -> None:
        try:
            self._events = self.poll()  # with those that were waiting
        finally:
            self._running = False
            with calling(self.name, "when it was told to stop"):
                self._driver.stop()

    def flush(self) -> list[Frame]:
        return []

    def poll(self) -> list[Event]:
        """What has happened since the last call."""
        events = self._take_events()
        if self._running:
            with calling(self.name, "when it was asked for its frames"):
                for frame in self._driver.frames():
                    events += self._take(frame, self._now_ns())
        return events

    def _take(self, raw: SimpleFrame, now_ns: int) -> list[Event]:
        timing, sensor = self._rig.timing, self._rig.sensor
        pixels = np.asarray(raw.pixels)
        if pixels.shape != sensor.shape or int(pixels.max()) >> sensor.bit_depth or int(pixels.min()) < 0:
            raise DeviceError(
                f"the camera gives {pixels.shape} pixels from {pixels.min()} to {pixels.max()}, the rig file says"
                f" {sensor.shape} (rows, columns) of {sensor.bit_depth} bits: correct [sensor] or the camera's settings"
            )
        expected_ns = timing.exposure_steps * self._step_ns
        if abs(raw.exposure_ns - expected_ns) > self._step_ns / 2:
            raise DeviceError(
                f"the camera exposes for {raw.exposure_ns / 1e9:g} s, the rig file says {expected_ns / 1e9:g} s:"
                " correct timing.exposure_steps or the camera's settings"
            )
        host_start_ns, _ = self.clock.host_ns(raw.start_ns)
        if host_start_ns + expected_ns > now_ns + _FUTURE_NS:
            raise DeviceError(
                "the camera gives a frame whose exposure ends in the future: time_ns() and start_ns of its driver must"
                " be of one clock"
            )
        # To the nearest part of a step, so that a camera in step with the mirror is not now before it, now after it.
        parts = round(self._mirror.since_zero_ns(host_start_ns) * _OFFSETS / self._step_ns)
        first_step, part = divmod(parts, _OFFSETS)
        if first_step < self._first_step:  # what the camera had still kept from before
            return []
        frame_id, lost = 1, 0
        if self._last is not None:
            before_id, before_ns = self._last
            period_ns = timing.frame_period_steps * self._step_ns
            lost = max(round((raw.start_ns - before_ns) / period_ns) - 1, 0)
            frame_id = before_id + lost + 1
        self._last = frame_id, raw.start_ns
        frame = Frame(
            frame_id=frame_id,
            first_step=first_step,
            last_step=first_step + timing.exposure_steps - 1,
            pixels=pixels.astype(np.uint16),
            mask=np.ones(pixels.shape, dtype=np.bool_),
            chunks_lost=0,
            frames_lost_before=lost,
            device_start_ns=raw.start_ns,
            device_end_ns=raw.start_ns + raw.exposure_ns,
            host_first_byte_ns=now_ns,
            host_receive_ns=now_ns,
            exposure_offset_ns=part * self._step_ns // _OFFSETS,
        )
        return [frame] if raw.truth is None else [frame, truth_message(frame_id, raw.truth)]


class AdaptedMirror(_Adapted):
    """A mirror with a simple driver. It has no watchdog; each command is answered when it is sent."""

    in_flight = 0
    latched = False
    outage_s = 0.0

    def __init__(self, rig: Rig, driver: SimpleMirror, now_ns: Callable[[], int]) -> None:
        super().__init__("mirror", driver, now_ns)
        self._rig, self._driver = rig, driver
        self._step_ns = rig.timing.fast_step_ns
        self._margin = converter_margin(rig.mirror)
        self._block_ids = count(1)
        self._commanded: dict[int, tuple[int, NDArray[np.float64]]] = {}
        """Block and input of steps that have not been reported."""
        self._next: int | None = None
        """The first step that has not been reported, from the first command on."""
        self._parked_from: float = math.inf
        self._awaited = self._deadline_ns = 0
        self.last_sent_ns = 0

    def query_clock(self, now_ns: int) -> None:
        super().query_clock(now_ns)
        self.last_sent_ns = now_ns

    def since_zero_ns(self, host_ns: int) -> int:
        return self.clock.device_ns(host_ns)[0]

    def start_step(self, now_ns: int) -> int:
        return self.since_zero_ns(now_ns) // self._step_ns

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        mirror = self._rig.mirror
        check_command(first_step, u, mirror.input_min, mirror.input_max)
        block = pb.CommandBlock(
            block_id=next(self._block_ids), first_step=first_step, n_steps=len(u), u=u.ravel(),
            cause_frame_id=cause_frame_id,
        )  # fmt: skip
        ack = pb.CommandAck(block_id=block.block_id)
        try:
            with calling(self.name, "when it was sent a command"):
                ack.late_steps = min(max(int(self._driver.send(first_step, u)), 0), len(u))
        except DeviceError as error:
            ack.code, ack.text = pb.NOT_SUPPORTED, printable(str(error))
        else:
            ack.code = pb.TOO_LATE if ack.late_steps == len(u) else pb.OK
            rows = mirror.quantise(u)
            self._commanded.update((first_step + k, (block.block_id, rows[k])) for k in range(ack.late_steps, len(u)))
        self._next = first_step if self._next is None else self._next
        self.last_sent_ns = now_ns
        self._events.append(CommandAnswered(ack, block))
        return block

    def poll(self) -> list[Event]:
        """What has happened since the last call."""
        events = self._take_events()
        with calling(self.name, "when it was asked what it applied"):
            for first_step, u in self._driver.applied():
                events += self._take(first_step, np.asarray(u, dtype=np.float64))
        return events

    def _take(self, first_step: int, u: NDArray[np.float64]) -> list[Event]:
        """Each step from the first command to the parking once, in order."""
        if u.ndim != 2 or u.shape[1] != self._rig.n_inputs or not np.isfinite(u).all():
            raise DeviceError(
                f"the mirror gives an array of {u.shape} as what it applied, expected (steps, {self._rig.n_inputs}) of"
                " finite numbers"
            )
        end = min(first_step + len(u), self._parked_from)
        if self._next is None or end <= self._next:
            return []
        events = self._give_up(first_step)
        begin, end = self._next, int(end)
        self._next = end
        for (block_id, source), run in groupby(
            range(begin, end), lambda step: self._what_held(step, u[step - first_step])
        ):
            steps = [*run]
            events.append(
                pb.Applied(
                    block_id=block_id,
                    first_step=steps[0],
                    n_steps=len(steps),
                    u=u[steps[0] - first_step : steps[-1] + 1 - first_step].ravel(),
                    source=source,
                    device_ns=(steps[-1] + 1) * self._step_ns,
                )
            )
        for step in range(begin, end):
            self._commanded.pop(step, None)
        return events

    def _what_held(self, step: int, held: NDArray[np.float64]) -> tuple[int, pb.Applied.Source]:
        block_id, commanded = self._commanded.get(step, (0, held))
        if not block_id:
            return 0, pb.Applied.PARKED
        as_told = bool((np.abs(held - commanded) <= self._margin).all())
        return block_id, pb.Applied.COMMAND if as_told else pb.Applied.CLIPPED

    def _give_up(self, end: int) -> list[Event]:
        """``NOT_REPORTED`` for the steps before ``end`` that were not reported."""
        if self._next is None or end <= self._next:
            return []
        unknown = pb.Applied(first_step=self._next, n_steps=end - self._next, source=pb.Applied.NOT_REPORTED)
        self._next = end
        return [unknown]

    def await_reports(self, end_step: int, now_ns: int) -> list[Event]:
        self._awaited, self._deadline_ns = end_step, now_ns + _PATIENCE_NS
        return []

    def next_due_ns(self) -> int | None:
        return self._deadline_ns if self._next is not None and self._next < self._awaited else None

    def serve(self, now_ns: int) -> list[Event]:
        return self._give_up(self._awaited)

    def park(self) -> int:
        with calling(self.name, "when it was told to park"):
            step = int(self._driver.park())
        self._parked_from = step
        return step

    def rearm(self) -> int:
        raise DeviceError("the mirror has no watchdog that parks it")
