"""The gate: every message of a device is checked here, against the rig file, the host's clock and the commands that
were sent.

No message of a device changes any state before it has passed. The packet's checksum lets damage through once in
2^32 times, so an impossible message was sent in that form: by faulty firmware, or by a device that is not what the rig
file describes. Such a device's numbers cannot be trusted, so the session ends with a `DeviceError` that names the
field. A sound device may also send repeated, late or unasked answers, clock replies that the regression refuses, and
reports from before the session: these are no error, but dropped or counted.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from aolink.assembly import Frame
from aolink.devices.limits import CommandLimits
from aolink.errors import DeviceError
from aolink.rig import MirrorDriver, Rig
from aolink.wire import messages_pb2 as pb
from aolink.wire.hub import Hub
from aolink.wire.link import Link

MOST_STEP = 1 << 53
"""No count of fast steps reaches this."""
MOST_TIME_NS = 3_600_000_000_000_000_000
"""No clock reads a time further from its zero: 114 years. The difference of two such times fits into int64."""
MOST_RATE_ERROR = 1e-3
"""No crystal's frequency is off by more."""
_SLACK_S = 1.0
"""The most by which a device may be ahead of the time that its crystal explains, s."""
_DELAY_S = 1.0
"""On virtual time, how long a packet may take beyond four times the rig file's latency: a rig may inject stalls."""
_LONGEST_TEXT = 1000
_REMEMBERED_BLOCKS = 4096
"""Number of blocks that are remembered. A closed loop sends some six for each exposure; for older ones only the id is
checked."""
_KINDS: dict[str, tuple[type[Message], ...]] = {
    "camera": (pb.FrameChunk, pb.TruthChunk, pb.ClockReply, pb.Event, pb.Ack, pb.Identity),
    "mirror": (pb.Applied, pb.CommandAck, pb.ClockReply, pb.Event, pb.Ack, pb.Identity),
}
"""The messages that each device may send."""


def lie(device: str, field: str, found: object, expected: str) -> DeviceError:
    """The error for a field with an impossible value."""
    return DeviceError(
        f"the {device} says {field} = {found}, expected {expected}: its firmware is at fault, or the rig file is"
        " another device's; what was recorded before is kept"
    )


def printable(text: str) -> str:
    """A device's text, made safe for a log or a terminal."""
    return "".join(each if each.isprintable() else " " for each in text[:_LONGEST_TEXT])


def converter_margin(mirror: MirrorDriver) -> NDArray[np.float64]:
    """Largest difference between a reported input and the one that was sent, (n_inputs,): a step of the converter."""
    low, high = mirror.voltage.input_range if mirror.voltage else (mirror.input_min, mirror.input_max)
    converter = (np.asarray(high) - low) / ((1 << mirror.dac_bits) - 1) if mirror.dac_bits else 0.0
    return converter + 1e-6 * (mirror.input_max - mirror.input_min)  # single precision will do


