"""Protocols for drivers of cameras and mirrors that do not speak aolink's packets.

A simple driver knows its device and nothing of a session. It never waits: the session's thread polls it every few
milliseconds. `aolink.devices.adapted_camera` and `adapted_mirror` make a session's devices of such drivers,
`ThreadCamera` makes a camera of a loop that may wait, and `aolink.devices.paced` a mirror with a queue of one without.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from aolink.devices.interfaces import Lacks as Lacks
from aolink.errors import RigError
from aolink.exposure import Truth

_MOST_WAITING = 64
"""The most frames that wait to be taken: where there are more, the oldest are dropped, and count as lost."""
_JOIN_S = 2.0
"""How long closing a camera waits for its thread, which may be waiting for a frame."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SimpleFrame:
    """A frame as a simple driver gives it."""

    pixels: NDArray[np.uint16]
    """Counts, (rows, columns) as the rig file's sensor has them. It is not copied: the driver must not write to it."""
    exposure_ns: int
    """Length of the exposure, ns."""
    start_ns: int | None = None
    """Start of the exposure on the camera's own clock; None where it reports no time."""
    arrived_ns: int | None = None
    """`time.monotonic_ns` when the frame arrived, for a camera that reports no time; None for the time at which the
    frame is taken."""
    number: int | None = None
    """The camera's own count of its frames, without wrapping; a gap is a lost frame. None where it does not count."""
    mask: NDArray[np.bool_] | None = None
    """True where the pixel arrived, (rows, columns); None for all."""
    chunks_lost: int = 0
    """Packets of the frame that never arrived."""
    truth: Truth | None = None
    """The true states and path, where the driver simulates a camera."""


class Trigger(NamedTuple):
    """What starts each exposure of a camera: the key ``trigger`` of ``[devices.camera]``."""

    kind: str
    """``free-running``: the camera itself; ``software``: a command of the host; ``hardware``: an edge at an input."""
    input: str = ""
    """Name of the camera's input, where a driver sets it."""

    @classmethod
    def of(cls, value: Any, forms: tuple[str, ...]) -> Trigger:
        """The trigger of a rig file, which has one of ``forms``, such as ``hardware:INPUT``. Raises RigError."""
        kind, colon, name = value.partition(":") if isinstance(value, str) else ("", "", "")
        if (f"{kind}:INPUT" if colon and name else value) not in forms:
            expected = " or ".join(repr(each) for each in forms)
            raise RigError(f"devices.camera.trigger: expected {expected} with this driver, found {value!r}")
        return cls(kind, name)

    def lacks(self, others: tuple[Lacks, ...]) -> tuple[Lacks, ...]:
        """What a camera lacks with this trigger, of what it lacks when it runs freely."""
        return tuple(each for each in others if each != Lacks.TRIGGER or self == FREE_RUNNING)


FREE_RUNNING = Trigger("free-running")


class ClockAnswer(NamedTuple):
    """A reading of a camera's clock between two times of `time.monotonic_ns`, all in ns."""

    asked_ns: int
    camera_ns: int
    answered_ns: int


class SimpleCamera(Protocol):
    """A camera. The entry point is called with the rig and, by keyword, the driver's own keys of the rig file.

    It raises `aolink.errors.DeviceError`, with the reason, where the device cannot do what the rig file says. A class
    attribute ``lacks`` may list what the device cannot do, some of `Lacks`. A method ``statistics`` may give the counts
    of its connection by the fields of the recording's ``ConnectionStatistics``; they are recorded once a second.

    A camera whose clock takes long to ask has a method ``ask_time``, which queries it without waiting (False where
    there is no clock), and a method ``time_answers``, which gives the `ClockAnswer`s since its last call. During a
    session ``time_ns`` is not called then.
    """

    description: str
    """Model, serial number, firmware: for the recording."""

    def time_ns(self) -> int | None:
        """The camera's clock now, ns since any time; it must not jump. None where it reports no time."""

    def start(self, start_ns: int, exposures: int) -> None:
        """Take ``exposures`` frames (0: until stopped), the first as soon as the camera can from ``start_ns`` on.

        ``start_ns`` is on the camera's clock, on `time.monotonic_ns` for a camera that reports no time.
        """

    def frames(self) -> Iterable[SimpleFrame]:
        """The frames that have come since the last call, in order, without waiting."""

    def stop(self) -> None:
        """Take no more frames."""

    def close(self) -> None:
        """Release the device."""


