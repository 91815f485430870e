"""Adapters that make a session's devices of simple drivers.

They assign fast steps to a driver's frames and samples, compare its clock with the host's, give each command its answer
and its report, and park a mirror that the session has left alone for too long.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import count, groupby

import numpy as np
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.devices.arrival import Arrivals
from aolink.devices.clock import ClockExchange, ClockRegression
from aolink.devices.drivers import calling
from aolink.devices.gate import CommandLimits, converter_margin, printable
from aolink.devices.interfaces import ClockSampled, CommandAnswered, Event, Lacks, Mirror, lacks_of
from aolink.devices.simple import ClockAnswer, Held, SimpleCamera, SimpleFrame, SimpleMirror
from aolink.errors import AolinkError, DeviceError
from aolink.rig import Rig
from aolink.rig.device_tables import Delay
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


class _Adapted:
    """The common part of both adapters: a clock that is read at once, and events that wait to be taken."""

    def __init__(self, name: str, driver: SimpleCamera | SimpleMirror, delay: Delay, now_ns: Callable[[], int]) -> None:
        self.name = name
        self.description = printable(driver.description)
        self.lacks = lacks_of(driver)
        self.clock = ClockRegression()
        self._now_ns, self._delay_ns, self._delay_sd_ns = now_ns, round(delay.mean_s * 1e9), delay.sd_s * 1e9
        self._events: list[Event] = []

    def _read_clock(self) -> int:
        """The device's clock, ns."""
        raise NotImplementedError

    def _clock_doubt_ns(self) -> int:
        """By how much the driver may correct the clock that it reads, ns."""
        return 0

    def query_clock(self, now_ns: int) -> None:
        doubt_ns, sent_ns = self._clock_doubt_ns(), self._now_ns()
        with calling(self.name, "when it was asked for the time"):
            device_ns = self._read_clock()
        exchange = ClockExchange(sent_ns - doubt_ns, device_ns, device_ns, self._now_ns() + doubt_ns)
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

    Where its frames carry no number, those between two frames that are several periods apart are lost. Where they carry
    no time, their arrival stands for it, less ``delay``, the time from the end of an exposure to its frame's arrival.

    Parameters
    ----------
    monotonic_ns:
        The clock of `SimpleFrame.arrived_ns`.
    """

    rig_digest = ""
    chunks_refused = 0

    def __init__(
        self,
        rig: Rig,
        driver: SimpleCamera,
        mirror: Mirror,
        delay: Delay,
        now_ns: Callable[[], int],
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__("camera", driver, delay, now_ns)
        if rig.scene is not None:
            raise DeviceError("the rig file has a [scene], and the camera's driver no second picture: take it out")
        self._rig, self._driver, self._mirror, self._monotonic_ns = rig, driver, mirror, monotonic_ns
        self._step_ns = rig.timing.fast_step_ns
        self._period_ns = rig.timing.frame_period_steps * self._step_ns
        self._arrivals = Arrivals(self._period_ns)
        self._running = self._tells_time = False
        self._first_step = 0
        self._last: tuple[int, int] | None = None
        """The id of the frame before, and its start on the camera's clock."""
        self._end_step = 0
        """The first step after the exposure before."""
        self._first_number = 0
        self._failed: AolinkError | None = None

    def query_clock(self, now_ns: int) -> None:
        with calling(self.name, "when it was asked for the time"):
            self._tells_time = hasattr(self._driver, "ask_time") and self._driver.ask_time()
        if not self._tells_time:
            super().query_clock(now_ns)

    def _read_clock(self) -> int:
        device_ns = self._driver.time_ns()
        self._tells_time = device_ns is not None
        return self._monotonic_ns() if device_ns is None else int(device_ns)

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
        self._first_step, self._end_step, self._running = first_step, 0, True
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

    def statistics(self) -> dict[str, int]:
        if not hasattr(self._driver, "statistics"):
            return {}
        with calling(self.name, "when it was asked for its counts"):
            return dict(self._driver.statistics())

    def close(self) -> None:
        """Give the device back."""
        with calling(self.name, "when it was closed"):
            self._driver.close()

    def poll(self) -> list[Event]:
        """What has happened since the last call. What the driver raises comes after the frames before it."""
        if self._failed is not None:
            raise self._failed
        events = self._take_events()
        if hasattr(self._driver, "time_answers"):
            with calling(self.name, "when it was asked for the time"):
                events += self._sampled(self._driver.time_answers())
        if self._running:
            try:
                with calling(self.name, "when it was asked for its frames"):
                    for frame in self._driver.frames():
                        events += self._take(frame, self._now_ns())
            except AolinkError as error:
                if not events:
                    raise
                self._failed = error
        return events

    def _sampled(self, answers: Iterable[ClockAnswer]) -> list[Event]:
        to_host_ns = self._now_ns() - self._monotonic_ns()
        return [
            ClockSampled.add(
                self.clock,
                ClockExchange(
                    each.asked_ns + to_host_ns, each.camera_ns, each.camera_ns, each.answered_ns + to_host_ns
                ),
            )
            for each in answers
        ]

    def _take(self, raw: SimpleFrame, now_ns: int) -> list[Event]:
        timing, pixels = self._rig.timing, np.asarray(raw.pixels)
        self._check(raw, pixels)
        frame_id = self._frame_id(raw)
        start_ns, jitter_ns = self._start_of(raw, frame_id)
        host_start_ns, sigma_ns = self.clock.host_ns(start_ns)
        if host_start_ns + raw.exposure_ns > now_ns + _FUTURE_NS:
            raise DeviceError(
                "the camera gives a frame whose exposure ends in the future: time_ns() and start_ns of its driver must"
                " be of one clock"
            )
        lost = frame_id - self._last[0] - 1 if self._last else 0
        self._last = frame_id, start_ns
        # To the nearest part of a step, so that a camera in step with the mirror is not now before it, now after it.
        parts = round(self._mirror.since_zero_ns(host_start_ns) * _OFFSETS / self._step_ns)
        if parts == self._end_step * _OFFSETS - 1:  # exposures do not overlap: that is the clocks' error
            parts += 1
        first_step, part = divmod(parts, _OFFSETS)
        if first_step < self._first_step:  # what the camera had still kept from before
            self._last = None
            return []
        self._end_step = first_step + timing.exposure_steps
        own_sigma_ns = math.hypot(sigma_ns, jitter_ns)
        frame = Frame(
            frame_id=frame_id,
            first_step=first_step,
            last_step=self._end_step - 1,
            pixels=pixels.astype(np.uint16, copy=False),
            mask=np.ones(pixels.shape, dtype=np.bool_) if raw.mask is None else raw.mask,
            chunks_lost=raw.chunks_lost,
            frames_lost_before=lost,
            device_start_ns=start_ns,
            device_end_ns=start_ns + raw.exposure_ns,
            host_first_byte_ns=now_ns,
            host_receive_ns=now_ns,
            alignment_sigma_ns=math.hypot(own_sigma_ns, self._mirror.step_sigma_ns(host_start_ns)),
            exposure_offset_ns=part * self._step_ns // _OFFSETS,
        )
        return [frame] if raw.truth is None else [frame, truth_message(frame_id, raw.truth)]

    def _check(self, raw: SimpleFrame, pixels: NDArray[np.uint16]) -> None:
        """Refuse a frame that is not one of the rig file's camera. Raises DeviceError."""
        sensor = self._rig.sensor
        if pixels.shape != sensor.shape or int(pixels.max()) >> sensor.bit_depth or int(pixels.min()) < 0:
            raise DeviceError(
                f"the camera gives {pixels.shape} pixels from {pixels.min()} to {pixels.max()}, the rig file says"
                f" {sensor.shape} (rows, columns) of {sensor.bit_depth} bits: correct [sensor] or the camera's settings"
            )
        expected_ns = self._rig.timing.exposure_steps * self._step_ns
        if abs(raw.exposure_ns - expected_ns) > self._step_ns / 2:
            raise DeviceError(
                f"the camera exposes for {raw.exposure_ns / 1e9:g} s, the rig file says {expected_ns / 1e9:g} s:"
                " correct timing.exposure_steps or the camera's settings"
            )

    def _frame_id(self, raw: SimpleFrame) -> int:
        """The count of a frame from the first of the session on. Raises DeviceError where the camera repeats one."""
        if raw.number is None:
            if raw.start_ns is None:
                return self._arrivals.count_at(self._arrival_of(raw))
            if self._last is None:
                return 1
            before_id, before_ns = self._last
            return before_id + max(round((raw.start_ns - before_ns) / self._period_ns), 1)
        if self._last is None:
            self._first_number = raw.number - 1
        frame_id = raw.number - self._first_number
        if self._last is not None and frame_id <= self._last[0]:
            raise DeviceError(
                f"the camera numbers a frame {raw.number} after number {self._last[0] + self._first_number}: it was"
                " started anew, or its driver gives a frame twice"
            )
        return frame_id

    def _start_of(self, raw: SimpleFrame, frame_id: int) -> tuple[int, float]:
        """Start of a frame's exposure on the camera's clock, and its standard deviation without the clock's, ns."""
        if raw.start_ns is not None:
            return raw.start_ns, 0.0
        if self._tells_time:
            raise DeviceError(
                f"the driver of {self.description} gives a frame without start_ns although its time_ns() tells the"
                " camera's time: it must say when the exposure started, or tell no time (None)"
            )
        # Ids begin anew with each frame from before the session: the camera's own count goes on.
        count = frame_id if raw.number is None else raw.number
        arrived_ns, sd_ns = self._arrivals.add(count, self._arrival_of(raw))
        return arrived_ns - self._delay_ns - raw.exposure_ns, math.hypot(sd_ns, self._delay_sd_ns)

    def _arrival_of(self, raw: SimpleFrame) -> int:
        return self._monotonic_ns() if raw.arrived_ns is None else raw.arrived_ns


