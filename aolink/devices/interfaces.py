"""What a session asks of a camera and of a mirror, whatever protocol they speak.

Devices never wait: the session hands them what came over their line (`handle`) and they say what it
means, as events.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.wire import messages_pb2 as pb
from aolink.wire.clock import ClockExchange, ClockRegression, ClockStep, StepClock
from aolink.wire.link import Link, Received


@dataclass(frozen=True, slots=True)
class ClockSampled:
    """A clock query was answered."""

    exchange: ClockExchange
    accepted: bool
    step: ClockStep | None = None
    """The step of the device's clock that is certain with this answer."""


@dataclass(frozen=True, slots=True)
class CommandAnswered:
    """A command block was acknowledged or refused (``ack.code``)."""

    ack: pb.CommandAck
    block: pb.CommandBlock


Event = Frame | pb.Truth | pb.Applied | pb.Event | ClockSampled | CommandAnswered
"""What a device may report."""


class Device(Protocol):
    """What camera and mirror have in common."""

    link: Link
    identity: pb.Identity
    clock: ClockRegression
    steps: StepClock
    """The same clock beside the device's count of fast steps: for times of what carries both."""

    def handle(self, received: Received) -> list[Event]:
        """What a message from the device means."""

    def query_clock(self, now_ns: int) -> None:
        """Ask the device for its time."""


class Camera(Device, Protocol):
    """Takes frames, each integrated over a run of fast steps."""

    def start(self, first_step: int, exposures: int) -> bool:
        """Take ``exposures`` frames (0: until stopped), the first from ``first_step``; False if that has gone by.

        Raises DeviceError.
        """

    def stop(self) -> None:
        """Take no more frames. Raises DeviceError."""

    @property
    def chunks_refused(self) -> int:
        """Chunks that made no sense."""

    def flush(self) -> list[Frame]:
        """The frames that are still incomplete, as they are."""


class Mirror(Device, Protocol):
    """Applies inputs at fast steps.

    Its `handle` gives what the mirror held as `Applied`, each fast step exactly once from the first command on: as a
    report, or as ``NOT_REPORTED`` where none is to be had. ``AWAITED`` comes before either where it is asked for again.
    """

    @property
    def in_flight(self) -> int:
        """Blocks sent and not yet answered."""

    @property
    def reports_asked(self) -> int:
        """How often missing reports were asked for again."""

    retransmits: int
    """Blocks sent again."""
    queue_end_step: int
    """First fast step that nothing is queued for on the device, as last heard."""
    round_trip_s: float
    """Of commands, smoothed; NaN before the first."""
    latched: bool
    """Whether the watchdog has parked the mirror: it takes no command until `rearm`."""
    outage_s: float
    """For how long the mirror had taken no command when it said that it is latched, s; 0 at the start of a session."""

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        """Send inputs (n_steps, n_inputs) for the fast steps from ``first_step``; gives the block as sent.

        Raises DeviceError for an input beyond the limits: it is refused, never clamped.
        """

    def next_timeout_ns(self) -> int | None:
        """When `retransmit` has something to do, host clock; None if nothing is waited for."""

    def retransmit(self, now_ns: int) -> list[Event]:
        """Send again what has timed out, ask for missing reports; gives ``NOT_REPORTED`` for those that are given up.

        Raises DeviceError when a command has not been answered for twice the mirror's watchdog.
        """

    def await_reports(self, end_step: int, now_ns: int) -> list[Event]:
        """Ask for all reports before ``end_step`` that have not come, as `handle` does where it sees a gap."""

    def check_step(self, step: int, now_ns: int) -> None:
        """Refuse a fast step that the mirror cannot be in at a host time. Raises DeviceError."""

    def park(self) -> int:
        """Put the mirror into its safe state and empty its queue; gives the first fast step that this holds for.

        Blocks that are not answered are given up. Raises DeviceError if the mirror does not answer.
        """

    def rearm(self) -> int:
        """End the latch of the watchdog; gives the first fast step that had not gone by. Otherwise as `park`."""
