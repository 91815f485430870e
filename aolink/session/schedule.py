"""The fast steps of a session: its first and its last, and those in which the camera starts."""

from __future__ import annotations

from collections.abc import Callable

from aolink.devices.interfaces import Camera, Mirror, Time
from aolink.errors import DeviceError
from aolink.rig import Rig
from aolink.session.commanding import lead_steps
from aolink.timeouts import TIMEOUTS

_NOT_YET = 1 << 63
"""The first fast step of a session that has not begun."""


class Schedule:
    """Begins a session with its camera, and goes on with a camera that has returned."""

    def __init__(self, rig: Rig, time: Time, camera: Camera, mirror: Mirror) -> None:
        self._rig, self._time, self._camera, self._mirror = rig, time, camera, mirror
        self.first_step = _NOT_YET
        self.end_step: int | None = None
        """First fast step after the session; None if it goes on until it is stopped."""

    def begin(self, exposures: int) -> None:
        """Start the camera soon, for so many exposures (0: until it is stopped)."""
        timing = self._rig.timing
        self.first_step = self._start(self._soon, lambda first_step: exposures)
        if exposures:
            self.end_step = self.first_step + (exposures - 1) * timing.frame_period_steps + timing.exposure_steps
            self.end_step += self._rig.readout_steps

    def go_on(self, device_step: Callable[[], int]) -> int | None:
        """Start the camera again with its next exposure after a fast step; gives the step, None where no exposure is
        left."""
        timing, first, end = self._rig.timing, self.first_step, self.end_step
        period, delay_steps = timing.frame_period_steps, self._start_delay_steps

        def begin() -> int:
            return first + max(0, -(-(device_step() + delay_steps - first) // period)) * period

        def left(first_step: int) -> int:
            if end is None:
                return 0
            return max(0, (end - timing.exposure_steps - self._rig.readout_steps - first_step) // period + 1)

        return self._start(begin, left) if end is None or left(begin()) else None

    @property
    def _start_delay_steps(self) -> int:
        return round(TIMEOUTS.start_delay_s * 1e9) // self._rig.timing.fast_step_ns

    def _soon(self) -> int:
        """The first fast step of a session that is about to begin."""
        step = self._mirror.start_step(self._time.now_ns())
        return step if self._time.virtual else step + max(self._start_delay_steps, lead_steps(self._rig.mirror))

    def _start(self, begin: Callable[[], int], exposures: Callable[[int], int]) -> int:
        """Start the camera at the fast step ``begin()``, for ``exposures`` from that step on; gives the step."""
        for _ in range(TIMEOUTS.start_tries):
            first_step = begin()
            if self._camera.start(first_step, exposures(first_step)):
                return first_step
        raise DeviceError(
            f"the camera was asked {TIMEOUTS.start_tries} times to start {TIMEOUTS.start_delay_s:g} s later or more,"
            " each time it came too late: is the line or this machine so slow, do both devices count the same fast"
            " steps?"
        )
