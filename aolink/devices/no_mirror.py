"""A session's mirror where there is none: a camera alone is recorded, and nothing is commanded."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.clock import ClockExchange, ClockRegression
from aolink.devices.interfaces import CommandAnswered, Event, Lacks
from aolink.errors import DeviceError
from aolink.rig import Rig
from aolink.wire import messages_pb2 as pb

_MOST_STEPS = 1000
"""Steps of one report."""


class NoMirror:
    """Counts fast steps by the host's clock, and reports for each that the rig's safe input was held.

    Parameters
    ----------
    since_zero_ns:
        Function that gives the time from the beginning of fast step 0 to a host time, ns, for a native camera, which
        counts the steps itself. By default the steps begin now.
    """

    name = "mirror"
    description = "none"
    commanded = False
    lacks: tuple[Lacks, ...] = ()
    in_flight = 0
    latched = False
    outage_s = 0.0

    def __init__(self, rig: Rig, now_ns: Callable[[], int], since_zero_ns: Callable[[int], int] | None = None) -> None:
        now = now_ns()
        self.clock = ClockRegression()
        self.clock.add(ClockExchange(now, now, now, now))
        self._rig, self._now_ns = rig, now_ns
        self._since_zero_ns = since_zero_ns or (lambda host_ns: host_ns - now)
        self._reported: int | None = None

    @property
    def last_sent_ns(self) -> int:
        return self._now_ns()

    def query_clock(self, now_ns: int) -> None:
        """Do nothing: there is no device whose clock could be queried."""

    def host_ns(self, device_ns: int, since_zero_ns: int, now_ns: int) -> tuple[int, float]:
        return device_ns, 0.0

    def statistics(self) -> dict[str, Any]:
        return {}

    def since_zero_ns(self, host_ns: int) -> int:
        return self._since_zero_ns(host_ns)

    def step_sigma_ns(self, host_ns: int) -> float:
        return 0.0  # an input that is always the same is the same at any time

    def start_step(self, now_ns: int) -> int:
        step = self.since_zero_ns(now_ns) // self._rig.timing.fast_step_ns
        self._reported = step if self._reported is None else self._reported
        return step

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        raise DeviceError("there is no mirror to send commands to: give --mirror PORT, or [devices.mirror]")

    def withdraw(self, step: int) -> int:
        return step

    def go_on_from(self, first_step: int, step: int) -> NDArray[np.float64]:
        return np.tile(self._rig.mirror.park, (step - first_step, 1))

    def next_due_ns(self) -> int | None:
        return None

    def serve(self, now_ns: int) -> list[Event]:
        return []

    def await_reports(self, end_step: int, now_ns: int) -> list[Event]:
        return self._passed(1)

    def park(self) -> int:
        return 0 if self._reported is None else self.since_zero_ns(self._now_ns()) // self._rig.timing.fast_step_ns

    def last_answers(self) -> list[CommandAnswered]:
        return []

    def rearm(self) -> int:
        raise DeviceError("there is no mirror to re-arm")

    def poll(self) -> list[Event]:
        """The fast steps that have passed, a tenth of a frame period at a time."""
        return self._passed(math.ceil(self._rig.timing.frame_period_steps / 10))

    def _passed(self, at_least: int) -> list[Event]:
        """The fast steps that have passed since the last call, if they are ``at_least`` this many."""
        if self._reported is None:  # nor is the camera's clock known
            return []
        step_ns, park = self._rig.timing.fast_step_ns, self._rig.mirror.park
        end = self.since_zero_ns(self._now_ns()) // step_ns
        if end - self._reported < at_least:
            return []
        first, self._reported = self._reported, end
        return [
            pb.Applied(
                first_step=k, n_steps=min(end - k, _MOST_STEPS), u=np.tile(park, min(end - k, _MOST_STEPS)),
                source=pb.Applied.PARKED, device_ns=self._now_ns(),
            )
            for k in range(first, end, _MOST_STEPS)
        ]  # fmt: skip