class ThreadCamera:
    """Base class of a `SimpleCamera` whose frames come from a thread: a driver gives `expose`, and ``description``.

    By default it reports no time and does not count its frames.
    """

    description: str
    lacks: tuple[Lacks, ...] = (Lacks.TIME, Lacks.COUNT, Lacks.TRIGGER)
    triggers: tuple[str, ...] = ("free-running",)
    _thread: threading.Thread | None = None

    def expose(self, start_ns: int, exposures: int, stopped: threading.Event) -> Iterator[SimpleFrame]:
        """Give ``exposures`` frames (0: without an end), or more, until ``stopped`` is set; it may wait for each.

        Frames from before ``start_ns`` do not count. It runs on a thread of its own; what it raises ends the session
        once the frames before are taken.
        """
        raise NotImplementedError

    def time_ns(self) -> int | None:
        return None

    def start(self, start_ns: int, exposures: int) -> None:
        self._arrived: deque[SimpleFrame] = deque(maxlen=_MOST_WAITING)
        self._failure: Exception | None = None
        self._stopped = threading.Event()
        frames = self.expose(start_ns, exposures, self._stopped)
        run = (frames, self._stopped, self._arrived)
        self._thread = threading.Thread(target=self._run, args=run, name="aolink-camera", daemon=True)
        self._thread.start()

    def frames(self) -> list[SimpleFrame]:
        """The frames since the last call. Raises the error that has ended the thread, after the frames before it."""
        if self._thread is None:
            return []
        frames = [self._arrived.popleft() for _ in range(len(self._arrived))]
        if not frames and self._failure is not None:
            raise self._failure
        return frames

    def stop(self) -> None:
        """Ask the thread to end; it need not have ended yet."""
        if self._thread is not None:
            self._stopped.set()

    def close(self) -> None:
        """End the thread, once the frame that is under way has come, or after two seconds."""
        self.stop()
        if self._thread is not None:
            self._thread.join(_JOIN_S)

    def _run(self, frames: Iterator[SimpleFrame], stopped: threading.Event, arrived: deque[SimpleFrame]) -> None:
        try:
            arrived.extend(frames)
        except Exception as failure:
            if not stopped.is_set():
                self._failure = failure


class Held(NamedTuple):
    """The inputs that a mirror held in a run of fast steps."""

    first_step: int
    u: NDArray[np.float64]
    """(n_steps, n_inputs)"""
    late: NDArray[np.bool_] | None = None
    """(n_steps,), true where the command for the step came too late, so that the mirror went on holding its input."""


class SimpleMirror(Protocol):
    """A mirror that takes a queue of inputs, one for each fast step. For the entry point see `SimpleCamera`."""

    description: str

    def time_ns(self) -> int:
        """The mirror's clock now, ns since its fast step 0 began: the steps are counted by it. It must not jump."""

    def send(self, first_step: int, u: NDArray[np.float64]) -> int:
        """Queue inputs (n_steps, n_inputs) for the fast steps from ``first_step``; a later command replaces an earlier.

        Gives how many steps, from the first on, came too late. If it raises, the whole command counts as refused.
        """

    def applied(self) -> Iterable[Held | tuple[int, NDArray[np.float64]]]:
        """The inputs that the mirror held since the last call: first fast steps and inputs (n_steps, n_inputs), in
        order."""

    def park(self) -> int:
        """Hold the safe input from now on and empty the queue; gives the first fast step with the safe input.

        It may be called by another thread than the session's, but never at the same time as another method.
        """

    def close(self) -> None:
        """Give the device back."""


class DirectMirror(Protocol):
    """A mirror without a queue, which holds the input that it received last. For the entry point see `SimpleCamera`.

    `aolink.devices.paced.PacedMirror` drives it at the fast rate, on a thread of its own: its methods may wait for the
    device, and are never called at the same time.
    """

    description: str

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hold ``u`` (n_inputs,) from now on; gives the input that the device took, rounded to its resolution.

        Raises DeviceError where the device refuses it or does not answer.
        """

    def park(self) -> None:
        """Hold the safe input, whatever state the device is in."""

    def close(self) -> None:
        """Give the device back."""