class Gate:
    """Checks the messages of the two devices of a session.

    Parameters
    ----------
    rig:
        Their rig; their identities have been compared with it.
    hub:
        The host's clock.
    identities:
        Identities of camera and mirror.
    asked_ns:
        Host time before they were asked for these: the fast step was then no later than they say.
    """

    def __init__(self, rig: Rig, hub: Hub, identities: Iterable[pb.Identity], asked_ns: int) -> None:
        self._rig, self._hub = rig, hub
        self._step_ns = rig.timing.fast_step_ns
        self._first_step = max(identity.next_step for identity in identities)
        self._asked_ns = asked_ns
        self._sent: dict[int, tuple[int, int]] = {}
        """First step and one past the last of command blocks, by id, oldest first."""
        self._last_block = 0
        self._sent_end = self._first_step
        mirror = rig.mirror
        self.limits = CommandLimits(rig)
        """Limits of the inputs that are sent to the mirror."""
        margin = converter_margin(mirror)
        self._input_min, self._input_max = mirror.input_min - margin, mirror.input_max + margin
        planes = [(rig.sensor.shape, rig.sensor.bit_depth)]
        if rig.scene is not None:
            planes.append((rig.scene.shape, rig.scene.bit_depth))
        self._planes = planes
        states = 2 * rig.plant.axes * rig.plant.n_states
        # Twice as much as needed: numbers may be sent with a tag each, and a simulated plant may have other states.
        self._most_truth = 16 * (4 * states + rig.n_outputs * rig.timing.exposure_steps) + 1024
        self._frame_head: tuple[object, ...] = ()
        self._frame_id = -1
        self._frame_step = 0

    @property
    def exposure_bytes(self) -> int:
        """The most bytes that the camera sends for one exposure."""
        return sum(2 * height * width for (height, width), _ in self._planes) + self._most_truth

    def sent(self, block: pb.CommandBlock) -> None:
        """Remember a command block, which the mirror may then report as applied."""
        end = block.first_step + block.n_steps
        self._sent[block.block_id] = block.first_step, end
        self._last_block, self._sent_end = max(self._last_block, block.block_id), max(self._sent_end, end)
        while len(self._sent) > _REMEMBERED_BLOCKS:
            del self._sent[next(iter(self._sent))]

    def passes(self, link: Link, message: Message, receive_ns: int) -> bool:
        """Whether to use a message; False for one that is to be dropped. Raises DeviceError naming the field."""
        device = link.name
        if not isinstance(message, _KINDS[device]):
            raise lie(device, "a message", type(message).__name__, f"a message that a {device} may send")
        if isinstance(message, pb.FrameChunk):
            self._check_chunk(device, message, receive_ns)
        elif isinstance(message, pb.Applied):
            return self._check_applied(device, message, receive_ns)
        elif isinstance(message, pb.CommandAck):
            self._check_command_ack(device, message, receive_ns)
        elif isinstance(message, pb.TruthChunk):
            self._check_truth_chunk(device, message)
        elif isinstance(message, pb.ClockReply):
            check_times(device, message, ("device_receive_ns", "device_send_ns"))
        elif isinstance(message, pb.Ack):
            latest = max(self._sent_end, self._end(receive_ns))
            if message.step > latest:
                raise lie(device, "Ack.step", message.step, f"at most {latest}, where the device is at most")
        return True

    def check_step(self, device: str, step: int, now_ns: int) -> None:
        """Refuse a fast step, found from a device's clock, that it cannot be in. Raises DeviceError."""
        slack = round(_SLACK_S * 1e9) // self._step_ns
        end = self._end(now_ns)
        if not self._first_step - slack <= step <= end:
            what = f"a time that puts it between its fast steps {self._first_step - slack} and {end}"
            raise lie(device, "Identity.step_zero_ns and ClockReply", f"fast step {step}", what)

    def check_frame(self, device: str, frame: Frame) -> None:
        """Refuse a frame with counts that its converter cannot give. Raises DeviceError."""
        bits = self._planes[frame.plane][1]
        brightest = int(frame.pixels.max())
        if brightest >> bits:
            raise lie(
                device, f"a pixel of frame {frame.frame_id}", brightest, f"at most {(1 << bits) - 1} ({bits} bits)"
            )

    def check_truth(self, device: str, truth: pb.Truth, frame_id: int) -> None:
        """Refuse a truth that this rig cannot have sent. Raises DeviceError."""
        rig, path = self._rig, truth.path or truth.path_single
        outputs, axes = rig.n_outputs, rig.plant.axes
        pairs = [
            ("frame_id", truth.frame_id, frame_id),
            ("axes", truth.axes, axes),
            ("n_outputs", truth.n_outputs, outputs),
            ("path: numbers", len(path), outputs * rig.timing.exposure_steps),
            ("end_state: numbers", len(truth.end_state), len(truth.start_state)),
            ("start_state: numbers beyond whole axes", len(truth.start_state) % axes, 0),
        ]
        for name, found, expected in pairs:
            if found != expected:
                raise lie(device, f"Truth.{name}", found, str(expected))
        for name, numbers in (("path", path), ("start_state", truth.start_state), ("end_state", truth.end_state)):
            if not np.isfinite(np.array(numbers)).all():
                raise lie(device, f"Truth.{name}", "a number that is not finite", "finite ones")

    def check_virtual_time(self, link: Link, handed: pb.VirtualTime) -> None:
        """Refuse a host time from a simulated rig that is later than it can be. Raises DeviceError.

        On virtual time commands drive time, so the rig cannot be later than the end of its commands, plus the time-outs
        that the host let pass and the latency of packets.
        """
        hub, before = self._hub, link.handed
        for each in hub.links:
            name = f"{each.name}_bytes"
            taken, least = getattr(handed, name), getattr(before, name) if before else 0
            if not least <= taken <= each.sent_bytes:
                raise lie(link.name, f"VirtualTime.{name}", taken, f"{least} to {each.sent_bytes}")
        delay_s = _SLACK_S + (_DELAY_S + 4 * self._rig.simulation.latency_s) * sum(e.sent_packets for e in hub.links)
        driven_s = (self._sent_end - self._first_step) * self._step_ns / 1e9 * (1 + MOST_RATE_ERROR)
        first_ns = before.host_ns if before else 0
        last_ns = hub.virtual_since_ns + hub.elapsed_ns + round((driven_s + delay_s) * 1e9)
        if not first_ns <= handed.host_ns <= last_ns:
            raise lie(link.name, "VirtualTime.host_ns", handed.host_ns, f"{first_ns} to {last_ns}")

    def _end(self, now_ns: int) -> int:
        """The first fast step that cannot have ended yet."""
        if self._hub.virtual:
            return self._sent_end
        elapsed_s = max(now_ns - self._asked_ns, 0) / 1e9
        return self._first_step + math.ceil((elapsed_s * (1 + MOST_RATE_ERROR) + _SLACK_S) * 1e9 / self._step_ns)

    def _check_chunk(self, device: str, chunk: pb.FrameChunk, receive_ns: int) -> None:
        head = (
            chunk.frame_id, chunk.plane, chunk.total, chunk.width, chunk.height, chunk.first_step, chunk.last_step,
            chunk.exposure_start_ns, chunk.exposure_end_ns, chunk.exposure_offset_ns,
        )  # fmt: skip
        if not 0 < len(chunk.data) <= chunk.total - chunk.offset:
            what = f"1 to {chunk.total - chunk.offset} bytes from offset {chunk.offset} on"
            raise lie(device, "FrameChunk.data", f"{len(chunk.data)} bytes", what)
        if head == self._frame_head:
            return
        timing, end = self._rig.timing, self._end(receive_ns)
        if chunk.plane >= len(self._planes):
            raise lie(device, "FrameChunk.plane", chunk.plane, f"below {len(self._planes)}")
        rows, columns = self._planes[chunk.plane][0]
        first = chunk.first_step
        pairs = [
            ("height", chunk.height, rows),
            ("width", chunk.width, columns),
            ("total", chunk.total, 2 * rows * columns),
            ("last_step", chunk.last_step, first + timing.exposure_steps - 1),
        ]
        for name, found, expected in pairs:
            if found != expected:
                raise lie(device, f"FrameChunk.{name}", found, str(expected))
        if chunk.last_step >= end:
            what = f"below {end}, where the device is at most"
            raise lie(device, "FrameChunk.last_step", chunk.last_step, what)
        if chunk.exposure_offset_ns >= self._step_ns:
            raise lie(device, "FrameChunk.exposure_offset_ns", chunk.exposure_offset_ns, f"below {self._step_ns}")
        check_times(device, chunk, ("exposure_start_ns", "exposure_end_ns"))
        if self._frame_id >= 0:
            self._check_order(device, chunk.frame_id, first)
        elif chunk.frame_id > MOST_STEP:
            raise lie(device, "FrameChunk.frame_id", chunk.frame_id, "at most 2^53")
        if chunk.frame_id >= self._frame_id:
            self._frame_id, self._frame_step, self._frame_head = chunk.frame_id, first, head

    def _check_order(self, device: str, frame_id: int, first_step: int) -> None:
        """Whether a frame can follow the one before: a newer frame begins later, and its id is higher by no more than
        the number of frame periods between them."""
        timing, before, since = self._rig.timing, self._frame_id, first_step - self._frame_step
        if frame_id == before and since:
            what = f"{self._frame_step}, as the rest of frame {frame_id} has"
            raise lie(device, "FrameChunk.first_step", first_step, what)
        if frame_id > before and since < timing.exposure_steps:
            what = (
                f"at least {self._frame_step + timing.exposure_steps}, for frame {before} began at {self._frame_step}"
            )
            raise lie(device, "FrameChunk.first_step", first_step, what)
        most = before + since // timing.frame_period_steps + 1
        if frame_id > before and frame_id > most:
            what = f"at most {most}, {since} fast steps after frame {before}"
            raise lie(device, "FrameChunk.frame_id", frame_id, what)

    def _check_applied(self, device: str, applied: pb.Applied, receive_ns: int) -> bool:
        n_inputs, numbers = self._rig.n_inputs, len(applied.u)
        end, sources = applied.first_step + applied.n_steps, pb.Applied.Source
        sent = [each for each in sources.values() if each not in (pb.Applied.AWAITED, pb.Applied.LATE)]
        if applied.source not in sent:
            what = f"one of {sent}"
            raise lie(device, "Applied.source", applied.source, what)
        known = applied.source != pb.Applied.NOT_REPORTED
        if not applied.n_steps or numbers != known * applied.n_steps * n_inputs:
            what = f"as many as it has inputs for, {numbers / n_inputs:g}, at least 1" if known else "no inputs with it"
            raise lie(device, "Applied.n_steps", applied.n_steps, what)
        if end <= self._first_step:  # from an earlier session
            return False
        latest = self._end(receive_ns)
        if end > latest:
            what = f"to end by {latest}, where the device is at most"
            raise lie(device, "Applied.first_step + n_steps", end, what)
        if not applied.block_id and applied.source in (pb.Applied.COMMAND, pb.Applied.CLIPPED):
            raise lie(device, "Applied.block_id", 0, f"a command's, where the source is {sources.Name(applied.source)}")
        if applied.block_id > self._last_block:
            raise lie(
                device, "Applied.block_id", applied.block_id, f"at most {self._last_block}, the newest that was sent"
            )
        first_sent, end_sent = self._sent.get(applied.block_id, (0, MOST_STEP))
        if applied.first_step < first_sent or end > end_sent:
            what = f"steps {first_sent} to {end_sent - 1} of block {applied.block_id}"
            raise lie(device, "Applied.first_step", f"{applied.first_step} (to {end - 1})", what)
        u = np.array(applied.u, dtype=np.float64).reshape(-1, n_inputs)
        inside = (u >= self._input_min) & (u <= self._input_max)
        if not inside.all():  # NaN fails as well
            step, channel = np.argwhere(~inside)[0]
            mirror = self._rig.mirror
            limits = f"{mirror.input_min[channel]:g} to {mirror.input_max[channel]:g}, its limits"
            raise lie(
                device,
                f"Applied.u (input {channel} at fast step {applied.first_step + step})",
                u[step, channel],
                limits,
            )
        check_times(device, applied, ("device_ns",))
        return True

    def _check_command_ack(self, device: str, ack: pb.CommandAck, receive_ns: int) -> None:
        if not 0 < ack.block_id <= self._last_block:
            raise lie(device, "CommandAck.block_id", ack.block_id, f"1 to {self._last_block}, those that were sent")
        if ack.code not in pb.Code.values():
            raise lie(device, "CommandAck.code", ack.code, f"one of {pb.Code.values()}")
        if ack.block_id in self._sent:
            first, end = self._sent[ack.block_id]
            for name in ("late_steps", "superseded_steps"):
                if (found := getattr(ack, name)) > end - first:
                    raise lie(
                        device, f"CommandAck.{name}", found, f"at most {end - first}, the steps of block {ack.block_id}"
                    )
        latest = max(self._sent_end, self._end(receive_ns))
        if ack.queue_end_step > latest:
            raise lie(device, "CommandAck.queue_end_step", ack.queue_end_step, f"at most {latest}")

    def _check_truth_chunk(self, device: str, chunk: pb.TruthChunk) -> None:
        if not 0 < chunk.total <= self._most_truth:
            raise lie(device, "TruthChunk.total", chunk.total, f"1 to {self._most_truth} bytes")
        if not 0 < len(chunk.data) <= chunk.total - chunk.offset:
            what = f"1 to {chunk.total - chunk.offset} bytes from offset {chunk.offset} on"
            raise lie(device, "TruthChunk.data", f"{len(chunk.data)} bytes", what)


def check_times(device: str, message: Message, names: Iterable[str]) -> None:
    for name in names:
        if abs(time_ns := getattr(message, name)) > MOST_TIME_NS:
            field = f"{type(message).__name__}.{name}"
            raise lie(device, field, time_ns, f"within {MOST_TIME_NS} ns of the device's zero")
