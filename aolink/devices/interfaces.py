"""The interfaces of camera, mirror and time that a session uses, whatever the devices' protocol.

Devices never wait: a session takes the events that have come since its last poll, and decides when it polls again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.devices.clock import ClockExchange, ClockRegression, ClockStep
from aolink.wire import messages_pb2 as pb
from aolink.wire.port import Served


@dataclass(frozen=True, slots=True)
class ClockSampled:
    """A clock query was answered."""

    exchange: ClockExchange
    accepted: bool
    step: ClockStep | None = None
    """A step of the device's clock that this answer has confirmed."""

    @classmethod
    def add(cls, clock: ClockRegression, exchange: ClockExchange, *, usable: bool = True) -> ClockSampled:
        """Add the exchange to a regression if it is ``usable``."""
        before = clock.step
        accepted = usable and clock.add(exchange)
        return cls(exchange, accepted, clock.step if clock.step is not before else None)


@dataclass(frozen=True, slots=True)
class CommandAnswered:
    """A command block was acknowledged or refused (``ack.code``), or its answer is not waited for any more."""

    ack: pb.CommandAck | None
    """The final answer; None where none came."""
    block: pb.CommandBlock
    sent_ns: int
    """Host time at which the block was first sent."""
    tries: int = 1
    """How often it was sent."""
    times_full: int = 0
    """How often the mirror answered before that its queue was full."""


@dataclass(frozen=True, slots=True)
class Vanished:
    """The port of a device is gone, and may return: until then nothing is sent to the device, and nothing comes from
    it."""

    why: str


@dataclass(frozen=True, slots=True)
class Returned:
    """The same device is there again. It has stopped or parked, and its clock must be queried before it goes on."""

    away_s: float
    """Time from the loss of the port to the device's answer, s."""


Event = Frame | pb.Truth | pb.Applied | pb.Event | ClockSampled | CommandAnswered | Vanished | Returned
"""The events that a device may report. Texts in them can be printed."""


class Lacks(StrEnum):
    """Abilities that a device lacks. A driver lists them as ``lacks``; `aolink devices` shows them, and a recording
    keeps them."""

    TIME = "reports no time: the arrival times of its frames are used"
    COUNT = "does not count its frames: lost ones show by their time only"
    ROWS = "may expose its rows one after the other: sensor.row_time_s says how, 0 for all at once"
    TRIGGER = "has no trigger: its exposures begin anywhere in a fast step"
    QUEUE = "queues no inputs: the host sends each when its fast step begins"
    ANSWER = "acknowledges nothing: what was sent counts as taken"
    READ_BACK = "does not say what it holds: what was sent counts as held"
    WATCHDOG = "has no watchdog: while the host's program runs, the host parks it"


def lacks_of(driver: Any) -> list[Lacks]:
    """The abilities that a driver, or its class, lists as lacking; a direct mirror lacks a queue."""
    own = [Lacks(each) for each in getattr(driver, "lacks", ())]
    return list(dict.fromkeys([*own, Lacks.QUEUE] if hasattr(driver, "put") else own))


class Device(Protocol):
    """The common part of camera and mirror."""

    name: str
    """``camera`` or ``mirror``."""
    description: str
    """Model, serial number and firmware, for the recording."""
    clock: ClockRegression

    @property
    def lacks(self) -> Sequence[Lacks]:
        """The abilities that the device lacks, for the recording."""

    def query_clock(self, now_ns: int) -> None:
        """Ask the device for its time; the answer is an event."""

    def host_ns(self, device_ns: int, since_zero_ns: int, now_ns: int) -> tuple[int, float]:
        """Host time of a stamp that came by ``now_ns``, and its standard deviation, ns.

        ``since_zero_ns`` is the time from the beginning of fast step 0 to the stamp by the count of fast steps: for a
        device that counts them, it reveals a clock that was set.
        """

    def statistics(self) -> dict[str, Any]:
        """Counts of what was exchanged with the device, and of what was wrong with it, since the session began, each by
        its name; empty for a device that counts nothing. The recording has a field of the same name for each."""


class Camera(Device, Protocol):
    """Takes frames, each integrated over a run of fast steps."""

    rig_digest: str
    """Digest of the rig file that a simulated camera was made from; empty for others."""

    def start(self, first_step: int, exposures: int) -> bool:
        """Take ``exposures`` frames (0: until stopped), the first from ``first_step``; False if that step has passed.

        Raises DeviceError.
        """

    def stop(self) -> None:
        """Take no more frames. Raises DeviceError."""

    @property
    def chunks_refused(self) -> int:
        """Number of invalid chunks of frames."""

    def flush(self) -> list[Frame]:
        """Give the frames that are still incomplete, as they are."""


