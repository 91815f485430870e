"""The adapter that makes a session's camera of a simple driver: it assigns the mirror's fast steps to its frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.devices.adapted import Adapted
from aolink.devices.arrival import Arrivals
from aolink.devices.cameras.pictures import check_timing
from aolink.devices.clock import ClockExchange
from aolink.devices.drivers import calling
from aolink.devices.interfaces import ClockSampled, Event, Lacks, Mirror
from aolink.devices.simple import ClockAnswer, SimpleCamera, SimpleFrame
from aolink.errors import AolinkError, DeviceError
from aolink.rig import Rig
from aolink.rig.device_tables import Delay
from aolink.wire.truth import truth_message

_OFFSETS = 16
"""An exposure's start is rounded to one part in this many of a fast step: estimators keep a model for each fraction
that occurs."""
_START_SIGMA = 3.0
"""A camera is started this many standard deviations of the clocks' comparison after the fast step begins."""
_FUTURE_NS = 1_000_000_000
"""The most by which a frame's end may be ahead of the host's clock, ns: more than any error of the clocks'
comparison."""


class AdaptedCamera(Adapted):
    """A camera with a simple driver, beside a mirror that counts the fast steps.

    Where its frames carry no number, the frames missing between two that are several periods apart are lost. Where they
    carry no time, the time of their arrival is used, less ``delay``, the time from the end of an exposure to its
    frame's arrival.

    Parameters
    ----------
    monotonic_ns:
        The clock of `SimpleFrame.arrived_ns`.
    """

    rig_digest = ""
    chunks_refused = 0

    def __init__(
        self, rig: Rig, driver: SimpleCamera, mirror: Mirror, delay: Delay, now_ns: Callable[[], int],
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        super().__init__("camera", driver, delay, now_ns)
        if rig.scene is not None:
            raise DeviceError("the rig file has a [scene], and the camera's driver no second picture: take it out")
        self._rig, self._driver, self._mirror, self._monotonic_ns = rig, driver, mirror, monotonic_ns
        self._step_ns = rig.timing.fast_step_ns
        if rig.sensor.row_time_s is not None:
            self.lacks = [each for each in self.lacks if each != Lacks.ROWS]
        self._rows_unknown = Lacks.ROWS in self.lacks and mirror.commanded  # only inputs have times of their own
        self._period_ns = rig.timing.frame_period_ns
        self._arrivals = Arrivals(self._period_ns)
        self._running = self._tells_time = False
        self._first_step = 0
        self._left = math.inf
        """How many frames the session still asks for; more may come until the camera has stopped."""
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

    def read_clock(self) -> int:
        device_ns = self._driver.time_ns()
        self._tells_time = device_ns is not None
        return self._monotonic_ns() if device_ns is None else int(device_ns)

    def start(self, first_step: int, exposures: int) -> bool:
        now_ns = self.now_ns()
        ahead_ns = first_step * self._step_ns - self._mirror.since_zero_ns(now_ns)
        if ahead_ns < 0:
            return False
        start_ns, sigma_ns = self.clock.device_ns(now_ns + ahead_ns)
        # An exposure that seems to begin before its session does not count, so the camera starts rather a little late
        # than too early.
        margin_ns = _START_SIGMA * math.hypot(sigma_ns, self._mirror.clock.device_ns(now_ns)[1])
        with calling(self.name, "when it was asked to start"):
            self._driver.start(start_ns + round(min(margin_ns, self._step_ns)), exposures)
        self._first_step, self._end_step, self._running = first_step, 0, True
        self._left = exposures or math.inf
        return True

    def stop(self) -> None:
        try:
            self.waiting = self.poll()  # with those that were waiting
        finally:
            self._running = False
            with calling(self.name, "when it was asked to stop"):
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
        """The events since the last call. An error that the driver raises comes after the frames before it."""
        if self._failed is not None:
            raise self._failed
        events = self.take_waiting()
        if hasattr(self._driver, "time_answers"):
            with calling(self.name, "when it was asked for the time"):
                events += self._sampled(self._driver.time_answers())
        if self._running:
            try:
                with calling(self.name, "when it was asked for its frames"):
                    for frame in self._driver.frames():
                        events += self._take(frame, self.now_ns())
            except AolinkError as error:
                if not events:
                    raise
                self._failed = error
        return events

    def _sampled(self, answers: Iterable[ClockAnswer]) -> list[Event]:
        """The clock's answers, converted to the host's clock, which is compared with `time.monotonic_ns` now."""
        before_ns, now_ns, after_ns = self._monotonic_ns(), self.now_ns(), self._monotonic_ns()
        exchanges = (
            ClockExchange(
                each.asked_ns + now_ns - after_ns, each.camera_ns, each.camera_ns, each.answered_ns + now_ns - before_ns
            )
            for each in answers
        )
        return [ClockSampled.add(self.clock, exchange) for exchange in exchanges]

    def _take(self, raw: SimpleFrame, now_ns: int) -> list[Event]:
        if not self._left:
            return []
        pixels = np.asarray(raw.pixels)
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
        sigma_ns = math.hypot(sigma_ns, jitter_ns, self._mirror.step_sigma_ns(host_start_ns))
        start, n_steps = self._place(self._mirror.since_zero_ns(host_start_ns), sigma_ns)
        first_step, part = divmod(start, _OFFSETS)
        if first_step < self._first_step:  # the camera had kept it from before the session
            self._last = None
            return []
        self._left -= 1
        self._end_step = first_step + n_steps
        frame = Frame(
            frame_id=frame_id, first_step=first_step, last_step=self._end_step - 1,
            pixels=pixels.astype(np.uint16, copy=False),
            mask=np.ones(pixels.shape, dtype=np.bool_) if raw.mask is None else raw.mask, chunks_lost=raw.chunks_lost,
            frames_lost_before=lost, device_start_ns=start_ns, device_end_ns=start_ns + raw.exposure_ns,
            host_first_byte_ns=now_ns, host_receive_ns=now_ns, alignment_sigma_ns=sigma_ns,
            exposure_offset_ns=part * self._step_ns // _OFFSETS,
            rows_unknown=self._rows_unknown,
        )  # fmt: skip
        if raw.truth is None or n_steps < self._rig.timing.exposure_steps:  # the truth covers all steps
            return [frame]
        return [frame, truth_message(frame_id, raw.truth)]

    def _place(self, since_zero_ns: int, sigma_ns: float) -> tuple[int, int]:
        """The start of an exposure, in parts of a fast step, and its number of steps.

        The start is rounded, so that a camera in step with the mirror is not now before a step, now after it. Exposures
        do not overlap: one that seems to, by the clocks' uncertainty and half a step at most, begins with the end of
        the one before. Where a camera exposes without a pause and is faster than the mirror, exposures overlap by more
        in the end: then one exposure has a step less, about the same middle.
        """
        start, n_steps = round(since_zero_ns * _OFFSETS / self._step_ns), self._rig.timing.exposure_steps
        overlap = self._end_step * _OFFSETS - start
        if 0 < overlap <= max(1, min(round(sigma_ns * _OFFSETS / self._step_ns), _OFFSETS // 2)):
            return start + overlap, n_steps
        if 0 < overlap <= _OFFSETS and n_steps > 1:
            return start + max(overlap, _OFFSETS // 2), n_steps - 1
        return start, n_steps

    def _check(self, raw: SimpleFrame, pixels: NDArray[np.uint16]) -> None:
        """Refuse a frame that the rig file's camera cannot have taken. Raises DeviceError."""
        sensor = self._rig.sensor
        if pixels.shape != sensor.shape or int(pixels.max()) >> sensor.bit_depth or int(pixels.min()) < 0:
            raise DeviceError(
                f"the camera gives {pixels.shape} pixels from {pixels.min()} to {pixels.max()}, the rig file says"
                f" {sensor.shape} (rows, columns) of {sensor.bit_depth} bits: correct [sensor] or the camera's settings"
            )
        check_timing(self._rig.timing, "the camera", raw.exposure_ns)

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
        """Start of a frame's exposure on the camera's clock, and its standard deviation without the clock's own part,
        ns."""
        if raw.start_ns is not None:
            return raw.start_ns, 0.0
        if self._tells_time:
            raise DeviceError(
                f"the driver of {self.description} gives a frame without start_ns although its time_ns() gives the"
                " camera's time: it must say when the exposure started, or give no time (None)"
            )
        # Ids begin anew with each frame from before the session: the camera's own count goes on.
        count = frame_id if raw.number is None else raw.number
        arrived_ns, sd_ns = self._arrivals.add(count, self._arrival_of(raw))
        return arrived_ns - self.delay_ns - raw.exposure_ns, math.hypot(sd_ns, self.delay_sd_ns)

    def _arrival_of(self, raw: SimpleFrame) -> int:
        return self._monotonic_ns() if raw.arrived_ns is None else raw.arrived_ns
