"""The three timelines of every view: seconds since the first exposure began, fast step and frame number.

The devices count fast steps, so the time on their clock and the frame number follow from them exactly; messages with a
host time only (the log, a connection) are placed on the devices' clock by the exposures, which have both times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike

from aolink.errors import ViewerError
from aolink.exposure import Exposure
from aolink.numerics.arrays import IntArray
from aolink.rig import Rig

_KEPT = 1000
"""Exposures before the ones that are sent whose times are kept: a session may go on for days."""
FAST_STEP = "fast_step"
TIME = "time"
FRAME = "frame"


@dataclass(frozen=True, kw_only=True, eq=False)
class Timebase:
    """The relation of fast steps, device time, frames and host time in one session."""

    fast_step_ns: int
    frame_period_steps: int
    first_step: int
    """First fast step of the exposure from which time is counted."""
    frame_id: int
    """The frame of that exposure."""
    origin_ns: int
    """The start of that exposure on the device's clock, ns: the zero of the timeline of seconds."""
    device_ns: IntArray
    """Starts of the newest exposures on the device's clock, ns, (n,)."""
    host_ns: IntArray
    """The same starts on the host's clock, ns, (n,)."""

    @classmethod
    def of(cls, rig: Rig, exposures: Sequence[Exposure]) -> Timebase:
        """The timebase of a session, from its exposures in order. Raises `ViewerError` where there is none."""
        if not exposures:
            raise ViewerError(
                "there is no exposure in this recording, so nothing to view; `aolink info` says what it holds"
            )
        first = exposures[0]
        return cls(
            fast_step_ns=rig.timing.fast_step_ns, frame_period_steps=rig.timing.frame_period_steps,
            first_step=first.first_step, frame_id=first.frame_id, origin_ns=first.device_start_ns,
            device_ns=np.array([e.device_start_ns for e in exposures], dtype=np.int64),
            host_ns=np.array([e.host_start_ns for e in exposures], dtype=np.int64),
        )  # fmt: skip

    def followed_by(self, exposures: Sequence[Exposure]) -> Timebase:
        """The timebase with the times of later exposures added, without those of a past that no message belongs to."""
        device, host = ([getattr(e, name) for e in exposures] for name in ("device_start_ns", "host_start_ns"))
        return replace(
            self,
            device_ns=np.append(self.device_ns[-_KEPT:], device),
            host_ns=np.append(self.host_ns[-_KEPT:], host),
        )

    def device_of_step(self, steps: ArrayLike) -> IntArray:
        """Device time at which a fast step begins, ns."""
        device: IntArray = self.origin_ns + (np.asarray(steps, dtype=np.int64) - self.first_step) * self.fast_step_ns
        return device

    def frame_of_step(self, steps: ArrayLike) -> IntArray:
        """The newest frame whose exposure had begun at a fast step."""
        since: IntArray = (np.asarray(steps, dtype=np.int64) - self.first_step) // self.frame_period_steps
        return self.frame_id + since

    def device_of_host(self, host_ns: ArrayLike) -> IntArray:
        """Device time for a host time, ns: the difference of the clocks is interpolated, and held beyond the ends."""
        since = np.asarray(host_ns, dtype=np.int64) - self.host_ns[0]
        gained = (self.device_ns - self.device_ns[0]) - (self.host_ns - self.host_ns[0])
        ahead = np.interp(since.astype(np.float64), self.host_ns - self.host_ns[0], gained)
        device: IntArray = self.device_ns[0] + since + np.rint(ahead).astype(np.int64)
        return device

    def every_step(self, steps: ArrayLike) -> list[rr.TimeColumn]:
        """Columns for values at fast steps; they have no frame number, or a frame's 200 would share one place."""
        steps = np.asarray(steps, dtype=np.int64)
        return [rr.TimeColumn(FAST_STEP, sequence=steps), self._seconds(self.device_of_step(steps))]

    def at_steps(self, steps: ArrayLike, frames: ArrayLike | None = None) -> list[rr.TimeColumn]:
        """Columns on all three timelines for values that come once a frame."""
        frames = self.frame_of_step(steps) if frames is None else np.asarray(frames, dtype=np.int64)
        return [*self.every_step(steps), rr.TimeColumn(FRAME, sequence=frames)]

    def at_frames(self, frames: ArrayLike) -> list[rr.TimeColumn]:
        """Columns on all three timelines for values that belong to frames: at the start of their exposures."""
        return self.at_steps(self.step_of_frame(frames), frames)

    def at_starts(self, exposures: Sequence[Exposure]) -> list[rr.TimeColumn]:
        """Columns on all three timelines for one value of each exposure, at its start."""
        return self.at_steps([e.first_step for e in exposures], [e.frame_id for e in exposures])

    def at_ends(self, exposures: Sequence[Exposure]) -> list[rr.TimeColumn]:
        """The same at the exposures' ends."""
        return self.at_steps([e.first_step + e.n_steps for e in exposures], [e.frame_id for e in exposures])

    def step_of_frame(self, frames: ArrayLike) -> IntArray:
        """The fast step at which a frame's exposure begins."""
        since: IntArray = (np.asarray(frames, dtype=np.int64) - self.frame_id) * self.frame_period_steps
        return self.first_step + since

    def at_host(self, host_ns: ArrayLike) -> list[rr.TimeColumn]:
        """Columns on all three timelines for values that only have a host time."""
        device = self.device_of_host(host_ns)
        steps = self.first_step + (device - self.origin_ns) // self.fast_step_ns
        frames = rr.TimeColumn(FRAME, sequence=self.frame_of_step(steps))
        return [rr.TimeColumn(FAST_STEP, sequence=steps), self._seconds(device), frames]

    def _seconds(self, device_ns: IntArray) -> rr.TimeColumn:
        return rr.TimeColumn(TIME, duration=(device_ns - self.origin_ns).astype("timedelta64[ns]"))
