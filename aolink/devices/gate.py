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
_BY_NOW = ", where the device is at most"
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


def require(ok: bool, device: str, field: str, found: object, expected: object) -> None:
    """Raise the error of `lie` for a field unless its value is ``ok``."""
    if not ok:
        raise lie(device, field, found, str(expected))


def within(device: str, message: Message, field: str, low: int, high: int, why: str = "") -> None:
    """Raise the error of `lie` unless a field of a message is a number from ``low`` to ``high``."""
    found = getattr(message, field)
    expected = f"{low}{f' to {high}' if high != low else ''}{why}"
    require(low <= found <= high, device, f"{type(message).__name__}.{field}", found, expected)


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
        self._most_truth = 16 * (4 * states + rig.n_outputs * rig.window_steps) + 1024
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
        what = f"a message that a {device} may send"
        require(isinstance(message, _KINDS[device]), device, "a message", type(message).__name__, what)
        if isinstance(message, pb.FrameChunk):
            self._check_chunk(device, message, receive_ns)
        elif isinstance(message, pb.Applied):
            return self._check_applied(device, message, receive_ns)
        elif isinstance(message, pb.CommandAck):
            self._check_command_ack(device, message, receive_ns)
        elif isinstance(message, pb.TruthChunk):
            within(device, message, "total", 1, self._most_truth, " bytes")
            _check_data(device, message)
        elif isinstance(message, pb.ClockReply):
            check_times(device, message, ("device_receive_ns", "device_send_ns"))
        elif isinstance(message, pb.Ack):
            within(device, message, "step", 0, max(self._sent_end, self._end(receive_ns)), _BY_NOW)
        return True

    def check_step(self, device: str, step: int, now_ns: int) -> None:
        """Refuse a fast step, found from a device's clock, that it cannot be in. Raises DeviceError."""
        least, end = self._first_step - round(_SLACK_S * 1e9) // self._step_ns, self._end(now_ns)
        what = f"a time that puts it between its fast steps {least} and {end}"
        require(least <= step <= end, device, "Identity.step_zero_ns and ClockReply", f"fast step {step}", what)

    def check_frame(self, device: str, frame: Frame) -> None:
        """Refuse a frame with counts that its converter cannot give. Raises DeviceError."""
        bits, brightest = self._planes[frame.plane][1], int(frame.pixels.max())
        what = f"at most {(1 << bits) - 1} ({bits} bits)"
        require(not brightest >> bits, device, f"a pixel of frame {frame.frame_id}", brightest, what)

    def check_truth(self, device: str, truth: pb.Truth, frame_id: int) -> None:
        """Refuse a truth that this rig cannot have sent. Raises DeviceError."""
        rig, path = self._rig, truth.path or truth.path_single
        outputs, axes = rig.n_outputs, rig.plant.axes
        pairs = [
            ("frame_id", truth.frame_id, frame_id),
            ("axes", truth.axes, axes),
            ("n_outputs", truth.n_outputs, outputs),
            ("path: numbers", len(path), outputs * rig.window_steps),
            ("end_state: numbers", len(truth.end_state), len(truth.start_state)),
            ("start_state: numbers beyond whole axes", len(truth.start_state) % axes, 0),
        ]
        for name, found, expected in pairs:
            require(found == expected, device, f"Truth.{name}", found, expected)
        for name, numbers in (("path", path), ("start_state", truth.start_state), ("end_state", truth.end_state)):
            finite = bool(np.isfinite(np.array(numbers)).all())
            require(finite, device, f"Truth.{name}", "a number that is not finite", "finite ones")

    def check_virtual_time(self, link: Link, handed: pb.VirtualTime) -> None:
        """Refuse a host time from a simulated rig that is later than it can be. Raises DeviceError.

        On virtual time commands drive time, so the rig cannot be later than the end of its commands, plus the time-outs
        that the host let pass and the latency of packets.
        """
        hub, before = self._hub, link.handed
        for each in hub.links:
            name = f"{each.name}_bytes"
            within(link.name, handed, name, getattr(before, name) if before else 0, each.sent_bytes)
        delay_s = _SLACK_S + (_DELAY_S + 4 * self._rig.simulation.latency_s) * sum(e.sent_packets for e in hub.links)
        driven_s = (self._sent_end - self._first_step) * self._step_ns / 1e9 * (1 + MOST_RATE_ERROR)
        last_ns = hub.virtual_since_ns + hub.elapsed_ns + round((driven_s + delay_s) * 1e9)
        within(link.name, handed, "host_ns", before.host_ns if before else 0, last_ns)

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
        _check_data(device, chunk)
        if head == self._frame_head:
            return
        timing, first = self._rig.timing, chunk.first_step
        within(device, chunk, "plane", 0, len(self._planes) - 1)
        rows, columns = self._planes[chunk.plane][0]
        exact = {"height": rows, "width": columns, "total": 2 * rows * columns}
        for name, expected in {**exact, "last_step": first + timing.exposure_steps - 1}.items():
            within(device, chunk, name, expected, expected)
        within(device, chunk, "last_step", 0, self._end(receive_ns) - 1, _BY_NOW)
        within(device, chunk, "exposure_offset_ns", 0, self._step_ns - 1)
        check_times(device, chunk, ("exposure_start_ns", "exposure_end_ns"))
        if self._frame_id >= 0:
            self._check_order(device, chunk)
        else:
            within(device, chunk, "frame_id", 0, MOST_STEP)
        if chunk.frame_id >= self._frame_id:
            self._frame_id, self._frame_step, self._frame_head = chunk.frame_id, first, head

    def _check_order(self, device: str, chunk: pb.FrameChunk) -> None:
        """Whether a frame can follow the one before: a newer frame begins later, and its id is higher by no more than
        the number of frame periods between them."""
        timing, before, began = self._rig.timing, self._frame_id, self._frame_step
        since = chunk.first_step - began
        follows = f", for frame {before} began at fast step {began}"
        if chunk.frame_id == before:
            within(device, chunk, "first_step", began, began, follows)
        elif chunk.frame_id > before:
            within(device, chunk, "first_step", began + timing.exposure_steps, MOST_STEP, follows)
        most = before + since // timing.frame_period_steps + 1 if since > 0 else before
        within(device, chunk, "frame_id", before + 1 if since > 0 else 0, most, follows)

    def _check_applied(self, device: str, applied: pb.Applied, receive_ns: int) -> bool:
        n_inputs, numbers = self._rig.n_inputs, len(applied.u)
        end, sources = applied.first_step + applied.n_steps, pb.Applied.Source
        sent = [each for each in sources.values() if each not in (pb.Applied.AWAITED, pb.Applied.LATE)]
        require(applied.source in sent, device, "Applied.source", applied.source, f"one of {sent}")
        known = applied.source != pb.Applied.NOT_REPORTED
        what = f"as many as it has inputs for, {numbers / n_inputs:g}, at least 1" if known else "no inputs with it"
        whole = applied.n_steps > 0 and numbers == known * applied.n_steps * n_inputs
        require(whole, device, "Applied.n_steps", applied.n_steps, what)
        if end <= self._first_step:  # from an earlier session
            return False
        commanded = applied.source in (pb.Applied.COMMAND, pb.Applied.CLIPPED)
        within(device, applied, "block_id", int(commanded), self._last_block, ", the newest that was sent")
        first_sent, end_sent = self._sent.get(applied.block_id, (0, MOST_STEP))
        last = min(end_sent, self._end(receive_ns)) - applied.n_steps
        why = f" for {applied.n_steps} steps of block {applied.block_id} by now"
        within(device, applied, "first_step", first_sent, last, why)
        u = np.array(applied.u, dtype=np.float64).reshape(-1, n_inputs)
        inside = (u >= self._input_min) & (u <= self._input_max)
        if not inside.all():  # NaN fails as well
            step, channel = np.argwhere(~inside)[0]
            mirror = self._rig.mirror
            limits = f"{mirror.input_min[channel]:g} to {mirror.input_max[channel]:g}, its limits"
            field = f"Applied.u (input {channel} at fast step {applied.first_step + step})"
            raise lie(device, field, u[step, channel], limits)
        check_times(device, applied, ("device_ns",))
        return True

    def _check_command_ack(self, device: str, ack: pb.CommandAck, receive_ns: int) -> None:
        within(device, ack, "block_id", 1, self._last_block, ", those that were sent")
        require(ack.code in pb.Code.values(), device, "CommandAck.code", ack.code, f"one of {pb.Code.values()}")
        if ack.block_id in self._sent:
            first, end = self._sent[ack.block_id]
            for name in ("late_steps", "superseded_steps"):
                within(device, ack, name, 0, end - first, f", the steps of block {ack.block_id}")
        within(device, ack, "queue_end_step", 0, max(self._sent_end, self._end(receive_ns)))


def _check_data(device: str, chunk: pb.FrameChunk | pb.TruthChunk) -> None:
    left = chunk.total - chunk.offset
    if not 0 < len(chunk.data) <= left:
        what = f"1 to {left} bytes from offset {chunk.offset} on"
        raise lie(device, f"{type(chunk).__name__}.data", f"{len(chunk.data)} bytes", what)


def check_times(device: str, message: Message, names: Iterable[str]) -> None:
    for name in names:
        within(device, message, name, -MOST_TIME_NS, MOST_TIME_NS, " ns from the device's zero")
