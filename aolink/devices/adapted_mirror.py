"""The adapter that makes a session's mirror of a simple driver.

It gives each command its answer and its report, and parks a mirror that the session has not polled for too long.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count, groupby

import numpy as np
from numpy.typing import NDArray

from aolink.devices.adapted import Adapted
from aolink.devices.drivers import calling
from aolink.devices.gate import converter_margin, printable
from aolink.devices.interfaces import CommandAnswered, Event
from aolink.devices.limits import CommandLimits
from aolink.devices.simple import Held, SimpleMirror
from aolink.errors import AolinkError, DeviceError
from aolink.rig import Rig
from aolink.rig.device_tables import Delay
from aolink.timeouts import TIMEOUTS
from aolink.wire import messages_pb2 as pb


class AdaptedMirror(Adapted):
    """A mirror with a simple driver; each command is answered when it is sent.

    Its watchdog is a thread of the host: where the session has not polled the mirror for ``mirror.watchdog_s``, it
    parks the mirror, which takes no command until `rearm`. ``delay`` is the time from the beginning of a fast step, by
    the driver's clock, until the mirror follows its input.
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
        """The time of the last poll before the watchdog parked the mirror; None while it is not latched."""
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

    def read_clock(self) -> int:
        with self._call("when it was asked for the time"):
            return int(self._driver.time_ns())

    def query_clock(self, now_ns: int) -> None:
        super().query_clock(now_ns)
        self.last_sent_ns = now_ns

    def since_zero_ns(self, host_ns: int) -> int:
        return self.clock.device_ns(host_ns)[0] - self.delay_ns

    def step_sigma_ns(self, host_ns: int) -> float:
        lateness_ns = 0.0
        if not self.delay_ns:  # otherwise the rig file says how late inputs are
            with self._call("when it was asked for its timing"):
                lateness_ns = float(getattr(self._driver, "timing_sigma_ns", 0.0))
        return math.hypot(self.clock.device_ns(host_ns)[1], self.delay_sd_ns, lateness_ns)

    def start_step(self, now_ns: int) -> int:
        return self.since_zero_ns(now_ns) // self._step_ns

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        u = self._limits.take(first_step, u)
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
        self.waiting.append(CommandAnswered(ack, block, now_ns))
        return block

    def withdraw(self, step: int) -> int:
        return step  # each block is taken or refused when it is sent

    def go_on_from(self, first_step: int, step: int) -> NDArray[np.float64]:
        return self._limits.go_on_from(first_step, step)

    def poll(self) -> list[Event]:
        """The events since the last call."""
        events = self.take_waiting()
        with self._call("when it was asked what it applied"):
            self._polled_ns = time.monotonic_ns()
            for held in self._driver.applied():
                events += self._take(Held(*held))
        return events

    def _take(self, held: Held) -> list[Event]:
        """Report each step from the first command to the parking once, in order."""
        first_step, u = held.first_step, np.asarray(held.u, dtype=np.float64)
        late = np.zeros(len(u), dtype=np.bool_) if held.late is None else held.late
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
        self._next, self._deadline_ns = end, self.now_ns() + round(TIMEOUTS.report_s * 1e9)
        for (block_id, source), run in groupby(
            range(begin, end), lambda step: self._what_held(step, u[step - first_step], bool(late[step - first_step]))
        ):
            steps = [*run]
            events.append(
                pb.Applied(
                    block_id=block_id, first_step=steps[0], n_steps=len(steps),
                    u=u[steps[0] - first_step : steps[-1] + 1 - first_step].ravel(), source=source,
                    device_ns=(steps[-1] + 1) * self._step_ns,
                )
            )  # fmt: skip
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
        as_commanded = bool((np.abs(held - commanded) <= self._margin).all())
        return block_id, pb.Applied.COMMAND if as_commanded else pb.Applied.CLIPPED

    def _give_up(self, end: int) -> list[Event]:
        """Report the steps before ``end`` that were not reported as ``NOT_REPORTED``."""
        if self._next is None or end <= self._next:
            return []
        unknown = pb.Applied(first_step=self._next, n_steps=end - self._next, source=pb.Applied.NOT_REPORTED)
        for step in range(self._next, end):
            self._commanded.pop(step, None)
        self._next = end
        return [unknown]

    def await_reports(self, end_step: int, now_ns: int) -> list[Event]:
        if self._next is not None and end_step > self._awaited:
            if self._next >= self._awaited:  # until now nothing was awaited
                self._deadline_ns = now_ns + round(TIMEOUTS.report_s * 1e9)
            self._awaited = end_step
        return []

    def next_due_ns(self) -> int | None:
        return self._deadline_ns if self._next is not None and self._next < self._awaited else None

    def serve(self, now_ns: int) -> list[Event]:
        return self._give_up(self._awaited)

    def park(self) -> int:
        self._guarding = False
        with self._call("when it was asked to park"):
            step = int(self._driver.park())
        self._parked_from = step
        return step

    def last_answers(self) -> list[CommandAnswered]:
        return [event for event in self.take_waiting() if isinstance(event, CommandAnswered)]

    def rearm(self) -> int:
        with self._call("when it was asked for the time"):
            step = int(self._driver.time_ns()) // self._step_ns + 1
        self._safe, self._left_ns = (self._safe[0], step), None
        self._limits.parked()
        return step

    def close(self) -> None:
        """Give the device back, parked."""
        self._guarding = False
        self._closed.set()
        if self._next is not None and self._parked_from == math.inf:  # parking it failed, or was interrupted
            with suppress(AolinkError), self._call("when it was asked to park"):
                self._driver.park()
        with self._call("when it was closed"):
            self._driver.close()

    @contextmanager
    def _call(self, when: str) -> Iterator[None]:
        """Call the driver: never from two threads at once, and with its exceptions as DeviceErrors."""
        with self._lock, calling(self.name, when):
            yield

    def _guard(self) -> None:
        """Run the watchdog from the first command on, until the mirror is parked."""
        if not self._guarding:
            self._guarding = True
            threading.Thread(target=self._watch, name="aolink-watchdog", daemon=True).start()

    def _watch(self) -> None:
        while self._guarding and not self._closed.wait(self._watchdog_ns / 4e9):
            if time.monotonic_ns() - self._polled_ns <= self._watchdog_ns or self.latched:
                continue
            with suppress(AolinkError), self._call("when its watchdog parked it"):
                # The session may have held the driver's lock until now, to poll, park or close it.
                left_ns = self._polled_ns
                if self._guarding and time.monotonic_ns() - left_ns > self._watchdog_ns:
                    step = int(self._driver.park())
                    self._left_ns = left_ns
                    self._safe = step, math.inf
