"""The assembly of exposures from frames, commands and the mirror's reports.

The live session and the reader of recordings feed the same `Assembler` with the same messages in the
same order, so both get the same exposures. It has no clock and needs no time-out. A device sends in order, so a missing
message shows as soon as a later one has come. Where a report is requested again, the session records a message that
says so, and another one when it gives up.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aolink.exposure import Exposure
from aolink.rig import MirrorDriver, Rig
from aolink.rig.rows import inputs_by_axis, possible_skew_ns
from aolink.wire import messages_pb2 as pb
from aolink.wire.runs_pb2 import Run


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """A frame as a camera delivered it."""

    frame_id: int
    first_step: int
    last_step: int
    """Last fast step of the exposure, inclusive."""
    pixels: NDArray[np.uint16]
    """Counts, zero where nothing arrived, (rows, columns)."""
    mask: NDArray[np.bool_]
    """True where the pixel arrived, (rows, columns)."""
    chunks_lost: int
    frames_lost_before: int
    """Frames between the previous one and this one that never came."""
    device_start_ns: int
    device_end_ns: int
    host_first_byte_ns: int
    host_receive_ns: int
    host_start_ns: int = 0
    """Start of the exposure on the host's clock, as estimated; 0 where there is no estimate."""
    clock_sigma_ns: float = float("nan")
    alignment_sigma_ns: float = 0.0
    exposure_offset_ns: int = 0
    """From the beginning of the first fast step to the start of the exposure; less than a fast step."""
    rows_unknown: bool = False
    """Whether it is not known when in the exposure each row was exposed."""
    plane: int = 0
    """Number of the camera's picture of the exposure: 0 for the spots, 1 for the scene."""
    slopes: NDArray[np.float64] | None = None
    """Slopes of other software, as in `Exposure.slopes`."""


