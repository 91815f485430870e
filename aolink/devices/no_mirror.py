"""A session's mirror where there is none: a camera alone is recorded, and nothing is commanded."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.devices.adapted_mirror import AdaptedMirror
from aolink.devices.clock import ClockExchange
from aolink.devices.interfaces import Event
from aolink.errors import DeviceError
from aolink.rig import Rig
from aolink.rig.device_tables import Delay
from aolink.wire import messages_pb2 as pb

_MOST_STEPS = 1000
"""Steps of one report."""


class NoMirror(AdaptedMirror):
    """Counts fast steps by the host's clock, and reports for each that the rig's safe input was held.

    Parameters
    ----------
    since_zero_ns:
        Function that gives the time from the beginning of fast step 0 to a host time, ns, for a native camera, which
        counts the steps itself. By default the steps begin now.
    """

    commanded = False

    def __init__(self, rig: Rig, now_ns: Callable[[], int], since_zero_ns: Callable[[int], int] | None = None) -> None:
        nothing: Any = SimpleNamespace(description="none")
        super().__init__(rig, nothing, Delay(), now_ns)
        now = self.last_sent_ns = now_ns()
        self.clock.add(ClockExchange(now, now, now, now))
        self._since_zero_ns = since_zero_ns or (lambda host_ns: host_ns - now)
        self._reported: int | None = None

    def query_clock(self, now_ns: int) -> None:
        """There is no device whose clock could be queried."""
        self.last_sent_ns = now_ns

    def host_ns(self, device_ns: int, since_zero_ns: int, now_ns: int) -> tuple[int, float]:
        return device_ns, 0.0

    def since_zero_ns(self, host_ns: int) -> int:
        return self._since_zero_ns(host_ns)

    def step_sigma_ns(self, host_ns: int) -> float:
        return 0.0  # an input that is always the same is the same at any time

    def start_step(self, now_ns: int) -> int:
        step = super().start_step(now_ns)
        self._reported = step if self._reported is None else self._reported
        return step

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        raise DeviceError("there is no mirror to send commands to: give --mirror PORT, or [devices.mirror]")

    def await_reports(self, end_step: int, now_ns: int) -> list[Event]:
        return self._passed(1)

    def park(self) -> int:
        return 0 if self._reported is None else super().start_step(self.now_ns())

    def poll(self) -> list[Event]:
        """The fast steps that have passed, a tenth of a frame period at a time."""
        return self._passed(math.ceil(self._rig.timing.frame_period_steps / 10))

    def _passed(self, at_least: int) -> list[Event]:
        """The fast steps that have passed since the last call, if they are ``at_least`` this many."""
        now_ns = self.now_ns()
        if self._reported is None or (end := super().start_step(now_ns)) - self._reported < at_least:
            return []  # before it has begun, the camera's clock is not known either
        first, self._reported = self._reported, end
        runs = [(k, min(end - k, _MOST_STEPS)) for k in range(first, end, _MOST_STEPS)]
        parked, source = self._rig.mirror.park, pb.Applied.PARKED
        return [
            pb.Applied(first_step=k, n_steps=n, u=np.tile(parked, n), source=source, device_ns=now_ns) for k, n in runs
        ]