class AdaptedMirror(_Adapted):
    """A mirror with a simple driver; each command is answered when it is sent.

    Its watchdog is a thread of the host: where the session has not polled the mirror for ``mirror.watchdog_s``, it
    parks the mirror, which takes no command until `rearm`. ``delay`` is the time from a fast step of the driver's clock
    to the mirror's following its input.
    """

    commanded = True
    in_flight = 0

    def __init__(self, rig: Rig, driver: SimpleMirror, delay: Delay, now_ns: Callable[[], int]) -> None:
        super().__init__("mirror", driver, delay, now_ns)
        self._rig, self._driver, self._limits = rig, driver, CommandLimits(rig)
        self._lock = threading.Lock()
        """Held while the driver is called."""
        self._watchdog_ns = round(rig.mirror.watchdog_s * 1e9)
        self._polled_ns = time.monotonic_ns()
        self._left_ns: int | None = None
        """When it was polled last before the watchdog parked it; None while it is not latched."""
        self._safe: tuple[float, float] = (math.inf, math.inf)
        """First fast step of the safe state that the watchdog asked for, and the step at which it was re-armed."""
        self._closed, self._guarding = threading.Event(), False
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

    @property
    def latched(self) -> bool:
        return self._safe[0] < math.inf == self._safe[1]

    @property
    def outage_s(self) -> float:
        return 0.0 if self._left_ns is None else (time.monotonic_ns() - self._left_ns) / 1e9

    def _read_clock(self) -> int:
        with self._call("when it was asked for the time"):
            return int(self._driver.time_ns())

    def query_clock(self, now_ns: int) -> None:
        super().query_clock(now_ns)
        self.last_sent_ns = now_ns

    def _clock_doubt_ns(self) -> int:
        # A driver that infers its device's clock corrects it by as much. Without a queue the clock is the host's.
        return 0 if Lacks.QUEUE in self.lacks else round(self._driver_sigma_ns())

    def since_zero_ns(self, host_ns: int) -> int:
        return self.clock.device_ns(host_ns)[0] - self._delay_ns

    def step_sigma_ns(self, host_ns: int) -> float:
        clock_ns, driver_ns = self.clock.device_ns(host_ns)[1], self._driver_sigma_ns()
        if Lacks.QUEUE in self.lacks:
            return math.hypot(clock_ns, self._delay_sd_ns, driver_ns)
        return math.hypot(max(clock_ns, driver_ns), self._delay_sd_ns)  # the clock's has part of the driver's

    def _driver_sigma_ns(self) -> float:
        """What the driver knows of its own inexactness.

        Of a mirror without a queue that is how late its inputs are, which the rig file may say instead.
        """
        if self._delay_ns and Lacks.QUEUE in self.lacks:
            return 0.0
        with self._call("when it was asked for its timing"):
            return float(getattr(self._driver, "timing_sigma_ns", 0.0))

    def start_step(self, now_ns: int) -> int:
        return self.since_zero_ns(now_ns) // self._step_ns

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        self._limits.check(first_step, u)
        block = pb.CommandBlock(
            block_id=next(self._block_ids), first_step=first_step, n_steps=len(u), u=u.ravel(),
            cause_frame_id=cause_frame_id,
        )  # fmt: skip
        ack = pb.CommandAck(block_id=block.block_id)
        try:
            with self._call("when it was sent a command"):
                if not self.latched:
                    ack.late_steps = min(max(int(self._driver.send(first_step, u)), 0), len(u))
        except DeviceError as error:
            ack.code, ack.text = pb.NOT_SUPPORTED, printable(str(error))
        else:
            ack.code = pb.LATCHED if self.latched else pb.TOO_LATE if ack.late_steps == len(u) else pb.OK
        if ack.code == pb.OK:
            self._guard()
            rows = self._rig.mirror.quantise(u)
            self._commanded.update((first_step + k, (block.block_id, rows[k])) for k in range(ack.late_steps, len(u)))
        self._next = first_step if self._next is None else self._next
        self.last_sent_ns = now_ns
        self._events.append(CommandAnswered(ack, block))
        return block

    def poll(self) -> list[Event]:
        """What has happened since the last call."""
        events = self._take_events()
        with self._call("when it was asked what it applied"):
            self._polled_ns = time.monotonic_ns()
            for first_step, u, *rest in self._driver.applied():
                u = np.asarray(u, dtype=np.float64)
                late = rest[0] if rest and rest[0] is not None else np.zeros(len(u), dtype=np.bool_)
                events += self._take(Held(first_step, u, late))
        return events

    def _take(self, held: Held) -> list[Event]:
        """Each step from the first command to the parking once, in order."""
        first_step, u, late = held
        assert late is not None
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
            range(begin, end), lambda step: self._what_held(step, u[step - first_step], bool(late[step - first_step]))
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

    def _what_held(self, step: int, held: NDArray[np.float64], late: bool) -> tuple[int, pb.Applied.Source]:
        block_id, commanded = self._commanded.get(step, (0, held))
        if self._safe[0] <= step < self._safe[1]:
            return 0, pb.Applied.WATCHDOG
        if not block_id:
            return 0, pb.Applied.PARKED
        if late:
            return block_id, pb.Applied.LATE
        as_told = bool((np.abs(held - commanded) <= self._margin).all())
        return block_id, pb.Applied.COMMAND if as_told else pb.Applied.CLIPPED

    def _give_up(self, end: int) -> list[Event]:
        """``NOT_REPORTED`` for the steps before ``end`` that were not reported."""
        if self._next is None or end <= self._next:
            return []
        unknown = pb.Applied(first_step=self._next, n_steps=end - self._next, source=pb.Applied.NOT_REPORTED)
        for step in range(self._next, end):
            self._commanded.pop(step, None)
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
        self._guarding = False
        with self._call("when it was told to park"):
            step = int(self._driver.park())
        self._parked_from = step
        return step

    def rearm(self) -> int:
        with self._call("when it was asked for the time"):
            step = int(self._driver.time_ns()) // self._step_ns + 1
        self._safe, self._left_ns = (self._safe[0], step), None
        return step

    def close(self) -> None:
        """Give the device back, parked."""
        self._guarding = False
        self._closed.set()
        if self._next is not None and self._parked_from == math.inf:  # parking it failed, or was interrupted
            with suppress(AolinkError), self._call("when it was told to park"):
                self._driver.park()
        with self._call("when it was closed"):
            self._driver.close()

    @contextmanager
    def _call(self, when: str) -> Iterator[None]:
        """Call the driver: never from two threads at once, and with its exceptions as DeviceErrors."""
        with self._lock, calling(self.name, when):
            yield

    def _guard(self) -> None:
        """Have the watchdog watch from the first command on, until the mirror is parked."""
        if not self._guarding:
            self._guarding = True
            threading.Thread(target=self._watch, name="aolink-watchdog", daemon=True).start()

    def _watch(self) -> None:
        while self._guarding and not self._closed.wait(self._watchdog_ns / 4e9):
            if time.monotonic_ns() - self._polled_ns <= self._watchdog_ns or self.latched:
                continue
            with suppress(AolinkError), self._call("when its watchdog parked it"):
                # The session may have had the driver until now: have polled, parked or closed it.
                left_ns = self._polled_ns
                if self._guarding and time.monotonic_ns() - left_ns > self._watchdog_ns:
                    step = int(self._driver.park())
                    self._left_ns = left_ns
                    self._safe = step, math.inf