class Mirror(Device, Protocol):
    """Applies inputs at fast steps, which it counts.

    Each block that it is sent gets one `CommandAnswered`: as an event, or from `last_answers`.
    Its `Applied` events give the input that the mirror held in each fast step, exactly once from the first command on:
    a report, or ``NOT_REPORTED`` where there is none. ``AWAITED`` comes before either where a report is requested
    again.
    """

    @property
    def in_flight(self) -> int:
        """Number of blocks that were sent and are not yet answered."""

    commanded: bool
    """Whether there is a mirror: where there is none, nothing is commanded, and the rig's safe input counts as held."""

    @property
    def latched(self) -> bool:
        """Whether the watchdog has parked the mirror: it takes no command until `rearm`."""

    @property
    def outage_s(self) -> float:
        """How long a latched mirror had received no command when the session noticed the latch, s; 0 at the session's
        start."""

    @property
    def last_sent_ns(self) -> int:
        """Host time at which anything was last sent to the mirror: its watchdog runs from then."""

    def since_zero_ns(self, host_ns: int) -> int:
        """Time from the beginning of its fast step 0 to a host time, on the mirror's own clock, ns."""

    def step_sigma_ns(self, host_ns: int) -> float:
        """Standard deviation of `since_zero_ns`, as far as the inputs' times depend on it, ns."""

    def start_step(self, now_ns: int) -> int:
        """The fast step that the mirror is in, or, on virtual time, waits at. Raises DeviceError for an impossible
        one."""

    def send_block(self, first_step: int, u: NDArray[np.float64], cause_frame_id: int, now_ns: int) -> pb.CommandBlock:
        """Send inputs (n_steps, n_inputs) for the fast steps from ``first_step``; gives the block as sent.

        Raises DeviceError for an input beyond the limits: it is refused, never clamped. The exception: with a slew
        limit, a mirror that was parked, or whose steps were left out, goes from the input that it holds to ``u`` as
        fast as that allows, and the block that is returned has these inputs.
        """

    def go_on_from(self, first_step: int, step: int) -> NDArray[np.float64]:
        """Leave out the fast steps from ``first_step`` to the one before ``step``, which have gone by.

        Gives the inputs that the mirror holds in these steps, by the commands that it was sent, (step - first_step,
        n_inputs).
        """

    def withdraw(self, step: int) -> int:
        """Stop sending blocks again that have steps from ``step`` on: they are about to be replaced.

        Gives the first step from which inputs must be sent anew, because a block that begins there may not have come;
        ``step`` where all have.
        """

    def next_due_ns(self) -> int | None:
        """Host time at which the mirror is to be served next; None while it waits for nothing."""

    def serve(self, now_ns: int) -> list[Event]:
        """Do what is due: send blocks again that have timed out, request missing reports, and give up reports that
        never came.

        Raises DeviceError when a command has not been answered for twice the mirror's watchdog.
        """

    def await_reports(self, end_step: int, now_ns: int) -> list[Event]:
        """Wait for all reports before ``end_step`` that have not come, up to the time-outs that follow."""

    def park(self) -> int:
        """Put the mirror into its safe state and empty its queue; gives the first fast step that this holds for.

        Blocks without an answer are not sent again. It is asked until it confirms that it has parked. Raises
        DeviceError once nothing more is heard of it, and PortError where its port is gone.
        """

    def last_answers(self) -> list[CommandAnswered]:
        """At the session's end, the answers to blocks that have not been events; without one where none came."""

    def rearm(self) -> int:
        """Release the watchdog's latch; gives the first fast step that had not passed. Otherwise this works as
        `park`."""


class Happened(NamedTuple):
    """The events of a device that came at one time."""

    device: Device
    events: Sequence[Event]
    receive_ns: int
    """The time at which they came, on the host's clock."""


class Time(Protocol):
    """The time of a session: the host's clock, or, on virtual time, the clock that a simulated rig sends."""

    virtual: bool
    beside: Sequence[Served]
    """Objects that `events` also serves while it waits in real time, such as estimators' processes."""

    def now_ns(self) -> int:
        """Host time, ns since 1970."""

    def events(self, timeout_s: float) -> Iterator[Happened]:
        """The devices' events in order; in real time it waits up to ``timeout_s`` for the first.

        A message is handled only when the events before it have been taken. Raises PortError and DeviceError.
        """

    def elapse_until(self, host_ns: int) -> None:
        """On virtual time, advance the clock by a time-out in which nothing can come."""

    def hurry(self) -> None:
        """Wait from now on as if a stop had been asked for: the session ends with an error."""


class Opened(NamedTuple):
    """Both devices of a rig, identified, and the time that they keep."""

    time: Time
    camera: Camera
    mirror: Mirror
    warnings: list[str]
    """Warnings about what is doubtful."""