class FrameReassembly:
    """Assembles frames of ``shape`` (rows, columns) of one plane from their chunks. Lost chunks leave masked pixels."""

    def __init__(self, shape: tuple[int, int], fast_step_ns: int) -> None:
        self._shape, self._fast_step_ns = shape, fast_step_ns
        self._first: pb.FrameChunk | None = None
        """First chunk of the frame that is in progress; its fields are those of all of the frame's chunks."""
        self._data = np.zeros(0, np.uint8)
        self._arrived = np.zeros(0, bool)
        self._largest = 0
        """Bytes of its largest chunk."""
        self._first_byte_ns = self._last_byte_ns = 0
        self._last_id: int | None = None
        self.refused = 0
        """Number of invalid chunks: beyond their frame, of a frame that is over, of another size."""

    def add(self, chunk: pb.FrameChunk, receive_ns: int) -> list[Frame]:
        """Take a chunk; gives the frames that are over with it, at most two."""
        frames = []
        if self._first is not None and chunk.frame_id != self._first.frame_id:
            frames.append(self._close(self._first))
        stale = self._last_id is not None and chunk.frame_id <= self._last_id
        if stale or not self._is_sound(chunk):
            self.refused += 1
            return frames
        if self._first is None:
            self._first, self._first_byte_ns, self._largest = chunk, receive_ns, 0
            self._data, self._arrived = np.zeros(chunk.total, np.uint8), np.zeros(chunk.total, bool)
        # Each chunk is copied to its place at once: however many come, a frame takes no more memory than its size.
        end = chunk.offset + len(chunk.data)
        self._data[chunk.offset : end] = np.frombuffer(chunk.data, np.uint8)
        self._arrived[chunk.offset : end] = True
        self._largest = max(self._largest, len(chunk.data))
        self._last_byte_ns = receive_ns
        if end == chunk.total:
            frames.append(self._close(self._first))
        return frames

    def flush(self) -> list[Frame]:
        """The frame that is in progress, as it is."""
        return [self._close(self._first)] if self._first is not None else []

    def _is_sound(self, chunk: pb.FrameChunk) -> bool:
        first = self._first or chunk
        return (
            0 < len(chunk.data) <= chunk.total - chunk.offset
            and chunk.total == 2 * chunk.width * chunk.height
            and (chunk.height, chunk.width) == self._shape
            and chunk.first_step == first.first_step
            and chunk.last_step >= chunk.first_step
            and chunk.exposure_offset_ns == first.exposure_offset_ns < self._fast_step_ns
        )

    def _close(self, first: pb.FrameChunk) -> Frame:
        data, arrived, self._first = self._data, self._arrived, None
        lost_before = 0 if self._last_id is None else first.frame_id - self._last_id - 1
        self._last_id = first.frame_id
        return Frame(
            frame_id=first.frame_id, first_step=first.first_step, last_step=first.last_step,
            pixels=data.view("<u2").astype(np.uint16, copy=False).reshape(self._shape),
            mask=(arrived[::2] & arrived[1::2]).reshape(self._shape),
            chunks_lost=-(-(first.total - int(np.count_nonzero(arrived))) // self._largest),
            frames_lost_before=lost_before, device_start_ns=first.exposure_start_ns,
            device_end_ns=first.exposure_end_ns, host_first_byte_ns=self._first_byte_ns,
            host_receive_ns=self._last_byte_ns, exposure_offset_ns=first.exposure_offset_ns, plane=first.plane,
        )  # fmt: skip


class PlanesReassembly:
    """Assembles the frames of all the pictures of an exposure from their chunks; each plane counts its own losses.

    A camera sends one plane after the other, so a chunk of one plane ends the frame of the other.

    Parameters
    ----------
    shapes:
        Rows and columns of plane 0, 1, ...
    """

    def __init__(self, shapes: Sequence[tuple[int, int]], fast_step_ns: int) -> None:
        self._planes = [FrameReassembly(shape, fast_step_ns) for shape in shapes]
        self._unknown = 0

    @property
    def refused(self) -> int:
        """Number of invalid chunks, including those of planes that the camera does not have."""
        return self._unknown + sum(plane.refused for plane in self._planes)

    def add(self, chunk: pb.FrameChunk, receive_ns: int) -> list[Frame]:
        """Take a chunk; gives the frames that are over with it."""
        if chunk.plane >= len(self._planes):
            self._unknown += 1
            return []
        own = self._planes[chunk.plane]
        ended = [frame for plane in self._planes if plane is not own for frame in plane.flush()]
        return ended + own.add(chunk, receive_ns)

    def flush(self) -> list[Frame]:
        """The frames that are in progress, as they are."""
        return [frame for plane in self._planes for frame in plane.flush()]


class TruthReassembly:
    """Assembles truths from their chunks; a truth with a missing chunk is dropped."""

    def __init__(self) -> None:
        self._frame_id = 0
        self._data = bytearray()

    def add(self, chunk: pb.TruthChunk) -> pb.Truth | None:
        """Take a chunk; gives the truth that it completes."""
        if chunk.offset == 0:
            self._frame_id, self._data = chunk.frame_id, bytearray()
        if chunk.frame_id != self._frame_id or chunk.offset != len(self._data):
            self._frame_id = 0
            return None
        self._data += chunk.data
        return pb.Truth.FromString(bytes(self._data)) if len(self._data) == chunk.total else None


_DOUBLE = np.dtype("<f8")
_Blocks = list[tuple[int, NDArray[np.float64]]]
"""First steps and inputs of runs of steps, (k, n_inputs), in the order in which they came."""


class InputHistory:
    """Inputs that the mirror applied, and inputs that it was sent, for every fast step not yet used."""

    def __init__(self, mirror: MirrorDriver) -> None:
        self._n_inputs, self._quantise = len(mirror.park), mirror.quantise
        self._applied: _Blocks = []
        self._commanded: _Blocks = []
        self._awaited: list[tuple[int, int]] = []
        """First steps and ends of runs of steps whose reports have been requested again and have not come yet."""
        self._last = mirror.park
        self._reported_until = 0
        """First step that no report covers yet."""
        self.known_until = 0
        """End of the steps that any command, report or frame is about, exclusive; 0 before the first."""

    def add_applied(self, message: pb.Applied | Run) -> None:
        first, end = message.first_step, message.first_step + message.n_steps
        # A mirror reports steps that it was sent: accepting a report of steps far beyond them would make all later ones
        # late.
        if self.known_until and end > self.known_until + _MOST_LEAD_STEPS:
            return
        source = message.source if isinstance(message, pb.Applied) else pb.Applied.COMMAND
        if source == pb.Applied.AWAITED:
            self._awaited.append((first, end))
            return
        if not self._add(self._applied, message) and source != pb.Applied.NOT_REPORTED:
            return
        if self._awaited:
            parts = [part for low, high in self._awaited for part in ((low, min(high, first)), (max(low, end), high))]
            self._awaited = [(low, high) for low, high in parts if low < high]
        self._reported_until = max(self._reported_until, end)
        self.known_until = max(self.known_until, end)

    def is_known_until(self, end: int) -> bool:
        """Whether no report of a step before ``end`` is still to come."""
        return end <= self._reported_until and min(self._awaited, default=(end, end))[0] >= end

    def add_command(self, message: pb.CommandBlock | Run) -> None:
        """Take a command: it stands in where the mirror's report is lost."""
        if self._add(self._commanded, message):
            self.known_until = max(self.known_until, message.first_step + message.n_steps)

    def _add(self, blocks: _Blocks, message: pb.Applied | pb.CommandBlock | Run) -> bool:
        """Take the inputs of a run of steps; False where their number is not the stated one."""
        n_steps, u = message.n_steps, message.u
        inputs = np.frombuffer(u, _DOUBLE) if isinstance(u, bytes) else np.array(u, dtype=np.float64)
        if not n_steps or inputs.size != n_steps * self._n_inputs:
            return False
        if blocks and blocks[-1][0] == message.first_step and len(blocks[-1][1]) == n_steps:
            del blocks[-1]  # the same steps again: the last message counts
        blocks.append((message.first_step, inputs.reshape(n_steps, self._n_inputs)))
        # Where no frame comes to use them, inputs are not kept for longer than a frame would look back.
        oldest = message.first_step - _MOST_LEAD_STEPS
        while len(blocks) > _MOST_BLOCKS or blocks[0][0] + len(blocks[0][1]) <= oldest:
            del blocks[0]
        return True

    @property
    def first_commanded(self) -> int | None:
        """First step that any command not yet used is about; None where there is none."""
        return min((start for start, _ in self._commanded), default=None)

    def take(self, first: int, end: int) -> tuple[NDArray[np.float64], int]:
        """Inputs of steps first .. end - 1 and how many are assumed; forgets everything before ``end``.

        The last message about a step counts. A step without a report is assumed to hold the commanded input, rounded by
        the mirror's converter; a step without a command either is assumed to hold the input of the step before.
        """
        n = max(0, end - first)
        if n and self._reports_exactly(first, n):
            (_, rows), *self._applied = self._applied
            self._commanded = _after(end, self._commanded)
            self._last = rows[-1]
            return rows, 0
        rows, commanded, reported = np.empty((n, self._n_inputs)), np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        for blocks, known in ((self._commanded, commanded), (self._applied, reported)):
            for start, u in blocks:
                some = slice(max(start - first, 0), max(start + len(u) - first, 0))
                rows[some] = u[max(first - start, 0) :][: len(rows[some])]
                known[some] = True
            blocks[:] = _after(end, blocks)
        only_commanded = commanded & ~reported
        if only_commanded.any():
            rows[only_commanded] = self._quantise(rows[only_commanded])
        for k in np.flatnonzero(~(commanded | reported)):
            rows[k] = rows[k - 1] if k else self._last
        if n:
            self._last = rows[-1].copy()
        return rows, n - int(np.count_nonzero(reported))

    def _reports_exactly(self, first: int, n_steps: int) -> bool:
        """Whether one report covers these steps and no other report covers any of them, so that no command matters."""
        if not self._applied:
            return False
        start, u = self._applied[0]
        after = first + n_steps
        return start == first and len(u) == n_steps and all(other >= after for other, _ in self._applied[1:])


def _after(end: int, blocks: _Blocks) -> _Blocks:
    """The parts of runs of steps that are not before ``end``."""
    return [(max(start, end), u[max(end - start, 0) :]) for start, u in blocks if start + len(u) > end]


_MOST_LEAD_STEPS = 100_000
"""In a longer gap between exposures the inputs are not kept; their number shows that they are missing."""

_MOST_BLOCKS = 100_000
"""The most runs of steps that wait for their frame: no more than one is expected for each step."""


class Assembler:
    """Makes exposures: frames wait here until the inputs of their steps are known, and leave as exposures, in order."""

    def __init__(self, rig: Rig) -> None:
        self._history = InputHistory(rig.mirror)
        self.add_command = self._history.add_command
        self._rig, self._no_lead = rig, np.empty((0, rig.n_inputs))
        self._delay = rig.input_delay
        self._kept, self._kept_until = self._no_lead, 0
        """Inputs up to a fast step, of which axes that are exposed later still need some."""
        self._fast_step_ns = rig.timing.fast_step_ns
        self._frames: deque[Frame] = deque()
        self._end: int | None = None

    def add_applied(self, message: pb.Applied | Run) -> list[Exposure]:
        """Take a report of the mirror; gives the exposures that are complete with it."""
        self._history.add_applied(message)
        return self._ready()

    def add_frame(self, frame: Frame) -> list[Exposure]:
        """Take a frame; gives the exposures that are complete with it."""
        self._frames.append(frame)
        self._history.known_until = max(self._history.known_until, frame.last_step + 1 + self._delay)
        return self._ready()

    def flush(self) -> list[Exposure]:
        """Give the frames that still wait, with commands in place of the reports that never came."""
        exposures = [self._expose(frame) for frame in self._frames]
        self._frames.clear()
        return exposures

    def _ready(self) -> list[Exposure]:
        exposures = []
        while self._frames and self._history.is_known_until(self._frames[0].last_step + 1 + self._delay):
            exposures.append(self._expose(self._frames.popleft()))
        return exposures

    def _expose(self, frame: Frame) -> Exposure:
        # The mirror rests until its first command; a camera may begin later, or its first frames be lost.
        begin = self._history.first_commanded if self._end is None else self._end
        lead_start = frame.first_step if begin is None else min(begin, frame.first_step)
        lead_start = max(lead_start, frame.first_step - _MOST_LEAD_STEPS)
        lead, inputs, assumed = (self._delayed if self._delay else self._at_once)(frame, lead_start)
        return Exposure(
            n_steps=len(inputs), inputs=inputs, lead_inputs=lead,
            start_offset=frame.exposure_offset_ns / self._fast_step_ns, inputs_assumed=assumed,
            frame_id=frame.frame_id, first_step=frame.first_step, pixels=frame.pixels, mask=frame.mask,
            chunks_lost=frame.chunks_lost, device_start_ns=frame.device_start_ns, device_end_ns=frame.device_end_ns,
            host_start_ns=frame.host_start_ns, host_receive_ns=frame.host_receive_ns,
            clock_sigma_ns=frame.clock_sigma_ns, alignment_sigma_ns=frame.alignment_sigma_ns, slopes=frame.slopes,
            row_sigma_ns=possible_skew_ns(self._rig) if frame.rows_unknown else None,
        )  # fmt: skip

    def _at_once(self, frame: Frame, lead_start: int) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
        """Inputs of the lead and of the exposure, and how many of their steps are assumed."""
        lead, lead_assumed = self._no_lead, 0
        if lead_start < frame.first_step:
            lead, lead_assumed = self._history.take(lead_start, frame.first_step)
        inputs, assumed = self._history.take(frame.first_step, frame.last_step + 1)
        self._end = frame.last_step + 1
        return lead, inputs, assumed + lead_assumed

    def _delayed(self, frame: Frame, lead_start: int) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
        """The same, of each axis in its own interval, where the camera exposes its rows one after the other."""
        rig, last = self._rig, frame.last_step + 1 + self._delay
        begin = max(self._kept_until, lead_start)
        new, assumed = self._history.take(begin, last)
        rows = np.concatenate([self._kept if begin == self._kept_until else self._no_lead, new])
        from_step = last - len(rows)
        if self._end is None:
            # Before the mirror's first command it is at rest; every axis begins as early as the latest one.
            lead_start -= int(rig.axis_delays.max())
        n_steps = frame.last_step + 1 - frame.first_step + rig.plant.last_delay
        lead = inputs_by_axis(rig.plant, rig.axis_delays, rows, lead_start - from_step, frame.first_step - lead_start)
        inputs = inputs_by_axis(rig.plant, rig.axis_delays, rows, frame.first_step - from_step, n_steps)
        self._end = frame.first_step + n_steps
        # The next exposure begins one step before this one's end at the earliest.
        self._kept, self._kept_until = rows[max(self._end - 1 - from_step, 0) :], last
        return lead, inputs, assumed
